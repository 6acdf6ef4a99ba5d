"""Progress of long work: a bar on a terminal or in a notebook, now and then a line in a log."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Any, TextIO

# A log that is no terminal gets a line as often as this, seconds: short work leaves it clean.
_LOG_EVERY_S = 60.0
# The first item is no measure: it compiles, loads and fills caches. What is left follows from the pace after
# it, once so many items took so long, seconds; a single one must have taken longer.
_LEAST_ITEMS, _LEAST_S, _LONG_S = 3, 2.0, 20.0


class Progress:
    """Counts finished items of a known total.

    Args:
        label: What is being done.
        total: Number of items; None where nobody knows it.
        stream: Where to draw, standard error by default.
        unit: What the items are, where the label does not say it: ``MB``.
        done: Items that were finished before, by an earlier process.
    """

    def __init__(
        self, label: str, total: int | None, stream: TextIO | None = None, unit: str = "", done: int = 0
    ) -> None:
        self._label, self._total, self._unit = label, total, f" {unit}" if unit else ""
        self._stream = stream if stream is not None else sys.stderr
        self._done = done
        self._first: tuple[int, float] | None = None
        self._logged = time.monotonic()
        self._bar = _bar(label, total, self._stream, self._unit, done)

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def advance(self, count: int = 1) -> None:
        """Marks ``count`` more items as finished."""
        self._done += count
        now = time.monotonic()
        if self._first is None:
            self._first = self._done, now
        if self._bar is not None:
            self._bar.set_postfix_str(self._left(now), refresh=False)
            self._bar.update(count)
        elif now - self._logged >= _LOG_EVERY_S:
            self._logged = now
            self._stream.write(", ".join(filter(None, [self._counts(), self._left(now)])) + "\n")
            self._stream.flush()

    def _counts(self) -> str:
        of_total = "" if self._total is None else f" of {self._total}"
        return f"{self._label}: {self._done}{of_total}{self._unit}"

    def _left(self, now: float) -> str:
        """Returns the time left; "" while there is nothing to tell it from."""
        if self._total is None or self._first is None:
            return ""
        count, took_s = self._done - self._first[0], now - self._first[1]
        if count < 1 or took_s < (_LEAST_S if count >= _LEAST_ITEMS else _LONG_S):
            return ""
        return f"{format_seconds(took_s / count * max(self._total - self._done, 0))} left"


def _bar(label: str, total: int | None, stream: TextIO, unit: str, done: int) -> Any:
    """Returns tqdm's bar for a notebook or a terminal; None for a log, and where there is nothing to do."""
    is_notebook = "ipykernel" in sys.modules and stream is sys.stderr
    if total == 0 or not (is_notebook or stream.isatty()):
        return None
    if is_notebook:
        from tqdm.notebook import tqdm
    else:
        from tqdm import tqdm
    shape = "{desc}: {n_fmt}" if total is None else "{desc}: {n_fmt} of {total_fmt}"
    ending = f"{unit}, {{elapsed}}" if total is None else f"{unit} |{{bar}}|{{postfix}}"
    return tqdm(
        total=total,
        initial=done,
        desc=label,
        file=stream,
        leave=False,
        dynamic_ncols=True,
        bar_format=shape + ending,
    )


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
