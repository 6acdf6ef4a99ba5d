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
        total: Number of items.
        stream: Where to draw, standard error by default; nothing is drawn unless it is a terminal.
    """

    def __init__(self, label: str, total: int, stream: TextIO | None = None) -> None:
        self._label, self._total = label, total
        self._stream = stream if stream is not None else sys.stderr
        self._is_shown = self._stream.isatty() and total > 0
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
        if self._is_shown and (now - self._drawn >= _REDRAW_S or self._done >= self._total):
            self._drawn = now
            self._stream.write(f"\r\x1b[K{self.line(now - self._started)}")
            self._stream.flush()

    def line(self, elapsed_s: float) -> str:
        """Returns the line to draw after ``elapsed_s`` seconds of work."""
        left_s = elapsed_s / self._done * (self._total - self._done) if self._done else 0.0
        return f"{self._label}: {self._done} of {self._total}, {format_seconds(left_s)} left"


def format_seconds(seconds: float) -> str:
    """Returns a duration for people: ``8 s``, ``2 min 05 s``, ``1 h 10 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
