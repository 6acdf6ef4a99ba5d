"""Files that are read again later must hold what they held: digests are remembered, and compared at reading.

A run is named by the digests of its masks and photos, which it reads query by query, hours later perhaps. So
the bytes that are decoded are those that are hashed: a file that was replaced, and put back before the end,
cannot leave an answer behind.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from lodbench.errors import InputChanged
from lodbench.storage.digest import file_digest

# What files held when `content_digest` first read them: here, and as another process told this one.
_scope: ContextVar[dict[Path, str] | None] = ContextVar("_scope", default=None)
_told: dict[Path, str] = {}


@contextmanager
def remembered_contents() -> Iterator[None]:
    """Within this, what `content_digest` finds in a file is what `read_content` must find there."""
    before = _scope.set({})
    try:
        yield
    finally:
        _scope.reset(before)


def known_contents() -> dict[Path, str]:
    """Returns what is remembered here, for workers; nothing outside of ``remembered_contents``."""
    return dict(_scope.get() or {})


def remember_contents(known: Mapping[Path, str]) -> None:
    """Lets a worker's process compare what it reads with what another process found, until told otherwise."""
    _told.clear()
    _told.update(known)


def content_digest(path: Path | None) -> str | None:
    """Returns a file's SHA-256; one that cannot be read fails in its own query, not here."""
    if path is None:
        return None
    scope = _scope.get()
    remembered = {} if scope is None else scope
    if path not in remembered:
        try:
            remembered[path] = file_digest(path)
        except OSError:
            return "unreadable"
    return remembered[path]


def read_content(path: Path, digest: str | None = None) -> bytes:
    """Returns a file's content.

    Args:
        path: The file.
        digest: SHA-256 that is wanted; None for the one that is remembered, if one is.

    Raises:
        OSError: It cannot be read.
        InputChanged: It is not what is remembered of it.
    """
    content = path.read_bytes()
    scope = _scope.get()
    expected = digest or (_told if scope is None else scope).get(path)
    if expected is not None and hashlib.sha256(content).hexdigest() != expected:
        raise InputChanged(
            f"{path} changed while it was in use; what was answered before is kept.",
            "Put it back, or give the same command again to answer what is there now.",
        )
    return content
