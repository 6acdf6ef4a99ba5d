"""What a reader should know of the places and heights that photos state, a sentence each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from lodbench.photos.map_frame import MapFrame
from lodbench.photos.metadata import PhotoMetadata
from lodbench.photos.pose import HeightOptions, height_doubt

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
    is_told = options.source != "auto" or options.takeoff_m is not None
    doubts = [doubt for doubt in map(height_doubt, photos) if doubt]
    if not doubts or is_told:
        return None
    return (
        f"heights of {len(doubts)} of {len(photos)} photos are taken as above sea level, and may be above "
        f"the ellipsoid ({'; '.join(dict.fromkeys(doubts))}); --heights says which"
    )
