"""Atomic writes: a file is there whole, or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def write_bytes(path: Path, content: bytes, survives_power_cut: bool = True) -> None:
    """Writes a file so that a reader, or a crash, never meets half of it.

    Args:
        path: The file.
        content: What to write.
        survives_power_cut: Wait until the disk has it, some milliseconds. Otherwise a killed process leaves
            it whole or not at all just the same, but after a power cut it may be empty.

    Raises:
        OSError: The folder is missing or the disk is full; nothing is left behind then.
    """
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            if survives_power_cut:
                stream.flush()
                os.fsync(stream.fileno())
        # mkstemp makes files private; a result is as readable as any other file of the user.
        umask = os.umask(0)
        os.umask(umask)
        Path(temporary).chmod(0o666 & ~umask)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def write_text(path: Path, content: str) -> None:
    """Writes a UTF-8 text file atomically, with line ends as given."""
    write_bytes(path, content.encode("utf-8"))


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Gives an empty folder to fill, which becomes ``path``, in place of what is there, once it is full.

    Raises:
        OSError: The parent folder is missing or not writable; nothing is left behind then.
    """
    partial = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        yield partial
        partial.chmod(0o755)
        if path.exists():
            shutil.rmtree(path)
        partial.rename(path)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
