"""What work is kept from: threads of BLAS, other processes in its folder, another working folder.

BLAS is on one thread while results are made, so that sums have one order.

OpenBLAS splits long sums over its threads, so that the last digits of a product depend on how many there
are; a pose that an optimiser takes through them then differs too. For the small systems of a query its
threads gain nothing, and those of many workers only wait for each other.
"""

from __future__ import annotations

import fcntl
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

_lock = threading.Lock()
# What the first of the calls under way set aside, and None for each of the others.
_under_way: list[Any] = []
# Read by OpenBLAS when it is loaded; what loads SciPy's.
_THREADS, _SCIPY = "OPENBLAS_NUM_THREADS", "scipy.linalg"


def single_threaded_blas(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Returns a function that runs with BLAS on one thread; what was set before is set again after it.

    The libraries' thread counts are the process's: threads that call at the same time share them, and the
    last one to leave restores. SciPy brings a BLAS of its own: one that is loaded meanwhile keeps one thread.
    """

    @wraps(function)
    def limited(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with _lock:
            _under_way.append(None if _under_way else (_take_control(_limit), os.environ.get(_THREADS)))
            os.environ[_THREADS] = "1"
        try:
            return function(*args, **kwargs)
        finally:
            with _lock:
                if len(_under_way) == 1:
                    limits, threads = _under_way[0]
                    _take_control(limits.restore_original_limits)
                    os.environ.pop(_THREADS)
                    os.environ |= {} if threads is None else {_THREADS: threads}
                # The first stays until the last has left.
                _under_way.pop()

    return limited


def _limit() -> Any:
    return _libraries(_SCIPY in sys.modules).limit(limits=1, user_api="blas")


def _take_control(change: Callable[[], Result]) -> Result:
    """Returns what a change of limits returns, made by this thread whoever made the last one."""
    from threadpoolctl import OpenBLASController

    # Newer versions of threadpoolctl let one thread change limits alone; here the last to leave restores.
    give_up = getattr(OpenBLASController, "clear_controlling_thread", None)
    if give_up is None:
        return change()
    give_up(force=True)
    try:
        return change()
    finally:
        give_up(force=True)


@cache
def _libraries(_has_scipy: bool) -> Any:
    """Returns the libraries that are loaded; looked for once without SciPy and once with it."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


_LOGGER = logging.getLogger(__name__)


@contextmanager
def only_one_in(folder: Path) -> Iterator[None]:
    """Holds a folder for this process; waits, and says so, while another has it.

    The lock is the system's and ends with the process, however that happens; no file is left. Where the file
    system knows no locks there is none.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _LOGGER.warning("Another process is at work in %s: waiting for it.", folder)
            fcntl.flock(handle, fcntl.LOCK_EX)
        except OSError:
            pass
        yield
    finally:
        os.close(handle)


@contextmanager
def staying_here() -> Iterator[None]:
    """Returns to the working folder after the block, whatever it did; decorates functions too."""
    try:
        here = Path.cwd()
    except FileNotFoundError:  # it was removed: no relative path leads anywhere
        yield
        return
    try:
        yield
    finally:
        with suppress(OSError):
            os.chdir(here)
