"""Are a dataset's photos and masks sound: headers, sizes, pixels, and whether photos say where they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from lodbench.datasets.faults import (
    GPS_IN_IMAGE,
    IMAGE_SIZE,
    IMAGE_UNREADABLE,
    MASK_UNFIT,
    is_decodable,
    mask_fault,
)
from lodbench.datasets.inputs import read_classes, read_labels
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError, QueryFault
from lodbench.execution import Progress
from lodbench.findings import Findings
from lodbench.photos.metadata import read_photo_metadata
from lodbench.segmentation.masks import read_mask


def check_photos(dataset: Dataset, with_pixels: bool, findings: Findings) -> None:
    """Adds what is wrong with a dataset's photos and masks to findings.

    Args:
        dataset: As opened.
        with_pixels: Whether to decode every photo and mask; their headers are read in any case.
        findings: Receives them, under the queries' names.
    """
    for entry in dataset.entries:
        for fault in _mask_faults(entry, with_pixels):
            findings.add(MASK_UNFIT, entry.key, fault)
    entries = [entry for entry in dataset.entries if entry.image is not None]
    with Progress("photos", len(entries)) as progress:
        for entry in entries:
            _check_photo(entry, with_pixels, findings)
            progress.advance()


def _mask_faults(entry: Entry, with_pixels: bool) -> Iterator[str]:
    """Yields what is wrong with a query's mask, and with its labels of single buildings and of surfaces."""
    readers: tuple[tuple[Path | None, Callable[[Path], object]], ...] = (
        (entry.mask, read_mask),
        (entry.instances, read_labels),
        (entry.classes, read_classes),
    )
    for file, read in readers:
        if file is None:
            continue
        size = None if entry.camera is None else (entry.camera.width, entry.camera.height)
        fault = "" if size is None else mask_fault(file, size)
        if not fault and with_pixels:
            try:
                read(file)
            except QueryFault as error:
                fault = error.message
        if fault:
            yield fault


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
