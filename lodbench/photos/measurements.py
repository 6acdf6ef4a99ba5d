"""What was measured beside a photo, and what a reader should know of places and heights that photos state.

Measurements have standard deviations: of the prior's numbers, a range, a height. They come from a photo's XMP
(``measured_of``) or from a line of a dataset's ``measurements.txt``. Notes are a sentence each.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import LodbenchError, nearest_names
from lodbench.photos.map_frame import MapFrame
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
    """What was measured beside one photo."""

    # (6,) standard deviations of the prior's x, y, z (metres), pitch, roll, yaw (degrees); None where nobody
    # states one
    sigmas: tuple[float | None, ...] = _NONE
    laser: LaserRange | None = None  # A range along the ray of the photo's centre
    takeoff_height_m: float | None = None  # height above the take-off point, by air pressure
    takeoff_sigma_m: float = BAROMETER_M  # its standard deviation within one flight
    time_s: float | None = None  # when it was taken, seconds from any moment of its flight

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
        numbers = {name: s for name, s in zip(AXES, self.sigmas, strict=True) if s is not None}
        if self.laser is not None:
            numbers |= {"range": self.laser.range_m, "sigma_range": self.laser.sigma_m}
        if self.takeoff_height_m is not None:
            numbers |= {"takeoff": self.takeoff_height_m, "sigma_takeoff": self.takeoff_sigma_m}
        if self.time_s is not None:
            numbers |= {"time": self.time_s}
        return [f"{name}={float(value)!r}" for name, value in numbers.items()]


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
    measured = Measurements(tuple(sigmas), photo.laser, photo.relative_altitude_m).without_sigmas(wrong)
    return None if measured == Measurements() else measured


# A datum shift known no better than this is worth telling.
_TELL_ACCURACY_M = 2.0


def xmp_note(photos: Iterable[PhotoMetadata]) -> str | None:
    """Returns a sentence if what some photos' XMP says could not be read, and so was not used."""
    broken = [photo for photo in photos if photo.xmp_fault]
    if not broken:
        return None
    count = "its" if len(broken) == 1 else f"{len(broken)} photos'"
    return f"{count} XMP cannot be read, and nothing of it was used: {broken[0].xmp_fault}"


def refused_notes(photos: Sequence[PhotoMetadata]) -> tuple[str, ...]:
    """Returns which measurements that photos state were not used, a sentence for each reason."""
    counts = Counter(reason for photo in photos for reason in photo.refused)
    of_all = "" if len(photos) == 1 else f" of {len(photos)} photos"
    return tuple(f"{reason}: not used{of_all and f' ({count}{of_all})'}" for reason, count in counts.items())


def datum_note(frame: MapFrame) -> str | None:
    """Returns a sentence if the step from GPS to the city's datum may be off by metres."""
    accuracy = frame.accuracy_m
    if accuracy is not None and accuracy <= _TELL_ACCURACY_M:
        return None
    known = "unknown here" if accuracy is None else f"{accuracy:g} m"
    return f"the accuracy of the step from WGS 84 to {frame.crs} is {known} (PROJ_NETWORK=ON may better it)"


def place_notes(
    frame: MapFrame | None, photos: Iterable[PhotoMetadata], options: HeightOptions | None = None
) -> tuple[str, ...]:
    """Returns what a reader should know of places and heights that were read from photos, a sentence each.

    Args:
        frame: The city's coordinates; None where nobody knows them on Earth.
        photos: Those whose stated heights were used.
        options: How the drone's heights became the city's.
    """
    photos, options = list(photos), options or HeightOptions()
    datum = None if frame is None else datum_note(frame)
    return tuple(filter(None, (datum, _geoid_note(photos, options), *height_notes(photos, options))))


def _geoid_note(photos: Sequence[PhotoMetadata], options: HeightOptions) -> str | None:
    """Returns a sentence if the geoid was given and heights of some photos are not taken as above it."""
    unused = sum(options.source_for(photo) == "sea_level" for photo in photos)
    if options.geoid_m is None or unused == 0:
        return None
    of_some = "" if unused == len(photos) else f" for {unused} of {len(photos)} photos"
    return (
        f"--geoid was not used{of_some}: heights are taken as above sea level without RTK; "
        "--heights ellipsoid uses it"
    )


def height_notes(photos: Sequence[PhotoMetadata], options: HeightOptions) -> tuple[str, ...]:
    """Returns what a reader should know of what photos' heights are taken as above, a sentence each."""
    return tuple(filter(None, (_mixed_note(photos, options), _doubt_note(photos, options))))


def _mixed_note(photos: Sequence[PhotoMetadata], options: HeightOptions) -> str | None:
    """Returns a sentence if heights of some photos are taken as above something else than those of others."""
    above_sea = sum(options.source_for(photo) == "sea_level" for photo in photos)
    if above_sea in (0, len(photos)):
        return None
    return (
        f"{above_sea} of {len(photos)} photos have no RTK solution, nor say that heights are above the "
        "ellipsoid: theirs are taken as above sea level, those of the others as above the ellipsoid; "
        "--heights says what all are"
    )


def _doubt_note(photos: Sequence[PhotoMetadata], options: HeightOptions) -> str | None:
    """Returns a sentence if heights may be above the ellipsoid though they are not taken so."""
    is_given = options.source != "auto" or options.takeoff_m is not None
    doubts = [doubt for doubt in map(height_doubt, photos) if doubt]
    if not doubts or is_given:
        return None
    return (
        f"heights of {len(doubts)} of {len(photos)} photos are taken as above sea level, and may be above "
        f"the ellipsoid ({'; '.join(dict.fromkeys(doubts))}); --heights says which"
    )
