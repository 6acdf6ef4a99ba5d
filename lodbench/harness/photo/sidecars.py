"""XMP beside photos that were placed, where it was asked for."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lodbench.datasets.exchange.xmp_sidecar import write_sidecar
from lodbench.datasets.map_frame import MapFrame
from lodbench.errors import DatasetError
from lodbench.geometry import Pose
from lodbench.storage import can_write


def frame_on_earth(crs: str | None) -> MapFrame:
    """Returns the frame that sidecars are written in.

    Raises:
        DatasetError: Nobody knows where on Earth the city is.
    """
    if crs is None:
        raise DatasetError(
            "Without a reference system of the city, --sidecars have nothing to say.", "Name it with --crs."
        )
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

    Args:
        placed: Photos and their poses in the city's coordinates.
        crs: Of these.

    Raises:
        DatasetError: Nobody knows where on Earth the city is.
    """
    frame, written, left = frame_on_earth(crs), 0, []
    for photo, pose in placed:
        if write_sidecar(photo, pose, frame) is None:
            left.append(photo.with_suffix(".xmp").name)
        else:
            written += 1
    listed = ", ".join(left[:3]) + (", ..." if len(left) > 3 else "")
    others = f"; {len(left)} of other programs left alone: {listed}" if left else ""
    return f"{written} written beside the photos{others}"
