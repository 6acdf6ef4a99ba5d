"""An append-only file of finished work: what a resumed run need not do again."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any


class Ledger:
    """Finished items by key, one JSON object per line.

    A line is on disk before the next item starts, so a killed process loses at most the item it
    was at; the half line it may leave is ignored and overwritten.

    Args:
        path: The file; made on the first record.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
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
        with self._path.open("a", encoding="utf-8") as stream:
            stream.write(line + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        self._items[key] = value

    def _load(self) -> None:
        content = self._path.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        for line in whole.decode("utf-8").splitlines():
            item = json.loads(line)
            self._items[item.pop("key")] = item
        if len(whole) < len(content):
            with self._path.open("r+b") as stream:
                stream.truncate(len(whole))
