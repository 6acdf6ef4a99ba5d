"""Which photos were taken on one flight: by folder, camera and the clock in EXIF, which may jump."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path

from lodbench.datasets.photo_metadata import PhotoMetadata

# A drone that took no photo for so long was landed: its gimbal and barometer begin anew.
_LANDED = timedelta(minutes=15)
_CLOCK = "%Y:%m:%d %H:%M:%S"


@dataclass(slots=True)
class Flight:
    """Photos taken with one camera, one after the other.

    Attributes:
        rows: Of the photos, in the order of their names.
        camera: What took them.
        started: When the first was taken, by its clock; None where none says.
        ended: When the last was.
        odd_clocks: Rows whose clock runs against the order of names; they are where their names put them.
    """

    rows: list[int]
    camera: str
    started: datetime | None = None
    ended: datetime | None = None
    odd_clocks: list[int] = field(default_factory=list)

    def take(self, other: Flight) -> None:
        """Adds a flight that goes on where this one, or in another folder beside it."""
        self.rows += other.rows
        self.odd_clocks += other.odd_clocks
        times = [time for time in (self.started, self.ended, other.started, other.ended) if time is not None]
        self.started, self.ended = min(times), max(times)


def split_flights(photos: Sequence[tuple[Path, PhotoMetadata]]) -> list[Flight]:
    """Returns the flights of some photos, by the first photo of each.

    Photos of a folder and a camera are one flight unless quarter of an hour passes between two whose names
    follow each other. A clock that runs against the order of names is not believed. Flights of one camera
    that go on in another folder, as memory cards have it after 999 photos, are one.
    """
    groups: dict[tuple[Path, tuple[object, ...]], list[int]] = {}
    for row, (path, stated) in enumerate(photos):
        groups.setdefault((path.parent, _camera_key(stated)), []).append(row)
    by_camera: dict[tuple[object, ...], list[Flight]] = {}
    for (_, key), rows in groups.items():
        rows.sort(key=lambda row: natural_key(photos[row][0].name))
        by_camera.setdefault(key, []).extend(_split_folder(rows, [stated for _, stated in photos]))
    flights = [flight for found in by_camera.values() for flight in _joined(found)]
    return sorted(flights, key=lambda flight: min(flight.rows))


def _camera_key(stated: PhotoMetadata) -> tuple[object, ...]:
    size = stated.width, stated.height
    return (stated.make, stated.model, *size, stated.focal_mm, stated.focal_35mm, stated.digital_zoom)


def _split_folder(rows: Sequence[int], stated: Sequence[PhotoMetadata]) -> list[Flight]:
    """Returns the flights of photos of one folder and camera, in the order of names."""
    times = [_taken_at(stated[row]) for row in rows]
    believed = _rising(times)
    first = stated[rows[0]]
    camera = " ".join(filter(None, [first.model or first.make, f"{first.width} x {first.height}"]))
    flights = [Flight([], camera)]
    for place, (row, time) in enumerate(zip(rows, times, strict=True)):
        flight = flights[-1]
        if time is not None and place in believed:
            if flight.ended is not None and time - flight.ended > _LANDED:
                flight = Flight([], camera)
                flights.append(flight)
            flight.started, flight.ended = flight.started or time, time
        elif time is not None:
            flight.odd_clocks.append(row)
        flight.rows.append(row)
    return flights


def _joined(flights: list[Flight]) -> list[Flight]:
    """Returns flights of one camera, those that go on in another folder as one."""
    joined: list[Flight] = []
    for flight in sorted(flights, key=lambda flight: flight.started or datetime.max):
        last = joined[-1] if joined else None
        if (
            last is not None
            and last.ended is not None
            and flight.started is not None
            # Two drones of one kind that are in the air at once are two flights.
            and timedelta() <= flight.started - last.ended <= _LANDED
        ):
            last.take(flight)
        else:
            joined.append(flight)
    return joined


def _rising(times: Sequence[datetime | None]) -> set[int]:
    """Returns the places of a longest subsequence of times that never falls; None is never in it."""
    ends: list[datetime] = []
    places: list[int] = []
    before: dict[int, int | None] = {}
    for place, time in enumerate(times):
        if time is None:
            continue
        length = bisect_right(ends, time)
        before[place] = places[length - 1] if length else None
        ends[length : length + 1] = [time]
        places[length : length + 1] = [place]
    found: set[int] = set()
    last = places[-1] if places else None
    while last is not None:
        found.add(last)
        last = before[last]
    return found


def _taken_at(stated: PhotoMetadata) -> datetime | None:
    try:
        return datetime.strptime(stated.taken_at, _CLOCK)
    except ValueError:
        return None


def natural_key(name: str) -> list[tuple[int, str]]:
    """Returns a key that sorts IMG_2 before IMG_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]
