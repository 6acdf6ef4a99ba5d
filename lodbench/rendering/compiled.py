"""How the functions that work on single pixels are compiled."""

from __future__ import annotations

import logging
import os
from functools import cache
from multiprocessing import parent_process
from pathlib import Path
from typing import Any

from numba import njit

_LOGGER = logging.getLogger(__name__)

# Without reference counts: passing the scene's arrays along, numba would count a reference to each of
# them at every pixel, which takes as long as the shading. No function compiled so may make an array.
_UNCOUNTED: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}

# For the loop over pixels, and for what is called in it, which becomes part of it.
pixel_loop = njit(**_UNCOUNTED)
per_pixel = njit(forceinline=True, **_UNCOUNTED)


@cache
def say_if_compiling() -> None:
    """Says once that compiling takes a while, where no compiled renderer is kept from an earlier command."""
    kept = os.environ.get("NUMBA_CACHE_DIR")
    if kept and parent_process() is None and not any(Path(kept).rglob("engine_kernel.*.nbi")):
        _LOGGER.warning("First use: compiling takes about a minute, once.")
