"""An append-only file of finished work: what a resumed run need not do again."""

from __future__ import annotations

import json
import logging
import re
from pathlib import Path
from typing import Any

import xxhash

from lodbench.storage import make_folder, write_bytes
from lodbench.storage.disk import disk
from lodbench.storage.json_text import parse_json

_LOGGER = logging.getLogger(__name__)
# The last key of a line is of all that stands before it.
_CHECK = re.compile(rb', "check": "([0-9a-f]{16})"\}')


class Ledger:
    """Finished items by key, one JSON object per line, with a check that a changed digit fails.

    A line is on disk before the next item starts, so a killed process loses at most the item it
    was at. The half line it may leave, and any other line that is not as it was written, is dropped from the
    file; a warning tells how many of the latter. Lines without a check, as older versions wrote them, are
    believed as long as no line before them has one.

    Args:
        path: The file; made on the first record.
        read_only: Leave the file as it is, damaged lines included: somebody else may be writing it.

    Attributes:
        damaged: How many lines of the file are not as they were written, a half one at its end included.
    """

    def __init__(self, path: Path, read_only: bool = False) -> None:
        self._path = path
        self._read_only = read_only
        self._items: dict[str, dict[str, Any]] = {}
        self.damaged = 0
        if path.is_file():
            self._load()

    def __contains__(self, key: str) -> bool:
        return key in self._items

    def __getitem__(self, key: str) -> dict[str, Any]:
        return self._items[key]

    def __len__(self) -> int:
        return len(self._items)

    def record(self, key: str, value: dict[str, Any]) -> None:
        """Adds a finished item and waits until it is on disk.

        Raises:
            OSError: The disk is full; the item is not in the ledger then.
        """
        line = _checked(json.dumps({"key": key, **value}, sort_keys=True, allow_nan=False).encode())
        is_new = not self._path.exists()
        make_folder(self._path.parent)
        with self._path.open("ab", buffering=0) as stream:
            end = stream.tell()
            try:
                disk().write(stream, line + b"\n", self._path)
                disk().sync(stream, self._path)
            except OSError:
                # Half a line would spoil the next one.
                stream.truncate(end)
                raise
        if is_new:
            disk().sync_folder(self._path.parent)
        self._items[key] = value

    def _load(self) -> None:
        content = self._path.read_bytes()
        kept: list[bytes] = []
        damaged, has_checks = 0, False
        # What follows the last line end is a half line, or nothing.
        *lines, half = content.split(b"\n")
        for line in lines:
            found = _CHECK.fullmatch(line[-_CHECK_BYTES:])
            item = _parse(line[:-_CHECK_BYTES] + b"}" if found else line)
            is_sound = line == _checked(line[:-_CHECK_BYTES] + b"}") if found else not has_checks
            has_checks |= found is not None
            if item is None or not is_sound:
                damaged += 1
            else:
                self._items[item.pop("key")] = item
                kept.append(line + b"\n")
        if damaged:
            _LOGGER.warning("%s has %d damaged lines, which count as not done.", self._path, damaged)
        self.damaged = damaged + bool(half)
        whole = b"".join(kept)
        if whole != content and not self._read_only:
            write_bytes(self._path, whole)


def _checked(item: bytes) -> bytes:
    """Returns a JSON object with a check of its bytes as its last key."""
    return item[:-1] + f', "check": "{xxhash.xxh3_64(item).hexdigest()}"}}'.encode()


_CHECK_BYTES = len(_checked(b"{}")) - 1


def _parse(line: bytes) -> dict[str, Any] | None:
    """Returns the item of a line, or None if the line is damaged."""
    try:
        item = parse_json(line.decode("utf-8"))
    except ValueError:
        return None
    return item if isinstance(item, dict) and isinstance(item.get("key"), str) else None
