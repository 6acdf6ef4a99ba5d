"""XMP beside photos that were placed, where it was asked for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from lodbench.datasets.exchange.xmp_sidecar import write_sidecar
from lodbench.errors import DatasetError
from lodbench.geometry import Pose
from lodbench.photos.map_frame import MapFrame
from lodbench.storage import can_write


def frame_on_earth(crs: str | None) -> MapFrame:
    """Returns the frame that sidecars are written in.

    Raises:
        DatasetError: Nobody knows where on Earth the city is.
    """
    if crs is None:
        raise DatasetError("--sidecars need a city with a reference system.", "Name it with --crs.")
    return MapFrame(crs)


def require_sidecars(crs: str | None, folders: Iterable[Path]) -> None:
    """Makes sure, before any work, that sidecars of photos in some folders can be written.

    Raises:
        DatasetError: A folder takes no files, or as ``frame_on_earth``.
    """
    frame_on_earth(crs)
    for folder in folders:
        if not can_write(folder):
            raise DatasetError(
                f"Nothing can be written beside the photos in {folder}.", "Leave --sidecars out."
            )


def write_sidecars(placed: Iterable[tuple[Path, Pose]], crs: str | None) -> str:
    """Writes ``PHOTO.xmp`` beside each photo; returns a line that says how many, and which were left alone.

    Of photos that differ in their ending alone, which would share one file, none gets any.

    Args:
        placed: Photos and their poses in the city's coordinates.
        crs: Of these.

    Raises:
        DatasetError: Nobody knows where on Earth the city is.
    """
    frame, placed = frame_on_earth(crs), list(placed)
    claims = Counter(photo.with_suffix(".xmp") for photo, _ in placed)
    written, left = 0, []
    for photo, pose in placed:
        if claims[photo.with_suffix(".xmp")] == 1:
            if write_sidecar(photo, pose, frame) is None:
                left.append(photo.with_suffix(".xmp"))
            else:
                written += 1
    shared = [path for path, count in claims.items() if count > 1]
    return (
        f"{written} written beside the photos"
        + _listed("of other programs left alone", left)
        + _listed("not written, which several photos would share", shared)
    )


def _listed(what: str, files: list[Path]) -> str:
    names = ", ".join(file.name for file in files[:3]) + (", ..." if len(files) > 3 else "")
    return f"; {len(files)} {what}: {names}" if files else ""
