"""Keeping a cache below a size: what was used longest ago goes first."""

from __future__ import annotations

import os
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

# A hidden entry is being written or removed; one this old was left by a process that died.
_ABANDONED_S = 24 * 3600.0


@dataclass(frozen=True, slots=True)
class _Entry:
    used_s: float
    num_bytes: int
    path: Path


def mark_used(entry: Path) -> None:
    """Notes that a folder of a cache was used just now; a cache that is read only stays as it is."""
    try:
        os.utime(entry)
    except OSError:
        return


def prune_cache(root: Path, limit_bytes: int, keep: Path) -> list[Path]:
    """Removes folders of a cache, longest unused first, until the rest fits.

    A folder vanishes at once under its name; a process that has its files mapped keeps them.

    Args:
        root: Folder whose entries are folders.
        limit_bytes: Size to stay below.
        keep: An entry that is not removed whatever its size.

    Returns:
        What was removed.
    """
    entries = sorted((_measure(path) for path in root.iterdir()), key=lambda entry: entry.used_s)
    total = sum(entry.num_bytes for entry in entries)
    oldest_s = time.time() - _ABANDONED_S
    removed = []
    for entry in entries:
        is_hidden = entry.path.name.startswith(".")
        is_due = entry.used_s < oldest_s if is_hidden else total > limit_bytes
        if is_due and entry.path != keep and _remove(entry.path, is_hidden):
            removed.append(entry.path)
            total -= entry.num_bytes
    return removed


def _measure(path: Path) -> _Entry:
    try:
        size = sum(file.stat().st_size for file in path.iterdir())
        return _Entry(path.stat().st_mtime, size, path)
    except OSError:  # no folder of ours, or removed by another process meanwhile
        return _Entry(time.time(), 0, path)


def _remove(path: Path, is_hidden: bool) -> bool:
    doomed = path if is_hidden else path.with_name(f".{path.name}.{os.getpid()}")
    try:
        if not is_hidden:
            path.rename(doomed)
        shutil.rmtree(doomed)
    except OSError:
        return False
    return True
