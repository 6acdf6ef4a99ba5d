"""How the functions that work on single pixels are compiled."""

from __future__ import annotations

from typing import Any

from numba import njit

# Without reference counts: passing the scene's arrays along, numba would count a reference to each of
# them at every pixel, which takes as long as the shading. No function compiled so may make an array.
_UNCOUNTED: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}

# For the loop over pixels, and for what is called in it, which becomes part of it.
pixel_loop = njit(**_UNCOUNTED)
per_pixel = njit(forceinline=True, **_UNCOUNTED)
