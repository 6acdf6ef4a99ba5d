"""Code of others may change the process's working folder: paths that a user typed are relative to it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


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
