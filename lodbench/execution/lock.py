"""One process at a time in a folder, and a working folder that code of others does not change."""

from __future__ import annotations

import fcntl
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

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
