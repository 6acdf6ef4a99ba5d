"""When photos that are tracked were taken, by their own clocks, most of which count whole seconds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path

import numpy as np

from lodbench.datasets.photo_metadata import read_photo_metadata
from lodbench.errors import LodbenchError

# What photos without clocks are taken to be, a second.
PHOTO_RATE = 1.0


def photo_clocks(photos: Sequence[Path]) -> tuple[list[float] | None, list[str]]:
    """Returns when photos were taken, seconds after the first, and what the reader should know of it.

    Several of one second are taken to be evenly spaced in it, and photos that do not say, to be so between
    their neighbours. Where fewer than two say, or clocks stand still or run back, there are no times.
    """
    if len(photos) < 2:
        return None, []
    stated = _stated(photos)
    rows = [row for row, second in enumerate(stated) if second is not None]
    told = [second for second in stated if second is not None]
    notes = []
    if not _rises(told):
        whole = [float(second // 1) for second in told]
        if whole[0] == whole[-1] or whole != sorted(whole):
            return None, [_NO_CLOCK]
        told, notes = _spread(whole), [_WHOLE_SECONDS]
    if len(told) < 2:
        return None, [_NO_CLOCK]
    if len(told) < len(photos):
        told = _filled(rows, told, len(photos))
        notes.append(
            f"photos without a clock, {len(photos) - len(rows)}, are placed between their neighbours"
        )
    return _from_first(told), notes


_NO_CLOCK = f"no clock to order the photos by: {PHOTO_RATE:g} a second is assumed; --fps says how many"
_WHOLE_SECONDS = (
    "the photos' clock counts whole seconds: those of one second are taken as evenly spaced; "
    "--fps says how many there are"
)


def _stated(photos: Sequence[Path]) -> list[float | None]:
    """Returns seconds after a whole one; None where a clock lacks."""
    times: list[datetime | None] = []
    for photo in photos:
        try:
            stated = read_photo_metadata(photo)
            taken = datetime.strptime(stated.taken_at, "%Y:%m:%d %H:%M:%S")
            times.append(taken + timedelta(seconds=stated.taken_fraction_s or 0.0))
        except (ValueError, LodbenchError):
            times.append(None)
    first = next((time for time in times if time is not None), datetime.min).replace(microsecond=0)
    return [None if taken is None else (taken - first).total_seconds() for taken in times]


def _filled(rows: Sequence[int], told: Sequence[float], count: int) -> list[float]:
    """Returns the times of all photos from those of some rows: evenly between, as fast before and after."""
    pace = (told[-1] - told[0]) / (rows[-1] - rows[0])
    known_rows = [-1, *rows, count]
    known = [told[0] - pace * (rows[0] + 1), *told, told[-1] + pace * (count - rows[-1])]
    return [float(second) for second in np.interp(range(count), known_rows, known)]


def _from_first(seconds: Sequence[float]) -> list[float]:
    return [second - seconds[0] for second in seconds]


def _rises(seconds: Sequence[float]) -> bool:
    return all(later > sooner for sooner, later in pairwise(seconds))


def _spread(whole: Sequence[float]) -> list[float]:
    """Returns whole seconds with what is of one second evenly spaced in it.

    The first second and the last were begun or left in between, so they hold as many as the fullest would.
    """
    counts, done = Counter(whole), Counter[float]()
    fullest, spread = max(counts.values()), []
    for second in whole:
        is_cut = second in (whole[0], whole[-1])
        before = fullest - counts[second] if second == whole[0] else 0
        spread.append(second + (before + done[second]) / (fullest if is_cut else counts[second]))
        done[second] += 1
    return spread
