"""Where data and caches live, outside the package; caches kept below a size; a seal on what own runs name."""

from __future__ import annotations

import hmac
import math
import os
import re
import secrets
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

from lodbench.errors import ConfigError, DatasetError
from lodbench.storage.digest import digest_of
from lodbench.storage.disk import make_folder, write_bytes

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


_KEY_BYTES = 32


def seal_of(value: object) -> str | None:
    """Returns what only this user's cache can make of a JSON value; None where no key can be kept."""
    key = _key() or _new_key()
    return None if key is None else _sealed(value, key)


def is_sealed(value: object, seal: object) -> bool:
    """Tells whether a seal of a JSON value was made with this user's key."""
    key = _key()
    return (
        key is not None
        and isinstance(seal, str)
        and seal.isascii()
        and hmac.compare_digest(_sealed(value, key), seal)
    )


def _sealed(value: object, key: bytes) -> str:
    return hmac.new(key, digest_of(value, length=64).encode(), "sha256").hexdigest()


def _path() -> Path:
    return cache_root() / "own_runs.key"


def _key() -> bytes | None:
    """Returns the key if it is there whole, and this user's alone."""
    try:
        state = _path().stat()
        is_private = state.st_uid == os.getuid() and not state.st_mode & 0o077
        key = _path().read_bytes() if is_private else b""
    except OSError:
        return None
    return key if len(key) == _KEY_BYTES else None


def _new_key() -> bytes | None:
    key = secrets.token_bytes(_KEY_BYTES)
    try:
        make_folder(_path().parent)
        write_bytes(_path(), key, mode=0o600)
    except OSError:
        return None  # a cache that is read only
    # Another process may have been faster.
    return _key()
