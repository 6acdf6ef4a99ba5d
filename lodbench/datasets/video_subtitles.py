"""What DJI's drones write into a ``.SRT`` beside a video: where each frame was taken from, and looked to."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from lodbench.datasets.photo_metadata import PhotoMetadata
from lodbench.datasets.photo_tags import number_of, place_of

# The first second: what a drone does not know of its first frame, it knows soon.
_FIRST_CUES, _MOST_BYTES = 30, 1 << 16
_PRY = ("pitch", "roll", "yaw")
_NUMBER = r"[-+]?\d+(?:\.\d+)?"
# ``[rel_alt: 80.1 abs_alt: 203.4]``, and ``BAROMETER:80.1`` of older drones.
_NAMED = re.compile(rf"([A-Za-z_]+) ?: ?({_NUMBER})(?![\d/])")
_NAMES = {
    "latitude": "latitude_deg",
    "longitude": "longitude_deg",
    "longtitude": "longitude_deg",  # so misspelt by older firmware
    "abs_alt": "altitude_m",
    "rel_alt": "relative_altitude_m",
    "barometer": "relative_altitude_m",
    **{f"{gimbal}_{angle}": f"gimbal_{angle}_deg" for gimbal in ("gb", "gimbal") for angle in _PRY},
}
# Older drones' lists: ``GPS(LONGITUDE,LATITUDE,...)``, and ``G.PRY (PITCH, ROLL, YAW)`` of the gimbal.
_GPS = re.compile(rf"\bGPS ?\( ?({_NUMBER}), ?({_NUMBER})\b")
_GIMBAL = re.compile(rf"\bG\.PRY ?\( ?({_NUMBER})°?, ?({_NUMBER})°?, ?({_NUMBER})")
_ANGLES = tuple(f"gimbal_{angle}_deg" for angle in _PRY)


def find_subtitles(video: Path) -> Path | None:
    """Returns the file of subtitles beside a video; None where there is none."""
    beside = (video.with_suffix(suffix) for suffix in (".SRT", ".srt"))
    return next((path for path in beside if path.is_file()), None)


def stated_at_start(subtitles: Path, video: PhotoMetadata) -> PhotoMetadata:
    """Returns what subtitles state of a video's first frame, each number as soon as it is stated.

    A film's, which state nothing of it, leave the video as it is.

    Args:
        subtitles: As of ``find_subtitles``.
        video: Its name and size.
    """
    with subtitles.open("rb") as stream:
        text = stream.read(_MOST_BYTES).decode("utf-8", "replace")
    found: dict[str, Any] = {}
    for cue in islice(_cues(text), _FIRST_CUES):
        found = _stated(cue) | found
    if not any(found.get(name) for name in _ANGLES):  # zeros, wherever it looks
        found = {name: value for name, value in found.items() if name not in _ANGLES}
    if not found:  # of a film
        return video
    return PhotoMetadata(video.name, video.width, video.height, make="DJI", **found)


def _cues(text: str) -> Iterator[str]:
    """Yields the texts of subtitles, which follow a line of times."""
    yield from (part.partition("\n")[2] for part in re.split(r"-->", text)[1:])


def _stated(cue: str) -> dict[str, float]:
    named = ((_NAMES.get(name.lower()), number_of(number)) for name, number in _NAMED.findall(cue))
    found = {name: number for name, number in named if name is not None and number is not None}
    if match := _GPS.search(cue):
        found |= {"longitude_deg": float(match[1]), "latitude_deg": float(match[2])}
    if match := _GIMBAL.search(cue):
        found |= dict(zip(_ANGLES, map(float, match.groups()), strict=True))
    return found | place_of(found.pop("latitude_deg", None), found.pop("longitude_deg", None))
