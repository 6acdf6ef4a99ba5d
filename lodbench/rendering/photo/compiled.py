"""How the functions that work on single pixels are compiled."""

from __future__ import annotations

from numba import njit

# Inlined into one loop, and without reference counts: passing the scene's arrays along, numba would
# count a reference to each of them at every pixel, which takes as long as the shading. No function
# compiled so may make an array.
per_pixel = njit(cache=True, nogil=True, error_model="numpy", forceinline=True, _nrt=False)
