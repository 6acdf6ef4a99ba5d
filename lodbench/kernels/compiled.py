"""How functions are compiled: the decorators of this package, and where numba keeps what it made of them."""

from __future__ import annotations

import logging
from functools import cache
from multiprocessing import parent_process
from typing import Any

from numba import njit

from lodbench.kernels.cache import kept_kernels, use_own_folder

_LOGGER = logging.getLogger(__name__)

use_own_folder()

# Division by zero gives infinity, as in numpy; ``checked`` raises, as Python does.
kernel: Any = njit(cache=True, nogil=True, error_model="numpy")
inlined: Any = njit(cache=True, nogil=True, error_model="numpy", inline="always")
checked: Any = njit(cache=True, nogil=True)

# Without reference counts: passing the scene's arrays along, numba would count a reference to each of
# them at every pixel, which takes as long as the shading. No function compiled so may make an array.
_UNCOUNTED: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}

# For the loop over pixels, and for what is called in it, which becomes part of it.
pixel_loop: Any = njit(**_UNCOUNTED)
per_pixel: Any = njit(forceinline=True, **_UNCOUNTED)


@cache
def say_if_compiling() -> None:
    """Says once that compiling takes a while, where no compiled renderer is kept from an earlier command."""
    if parent_process() is None and kept_kernels("silhouettes.draw_view") == []:
        _LOGGER.warning("First use: compiling takes about a minute, once.")
