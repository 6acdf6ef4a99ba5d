"""How much a method asks of the map: poses drawn, by what was drawn."""

from __future__ import annotations

import threading
from collections import Counter


class MapUsage:
    """Counts the poses that a map drew, by kind; any thread may add.

    Kinds are the names of ``CityMap``'s methods. The harness takes the counts after each query.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._poses: Counter[str] = Counter()

    def add(self, kind: str, poses: int) -> None:
        """Counts so many poses drawn."""
        with self._lock:
            self._poses[kind] += poses

    def counts(self) -> dict[str, int]:
        """Returns the poses drawn since the last ``take``, by kind, in alphabetical order."""
        with self._lock:
            return dict(sorted(self._poses.items()))

    def take(self) -> dict[str, int]:
        """Returns ``counts``, and begins anew."""
        with self._lock:
            taken = dict(sorted(self._poses.items()))
            self._poses.clear()
        return taken

    @property
    def total(self) -> int:
        """Returns the poses drawn of all kinds."""
        with self._lock:
            return sum(self._poses.values())
