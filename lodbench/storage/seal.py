"""A seal on what this user's own runs name, so that a stranger's run folder cannot choose what is opened."""

from __future__ import annotations

import hmac
import os
import secrets
from pathlib import Path

from lodbench.storage.atomic import write_bytes
from lodbench.storage.digest import digest_of
from lodbench.storage.disk import make_folder
from lodbench.storage.paths import cache_root

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
