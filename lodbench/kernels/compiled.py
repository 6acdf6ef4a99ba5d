"""How functions are compiled: the decorators of this package, and where numba keeps what it made of them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from multiprocessing import parent_process
from time import monotonic
from typing import Any

from numba import njit
from numba.core import event

from lodbench.kernels.cache import KernelCache, use_own_folder

_LOGGER = logging.getLogger(__name__)
# How often it is said how far compiling is.
_EVERY_S = 5.0

use_own_folder()


def _kept(**options: Any) -> Callable[[Any], Any]:
    """Returns the decorator of functions that are compiled on use and kept."""
    compiled = njit(**options)

    def decorate(function: Any) -> Any:
        dispatcher = compiled(function)
        dispatcher._cache = KernelCache(function)
        return dispatcher

    return decorate


# Division by zero gives infinity, as in numpy; ``checked`` raises, as Python does. Nothing but Python calls
# these: what numba adds for callers in C is left out.
_ANY: dict[str, Any] = {"nogil": True, "no_cfunc_wrapper": True}
kernel: Any = _kept(error_model="numpy", **_ANY)
checked: Any = _kept(**_ANY)
inlined: Any = _kept(error_model="numpy", inline="always", **_ANY)

# Without reference counts: passing a scene's arrays along, numba would count a reference to each of them,
# which takes as long as what is done with them, and longest to compile. No function compiled so may make an
# array, or return one.
_UNCOUNTED: dict[str, Any] = {**_ANY, "error_model": "numpy", "_nrt": False}
uncounted: Any = _kept(**_UNCOUNTED)
# A part of uncounted kernels, which Python cannot call: it is compiled with each that calls it.
part: Any = njit(no_cpython_wrapper=True, **_UNCOUNTED)
# A part that is called for every pixel.
per_pixel: Any = njit(forceinline=True, no_cpython_wrapper=True, **_UNCOUNTED)


class _Report(event.Listener):
    """Says that kernels are compiled, once, and every few seconds how far it is."""

    def __init__(self) -> None:
        self.depth, self.count, self.said_s = 0, 0, 0.0

    def on_start(self, happening: event.Event) -> None:
        """Counts a kernel, and not the parts and library functions that are compiled within."""
        self.depth += 1
        function = happening.data["dispatcher"].py_func
        if self.depth > 1 or not function.__module__.startswith(__package__):
            return
        self.count += 1
        name = f"{function.__module__.rpartition('.')[2]}.{function.__name__}"
        if self.count == 1:
            _LOGGER.warning("First use: compiling kernels (%s, ...), once: up to half a minute.", name)
        elif monotonic() - self.said_s > _EVERY_S:
            _LOGGER.warning("%d kernels compiled, now %s.", self.count - 1, name)
        else:
            return
        self.said_s = monotonic()

    def on_end(self, _: event.Event) -> None:
        """Notes that a function is compiled."""
        self.depth -= 1


# Where many processes work, the first one says it for all.
if parent_process() is None:
    event.register("numba:compile", _Report())
