"""Are a dataset's photos and masks sound: headers, sizes, pixels, and whether photos say where they are."""

from __future__ import annotations

from lodbench.datasets.codes import GPS_IN_IMAGE, IMAGE_SIZE, IMAGE_UNREADABLE, MASK_UNFIT
from lodbench.datasets.photo_metadata import read_photo_metadata
from lodbench.datasets.picture_faults import is_decodable, mask_fault
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
    if with_pixels and not is_decodable(entry.image):
        findings.add(IMAGE_UNREADABLE, entry.key, f"{entry.image} is damaged or cut off")
