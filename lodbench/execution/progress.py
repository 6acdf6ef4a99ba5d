"""Long work: how far it is, with the time left, and a ledger of what is done, to resume from."""

from __future__ import annotations

import json
import logging
import re
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import xxhash

from lodbench.storage import make_folder, write_bytes
from lodbench.storage.disk import disk
from lodbench.storage.json_text import parse_json

# A log that is no terminal gets a line as often as this, seconds: short work leaves it clean.
_LOG_EVERY_S = 60.0
# The first item is no measure: it compiles, loads and fills caches. What is left follows from the pace after
# it, once so many items took so long, seconds; a single one must have taken longer.
_LEAST_ITEMS, _LEAST_S, _LONG_S = 3, 2.0, 20.0
_LOGGER = logging.getLogger(__name__)
# The last key of a line is of all that stands before it.
_CHECK = re.compile(rb', "check": "([0-9a-f]{16})"\}')


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
            match = _CHECK.fullmatch(line[-_CHECK_BYTES:])
            item = _parse(line[:-_CHECK_BYTES] + b"}" if match else line)
            is_sound = line == _checked(line[:-_CHECK_BYTES] + b"}") if match else not has_checks
            has_checks |= match is not None
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
