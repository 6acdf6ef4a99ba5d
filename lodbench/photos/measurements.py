"""What was measured beside a photo, with standard deviations: of its prior's numbers, a range, a height.

They come from a photo's XMP (``measured_of``) or from a line of a dataset's ``measurements.txt``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import LodbenchError, nearest_names
from lodbench.photos.metadata import PhotoMetadata
from lodbench.photos.pose import HeightOptions, height_doubt
from lodbench.photos.xmp import LaserRange

Floats = NDArray[np.float64]

# What the prior's numbers are called, in the order of pose vectors: x, y, z, pitch, roll, yaw.
AXES = ("east", "north", "up", "pitch", "roll", "heading")
_NONE: tuple[float | None, ...] = (None,) * 6
# Standard deviations of a height above the take-off point by air pressure within one flight, metres, and of
# what a receiver's coordinates and a map's may differ by along each axis: EPSG states 1 m for WGS 84 in
# national frames.
BAROMETER_M, FRAME_M = 0.5, 1.0
# Larger numbers measure nothing: metres or degrees, and seconds.
_MOST_SIGMA, _MOST_M, _MOST_S = 360.0, 1e5, 1e11


@dataclass(frozen=True, slots=True)
class Measurements:
    """What was measured beside one photo.

    Attributes:
        sigmas: (6,) standard deviations of the prior's x, y, z (metres), pitch, roll, yaw (degrees); None
            where nobody states one.
        laser: A range along the ray of the photo's centre.
        takeoff_height_m: Height above the take-off point, by air pressure.
        takeoff_sigma_m: Its standard deviation within one flight.
        time_s: When it was taken, seconds from any moment of its flight.
    """

    sigmas: tuple[float | None, ...] = _NONE
    laser: LaserRange | None = None
    takeoff_height_m: float | None = None
    takeoff_sigma_m: float = BAROMETER_M
    time_s: float | None = None

    def over(self, sigmas: Floats) -> Floats:
        """Returns (6,) deviations, the stated ones instead of given ones."""
        return np.array([own if s is None else s for s, own in zip(self.sigmas, sigmas, strict=True)])

    def without_sigmas(self, axes: Sequence[int] = range(6)) -> Measurements:
        """Returns what is measured beside another prior, in some of its numbers: no deviation of these."""
        return replace(self, sigmas=tuple(None if k in axes else s for k, s in enumerate(self.sigmas)))

    @property
    def note(self) -> str:
        """Returns a sentence on the deviations of the prior that the search goes by; "" for none."""
        units = ("m", "m", "m", "deg", "deg", "deg")
        known = zip(AXES, self.sigmas, units, strict=True)
        listed = ", ".join(f"{name} {sigma:.2g} {unit}" for name, sigma, unit in known if sigma is not None)
        return f"the rough pose is known to {listed} (standard deviations)" if listed else ""

    def words(self) -> list[str]:
        """Returns it in words of a text file, with as many digits as restore it."""
        found = {name: s for name, s in zip(AXES, self.sigmas, strict=True) if s is not None}
        if self.laser is not None:
            found |= {"range": self.laser.range_m, "sigma_range": self.laser.sigma_m}
        if self.takeoff_height_m is not None:
            found |= {"takeoff": self.takeoff_height_m, "sigma_takeoff": self.takeoff_sigma_m}
        if self.time_s is not None:
            found |= {"time": self.time_s}
        return [f"{name}={float(value)!r}" for name, value in found.items()]


_WORDS = (*AXES, "range", "sigma_range", "takeoff", "sigma_takeoff", "time")


def parse_measurements(words: Sequence[str]) -> Measurements:
    """Returns what the words of a line state: ``east=0.02 north=0.02 up=0.03 range=81.2 sigma_range=0.3``.

    ``pitch``, ``roll`` and ``heading`` are deviations too; ``takeoff=80.1 sigma_takeoff=0.5`` is a height,
    ``time=12.5`` when it was taken.

    Raises:
        LodbenchError: A word is unknown or given twice, a number is none, a deviation or range is not above
            0, or a deviation stands without what it is of.
    """
    given: dict[str, float] = {}
    for word in words:
        name, _, text = word.partition("=")
        if name not in _WORDS:
            raise LodbenchError(f"{word!r} is no measurement", nearest_names(name, _WORDS))
        if name in given:
            raise LodbenchError(f"{name} is given twice")
        given[name] = _number(name, text)
    for name in ("range", "takeoff"):
        if f"sigma_{name}" in given and name not in given:
            raise LodbenchError(f"sigma_{name} is of no {name}")
    laser = LaserRange(given["range"], stated_sigma_m=given.get("sigma_range")) if "range" in given else None
    return Measurements(
        tuple(given.get(name) for name in AXES),
        laser,
        given.get("takeoff"),
        given.get("sigma_takeoff", BAROMETER_M),
        given.get("time"),
    )


def _number(name: str, text: str) -> float:
    most = {"range": _MOST_M, "takeoff": _MOST_M, "time": _MOST_S}.get(name, _MOST_SIGMA)
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    least = -most if name in ("takeoff", "time") else 0.0
    if not least < number <= most:
        raise LodbenchError(f"{name}={text} is not above {least:g} and at most {most:g}")
    return number


def measured_of(
    photo: PhotoMetadata, heights: HeightOptions, given: Sequence[int] = ()
) -> Measurements | None:
    """Returns what a photo states beside its pixels; None where it states nothing of it.

    The deviations of a receiver are those of its coordinates: by ``FRAME_M`` the map's may differ from them.

    Args:
        photo: What the photo states.
        heights: How its height became the prior's: above the take-off point, or in doubt, it is not the
            receiver's.
        given: Which of the prior's six numbers are not the photo's own.
    """
    wrong = [*given, *([3, 4, 5] if photo.gimbal_yaw_deg is None else [])]
    if heights.source_for(photo) == "takeoff" or height_doubt(photo):
        wrong.append(2)
    sigmas = [s if s is None or k > 2 else math.hypot(s, FRAME_M) for k, s in enumerate(photo.sigmas)]
    found = Measurements(tuple(sigmas), photo.laser, photo.relative_altitude_m).without_sigmas(wrong)
    return None if found == Measurements() else found
