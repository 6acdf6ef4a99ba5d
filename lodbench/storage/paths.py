"""Where data and caches live: outside the package, which may be installed read-only."""

from __future__ import annotations

import os
from pathlib import Path


def data_root() -> Path:
    """Returns the folder of datasets: ``LODBENCH_DATA``, or the user's data folder."""
    configured = os.environ.get("LODBENCH_DATA")
    if configured:
        return Path(configured).expanduser()
    base = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
    return Path(base).expanduser() / "lodbench"


def cache_root() -> Path:
    """Returns the folder of rebuildable files: ``LODBENCH_CACHE``, or the user's cache folder."""
    configured = os.environ.get("LODBENCH_CACHE")
    if configured:
        return Path(configured).expanduser()
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "lodbench"
