"""Where data and caches live: outside the package, which may be installed read-only."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path

from lodbench.errors import ConfigError, DatasetError

_DEFAULT_CACHE_GB = 20.0


def path_name(what: str, name: str) -> str:
    """Returns a name that becomes part of a path, as it is: it cannot lead out of its folder.

    Args:
        what: Whose name, as in ``method``.
        name: It.

    Raises:
        ConfigError: It is no plain name.
    """
    if not isinstance(name, str) or not re.fullmatch(r"\w[\w.+-]{0,199}", name):
        raise ConfigError(
            f"The {what} name {name!r} cannot name a folder.", "Use letters, digits and any of _ . + -"
        )
    return name


def require_regular(path: Path) -> None:
    """Makes sure that a path, if it exists, is a file or folder: reading a pipe or device may never end.

    Raises:
        DatasetError: It is something else.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise DatasetError(f"{path} is no regular file.", "Save what it gives to a file first.")


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


def cache_limit_bytes() -> int:
    """Returns how large the cache of scenes may grow: ``LODBENCH_CACHE_GB`` (10^9 bytes), 20 by default.

    Raises:
        ConfigError: It is no number, or negative.
    """
    configured = os.environ.get("LODBENCH_CACHE_GB") or str(_DEFAULT_CACHE_GB)
    try:
        gigabytes = float(configured)
    except ValueError:
        gigabytes = math.nan
    if not 0.0 <= gigabytes < math.inf:
        raise ConfigError(f"LODBENCH_CACHE_GB={configured} is no size.", "It takes gigabytes, such as 20.")
    return int(gigabytes * 1e9)
