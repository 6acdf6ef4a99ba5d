"""An append-only file of finished work: what a resumed run need not do again."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from lodbench.storage import write_bytes


class Ledger:
    """Finished items by key, one JSON object per line.

    A line is on disk before the next item starts, so a killed process loses at most the item it
    was at. The half line it may leave, and any other line that is no item, is dropped from the file.

    Args:
        path: The file; made on the first record.
        read_only: Leave the file as it is, damaged lines included: somebody else may be writing it.
    """

    def __init__(self, path: Path, read_only: bool = False) -> None:
        self._path = path
        self._read_only = read_only
        self._items: dict[str, dict[str, Any]] = {}
        if path.is_file():
            self._load()

    def __contains__(self, key: str) -> bool:
        return key in self._items

    def __getitem__(self, key: str) -> dict[str, Any]:
        return self._items[key]

    def __len__(self) -> int:
        return len(self._items)

    def record(self, key: str, value: dict[str, Any]) -> None:
        """Adds a finished item and waits until it is on disk."""
        line = json.dumps({"key": key, **value}, sort_keys=True, allow_nan=False)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("a", encoding="utf-8") as stream:
            stream.write(line + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        self._items[key] = value

    def _load(self) -> None:
        content = self._path.read_bytes()
        kept: list[bytes] = []
        # What follows the last line end is a half line, or nothing.
        for line in content.split(b"\n")[:-1]:
            item = _parse(line)
            if item is not None:
                self._items[item.pop("key")] = item
                kept.append(line + b"\n")
        whole = b"".join(kept)
        if whole != content and not self._read_only:
            write_bytes(self._path, whole)


def _parse(line: bytes) -> dict[str, Any] | None:
    """Returns the item of a line, or None if the line is damaged."""
    try:
        item = json.loads(line.decode("utf-8"))
    except (ValueError, RecursionError):
        return None
    return item if isinstance(item, dict) and isinstance(item.get("key"), str) else None
