"""A figure: a measured number, and the same of a peer beside it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

# Called with the steps done and their total.
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured number.

    Attributes:
        figure: What was measured, unique within a report.
        value: Our number.
        unit: Its unit; "" for a count.
        peer: Who or what the number stands beside, with the reason if it could not be measured; or "".
        peer_value: The peer's number in the same unit, or None.
        ratio: How many times better ours is, or None.
    """

    figure: str
    value: float
    unit: str
    peer: str = ""
    peer_value: float | None = None
    ratio: float | None = None

    def to_json(self) -> dict[str, str | float | None]:
        """Returns a JSON object in which what is not finite is null."""
        return {
            "figure": self.figure,
            "value": _finite(self.value),
            "unit": self.unit,
            "peer": self.peer,
            "peer_value": _finite(self.peer_value),
            "ratio": _finite(self.ratio),
        }


def no_progress(done: int, total: int) -> None:
    """Tells nobody."""


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
