"""Where a mask to correct comes from, and where it goes."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import DatasetError
from lodbench.harness.mask.session import MaskSession
from lodbench.harness.tracebacks import told_as_fault
from lodbench.photos.metadata import read_photo_metadata
from lodbench.reporting.overlays import write_picture
from lodbench.segmentation import Segmenter, binary_mask
from lodbench.segmentation.masks import read_mask
from lodbench.segmentation.photo_segmenter import photo_probability
from lodbench.segmentation.photos import read_photo
from lodbench.segmentation.polygon_files import polygon_file, polygon_text, read_polygons
from lodbench.storage import write_text

Mask = NDArray[np.bool_]


def opened_session(
    photo: Path, mask: Path | None, polygons: Path | None, segmenter: Segmenter | None
) -> MaskSession:
    """Returns the session of a photo, started from the first that is given; from an empty mask without any.

    Raises:
        LodbenchError: The photo, the mask or the polygons cannot be read, or do not fit each other, or the
            segmenter's own code raised: where is kept beside the photo.
    """
    pixels = read_photo(photo)
    height, width = pixels.shape[:2]
    if polygons is not None:
        return MaskSession(pixels, read_polygons(polygons, photo.name, height, width))
    if mask is not None:
        given = read_mask(mask)
        if given.shape != (height, width):
            size = f"{given.shape[1]} x {given.shape[0]}"
            raise DatasetError(
                f"{mask.name} has {size} pixels, the photo {width} x {height}.",
                "A mask to correct has the size of its photo.",
            )
        return MaskSession(pixels, np.asarray(given >= 0.5))
    if segmenter is not None:
        with told_as_fault(f"segmenter {segmenter.name}", photo.parent, photo.name):
            probability = photo_probability(segmenter, photo)
        return MaskSession(pixels, binary_mask(probability, width, height))
    return MaskSession(pixels, np.zeros((height, width), bool))


def require_unturned(photo: Path, formats: tuple[str, ...], polygons: Path | None) -> None:
    """Makes sure that other programs see a photo's pixels where the mask has them.

    LabelMe and most others turn a photo for display as EXIF says; masks are of the stored pixels. Of a photo
    that stands on its head nothing else would tell: its size is the same.

    Args:
        photo: The file.
        formats: Polygons that will be written.
        polygons: Those that are read, or None.

    Raises:
        DatasetError: The photo is turned, and polygons come or go.
    """
    if polygons is None and not {"labelme", "coco"}.intersection(formats):
        return
    try:
        orientation = read_photo_metadata(photo).orientation
    except DatasetError:  # a format without such a tag, or a header that nobody can read
        return
    if orientation > 1:
        raise DatasetError(
            f"Other programs turn {photo.name} for display (EXIF orientation {orientation}), so polygons "
            "would lie elsewhere.",
            "Draw on the page: lodbench mask PHOTO; or take a copy of the photo without that tag.",
        )


def require_untouched(out: Path, photo: Path, formats: tuple[str, ...], polygons: Path | None) -> None:
    """Makes sure that no polygons are replaced that another program has written since the mask was saved.

    Args:
        out: The mask.
        photo: Its photo.
        formats: Of the polygons that will be written beside it.
        polygons: What the mask starts from, if from polygons: they may be replaced.

    Raises:
        DatasetError: Some would be.
        QueryFault: The mask cannot be read.
    """
    for name in formats:
        file = polygon_file(out, name)
        if not file.exists() or (polygons is not None and polygons.exists() and polygons.samefile(file)):
            continue
        before = np.asarray(read_mask(out) >= 0.5) if out.exists() else None
        if before is None or file.read_bytes() != polygon_text(name, before, photo.name).encode():
            back = (
                "move it away" if name == "geojson" else f"bring it back: --import {shlex.quote(str(file))}"
            )
            raise DatasetError(
                f"{file} is not as it was exported, and would be replaced.",
                f"Save elsewhere: --out OTHER.png; or {back}",
            )


class Untouched:
    """Files that a page will replace: as they were when it began, or when it last saved.

    Another program, or another page of the same photo, may write them while the page is open.

    Args:
        out: The mask.
        formats: Of the polygons beside it.
    """

    def __init__(self, out: Path, formats: tuple[str, ...]) -> None:
        self._files = (out, *(polygon_file(out, name) for name in formats))
        self.remember()

    def remember(self) -> None:
        """Takes the files as they are now."""
        self._contents = [_content(file) for file in self._files]

    def require(self, hint: str) -> None:
        """Makes sure that nobody else has written a file since; asked again, they may be replaced.

        Args:
            hint: What to do about it.

        Raises:
            DatasetError: Somebody has.
        """
        before = self._contents
        self.remember()
        for file, old, new in zip(self._files, before, self._contents, strict=True):
            if new is not None and new != old:
                raise DatasetError(
                    f"{file.name} was written by another program since it was read or saved here.",
                    hint,
                )


def _content(file: Path) -> bytes | None:
    try:
        return file.read_bytes()
    except OSError:
        return None  # not there, or nothing that could be replaced: writing tells


def saved(mask: Mask, photo: Path, out: Path, formats: tuple[str, ...]) -> tuple[Path, ...]:
    """Writes a mask as PNG, and as polygons beside it; returns the files."""
    out.parent.mkdir(parents=True, exist_ok=True)
    white = mask.astype(np.uint8) * np.uint8(255)
    write_picture(out, np.repeat(white[..., None], 3, axis=2))
    written = [out]
    for name in formats:
        written.append(polygon_file(out, name))
        write_text(written[-1], polygon_text(name, mask, photo.name))
    return tuple(written)
