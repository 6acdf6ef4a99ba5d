"""Every change of the disk, one method each: the one place where a full disk or a kill can strike.

All that lodbench writes goes through here, so that a test can let the n-th operation fail, for every n, and
look at what is left (as SQLite tests its virtual file system).
"""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from io import RawIOBase
from pathlib import Path

# linux/fcntl.h and linux/fs.h: paths as from the working directory; swap two names in one step.
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


class Disk:
    """The operating system's calls; an ``OSError`` of any names the path it is about."""

    def write(self, stream: RawIOBase, content: bytes | memoryview, path: Path) -> None:
        """Writes all of ``content`` to a file without a buffer: what fails, fails here."""
        left = memoryview(content).cast("B")
        with _named(path):
            while left:
                left = left[stream.write(left) :]

    def sync(self, stream: RawIOBase, path: Path) -> None:
        """Waits until a file's content is on the disk."""
        with _named(path):
            os.fsync(stream.fileno())

    def sync_folder(self, folder: Path) -> None:
        """Waits until a folder's entries are on the disk, so that a power cut undoes no rename."""
        with _named(folder):
            handle = os.open(folder, os.O_RDONLY)
            try:
                os.fsync(handle)
            except OSError as error:
                # Some file systems (of networks, of Windows) cannot; there is nothing more to ask for.
                if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
                    raise
            finally:
                os.close(handle)

    def rename(self, source: Path, target: Path) -> None:
        """Gives a file or folder another name; a file there is replaced in the same step."""
        source.replace(target)

    def swap(self, one: Path, other: Path) -> bool:
        """Lets two folders change names in one step; returns False where the system cannot."""
        libc = ctypes.CDLL(None, use_errno=True)
        if not hasattr(libc, "renameat2"):
            return False
        names = os.fsencode(one), os.fsencode(other)
        if libc.renameat2(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE) == 0:
            return True
        code = ctypes.get_errno()
        if code in (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP):
            return False
        raise OSError(code, os.strerror(code), str(other))

    def make_folder(self, folder: Path) -> None:
        """Makes a folder and its parents, where they are missing."""
        folder.mkdir(parents=True, exist_ok=True)

    def remove(self, path: Path) -> None:
        """Removes a file or a folder with all in it, as far as it can be."""
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


_disk = Disk()


def disk() -> Disk:
    """Returns the disk that is written to."""
    return _disk


@contextmanager
def another_disk(replacement: Disk) -> Iterator[None]:
    """Lets another disk stand in for the real one: one that fails, in tests."""
    global _disk
    saved, _disk = _disk, replacement
    try:
        yield
    finally:
        _disk = saved


def make_folder(folder: Path) -> Path:
    """Makes a folder and its parents where they are missing, and returns it.

    Raises:
        OSError: It cannot be made.
    """
    if not folder.is_dir():
        _disk.make_folder(folder)
    return folder


def can_write(folder: Path) -> bool:
    """Tells whether a folder is there or can be made, and takes files: to be checked before long work.

    Raises:
        OSError: Its name is too long, or a folder above it may not be looked into.
    """
    existing = folder.absolute()
    while not os.path.lexists(existing):
        existing.exists()  # says what is wrong with a name that none can have
        existing = existing.parent
    return existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Adds the path to an error of the system that names none."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
