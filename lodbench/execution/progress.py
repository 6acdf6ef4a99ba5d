"""Progress on one line of a terminal, with the time left; silent in a log."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TextIO

# Redrawing more often than this only flickers, seconds.
_REDRAW_S = 0.1


class Progress:
    """Counts finished items of a known total.

    Args:
        label: What is being done.
        total: Number of items; None where nobody knows it.
        stream: Where to draw, standard error by default; nothing is drawn unless it is a terminal.
        unit: What the items are, where the label does not say it: ``MB``.
    """

    def __init__(self, label: str, total: int | None, stream: TextIO | None = None, unit: str = "") -> None:
        self._label, self._total, self._unit = label, total, f" {unit}" if unit else ""
        self._stream = stream if stream is not None else sys.stderr
        self._is_shown = self._stream.isatty() and total != 0
        self._done = 0
        self._started = self._drawn = time.monotonic()

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._is_shown:
            self._stream.write("\r\x1b[K")
            self._stream.flush()

    def advance(self, count: int = 1) -> None:
        """Marks ``count`` more items as finished."""
        self._done += count
        now = time.monotonic()
        if self._is_shown and (now - self._drawn >= _REDRAW_S or self._done == self._total):
            self._drawn = now
            self._stream.write(f"\r\x1b[K{self.line(now - self._started)}")
            self._stream.flush()

    def line(self, elapsed_s: float) -> str:
        """Returns the line to draw after ``elapsed_s`` seconds of work."""
        if self._total is None:
            return f"{self._label}: {self._done}{self._unit}"
        left_s = elapsed_s / self._done * (self._total - self._done) if self._done else 0.0
        return f"{self._label}: {self._done} of {self._total}{self._unit}, {format_seconds(left_s)} left"


class ProgressCallback:
    """Draws progress for work that calls back with what is done and its total.

    Args:
        label: What is being done.
        unit: What is drawn, ``MB``; nothing for plain steps.
        per_unit: How many of the counts called with make one unit.
        stream: As for ``Progress``.

    Example:
        >>> with ProgressCallback("city.gml", unit="MB", per_unit=10**6) as progress:
        ...     progress(1_500_000, 3_000_000)
    """

    def __init__(self, label: str, unit: str = "", per_unit: int = 1, stream: TextIO | None = None) -> None:
        self._label, self._unit, self._per_unit, self._stream = label, unit, per_unit, stream
        self._progress: Progress | None = None
        self._done = 0

    def __enter__(self) -> ProgressCallback:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._progress is not None:
            self._progress.__exit__(kind, value, traceback)

    def __call__(self, done: int, total: int) -> None:
        """Tells of progress; ``total`` is 0 where nobody knows it."""
        if self._progress is None:
            units = -(-total // self._per_unit) if total else None
            self._progress = Progress(self._label, units, self._stream, self._unit)
        units_done = done // self._per_unit
        if units_done > self._done:
            self._progress.advance(units_done - self._done)
            self._done = units_done


def format_seconds(seconds: float) -> str:
    """Returns a duration for people: ``8 s``, ``2 min 05 s``, ``1 h 10 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
