"""Atomic writes: a file or a folder is there whole, or not at all."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lodbench.storage.disk import disk

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
