"""Every change of the disk, one method each: the one place where a full disk or a kill can strike.

All that lodbench writes goes through here, so that a test can let the n-th operation fail, for every n, and
look at what is left (as SQLite tests its virtual file system).
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from io import RawIOBase
from pathlib import Path
from typing import Any

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


# What is being written has a hidden name with this ending, which no other program gives.
_PARTIAL = ".lodbench.part"
# Folders that this process has swept: what was left there before it came is gone.
_swept: set[Path] = set()


def final_name(path: object) -> str:
    """Returns what a file or folder that is being written will be called; other names as they stand."""
    return re.sub(rf"\.([^/]+)\.\w{{8}}{re.escape(_PARTIAL)}\b", r"\1", str(path or ""))


def write_bytes(path: Path, content: bytes, survives_power_cut: bool = True, mode: int | None = None) -> None:
    """Writes a file so that a reader, or a crash, never meets half of it; see ``write_chunks``."""
    write_chunks(path, (content,), survives_power_cut, mode)


def write_chunks(
    path: Path, chunks: Iterable[bytes], survives_power_cut: bool = True, mode: int | None = None
) -> None:
    """Writes a file piece by piece so that a reader, or a crash, never meets half of it.

    What killed processes left in its folder is removed by the first file that this process writes there.

    Args:
        path: The file.
        chunks: What to write, in a row.
        survives_power_cut: Wait until the disk has it, some milliseconds. Otherwise a killed process leaves
            it whole or not at all just the same, but after a power cut it may be empty.
        mode: Its permissions; None for those of any new file of the user.

    Raises:
        OSError: The folder is missing or the disk is full; nothing is left behind then.
    """
    if path.parent not in _swept:
        _swept.add(path.parent)
        remove_leftovers(path.parent)
    temporary, handle = _claimed(path, tempfile.mkstemp)
    try:
        with os.fdopen(handle, "wb", buffering=0) as stream:
            for chunk in chunks:
                disk().write(stream, chunk, path)
            if survives_power_cut:
                disk().sync(stream, path)
            # mkstemp makes files private; a result is as readable as any other file of the user.
            temporary.chmod(0o666 & ~_umask() if mode is None else mode)
            # Before it is closed: no longer locked, it would be swept up by a process that begins here.
            disk().rename(temporary, path)
        if survives_power_cut:
            disk().sync_folder(path.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def writable(text: str) -> str:
    """Returns a text with lone surrogates, as of file names that are no UTF-8, spelt out."""
    return text.encode("utf-8", errors="backslashreplace").decode("utf-8")


def write_text(path: Path, content: str, survives_power_cut: bool = True) -> None:
    """Writes a UTF-8 text file atomically, with line ends as given; what is no UTF-8 is spelt out.

    A JSON reader takes what is spelt out for what it was.
    """
    write_bytes(path, content.encode("utf-8", errors="backslashreplace"), survives_power_cut)


@contextmanager
def new_folder(path: Path, survives_power_cut: bool = True) -> Iterator[Path]:
    """Gives an empty folder to fill, which becomes ``path``, in place of what is there, once it is full.

    What is there stays until the new folder takes its name, in one step where the system can; elsewhere a
    process killed between two renames leaves both under hidden names. What killed processes left of the
    same folder is removed.

    Raises:
        OSError: The parent folder is missing or not writable; nothing is left behind then.
    """
    remove_leftovers(path.parent, of=path.name)
    partial, handle = _claimed(path, _make_folder)
    try:
        yield partial
        # mkdtemp makes folders private, as mkstemp does files.
        partial.chmod(0o777 & ~_umask())
        if survives_power_cut:
            _sync_tree(partial)
        _put_in_place(partial, path)
        if survives_power_cut:
            disk().sync_folder(path.parent)
    finally:
        os.close(handle)
        # The folder that did not come to be, or the one that was replaced.
        if partial.exists():
            disk().remove(partial)


@contextmanager
def scratch_folder(path: Path) -> Iterator[Path]:
    """Gives an empty folder beside ``path``, hidden, which is removed in the end.

    What killed processes left of the same is removed.

    Raises:
        OSError: The parent folder is missing or not writable.
    """
    remove_leftovers(path.parent, of=path.name)
    scratch, handle = _claimed(path, _make_folder)
    try:
        yield scratch
    finally:
        os.close(handle)
        disk().remove(scratch)


def remove_leftovers(folder: Path, of: str = "") -> None:
    """Removes what killed processes were writing in a folder; what living ones write is left alone."""
    if not folder.is_dir():
        return
    for path in sorted(folder.iterdir()):
        if path.name.startswith(f".{of}") and path.name.endswith(_PARTIAL):
            # Claimed by a living process, removed by another, or on a file system without locks.
            with contextlib.suppress(OSError), _opened(path) as handle:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                disk().remove(path)


def _put_in_place(partial: Path, path: Path) -> None:
    """Gives a full folder its name; what had it is left under a hidden one, or removed."""
    if not path.exists():
        disk().rename(partial, path)
    elif not disk().swap(partial, path):
        aside = path.with_name(f".{path.name}.replaced{_PARTIAL}")
        disk().rename(path, aside)
        try:
            disk().rename(partial, path)
        except BaseException:
            disk().rename(aside, path)
            raise
        disk().remove(aside)


def _sync_tree(folder: Path) -> None:
    for parent, _, files in os.walk(folder):
        for name in files:
            path = Path(parent) / name
            with path.open("rb", buffering=0) as stream:
                disk().sync(stream, path)
        disk().sync_folder(Path(parent))


def _claimed(path: Path, make: Callable[..., tuple[int, str]]) -> tuple[Path, int]:
    """Makes a hidden file or folder beside a path; returns it opened, and locked while the process lives."""
    while True:
        handle, name = make(dir=path.parent, prefix=f".{path.name}.", suffix=_PARTIAL)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.fstat(handle).st_ino == Path(name).stat().st_ino:
                return Path(name), handle
        except (BlockingIOError, FileNotFoundError):
            pass  # another process has just taken it for a leftover
        except OSError:
            return Path(name), handle  # no locks here, so nobody sweeps up either
        os.close(handle)


def _make_folder(**place: Any) -> tuple[int, str]:
    """Does for a folder what ``tempfile.mkstemp`` does for a file."""
    name = tempfile.mkdtemp(**place)
    return os.open(name, os.O_RDONLY), name


@contextmanager
def _opened(path: Path) -> Iterator[int]:
    handle = os.open(path, os.O_RDONLY)
    try:
        yield handle
    finally:
        os.close(handle)


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask
