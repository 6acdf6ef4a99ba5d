"""Are a dataset's photos and masks sound: headers, sizes, pixels, and whether photos say where they are."""

from __future__ import annotations

import warnings
from pathlib import Path

from lodbench.datasets.codes import GPS_IN_IMAGE, IMAGE_SIZE, IMAGE_UNREADABLE, MASK_UNFIT
from lodbench.datasets.photo_metadata import read_photo_metadata
from lodbench.datasets.picture_faults import mask_fault
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError
from lodbench.execution import Progress
from lodbench.findings import Findings


def check_photos(dataset: Dataset, with_pixels: bool, findings: Findings) -> None:
    """Adds what is wrong with a dataset's photos and masks to findings.

    Args:
        dataset: As opened.
        with_pixels: Whether to decode every photo; their headers are read in any case.
        findings: Receives them, under the queries' names.
    """
    for entry in dataset.entries:
        if entry.mask is not None and entry.camera is not None:
            fault = mask_fault(entry.mask, (entry.camera.width, entry.camera.height))
            if fault:
                findings.add(MASK_UNFIT, entry.key, fault)
    entries = [entry for entry in dataset.entries if entry.image is not None]
    with Progress("photos", len(entries)) as progress:
        for entry in entries:
            _check_photo(entry, with_pixels, findings)
            progress.advance()


def _check_photo(entry: Entry, with_pixels: bool, findings: Findings) -> None:
    """Looks at one photo, its header first: pixels are decoded only if their number is sane."""
    assert entry.image is not None  # noqa: S101 - the caller has looked
    try:
        header = read_photo_metadata(entry.image)
    except DatasetError as error:
        findings.add(IMAGE_UNREADABLE, entry.key, error.message)
        return
    if header.has_position:
        findings.add(GPS_IN_IMAGE, entry.key)
    camera = entry.camera
    if camera is not None and (header.width, header.height) != (camera.width, camera.height):
        detail = f"{header.width} x {header.height}, intrinsics {camera.width} x {camera.height}"
        findings.add(IMAGE_SIZE, entry.key, detail)
    if with_pixels and not _is_decodable(entry.image):
        findings.add(IMAGE_UNREADABLE, entry.key, f"{entry.image} is damaged or cut off")


def _is_decodable(path: Path) -> bool:
    """Tells whether all of a picture is there; unlike OpenCV, Pillow does not pass a cut-off file."""
    from PIL import Image

    try:
        # The header has been read: beyond the warning, but not beyond the error.
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            # JPEG: an eighth of the size, which still reads the file to its end.
            image.draft("L", (max(1, image.width // 8), max(1, image.height // 8)))
            image.load()
    except Exception:  # Pillow lets the errors of its decoders through
        return False
    return True
