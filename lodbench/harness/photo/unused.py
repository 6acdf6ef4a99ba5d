"""What photos have that a command does not use, in words: saved masks, and headings of their own."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from lodbench.errors import DatasetError
from lodbench.photos.files import mask_name
from lodbench.photos.metadata import read_photo_metadata
from lodbench.reporting.aligned_text import count_of


def saved_masks_note(photos: Sequence[Path]) -> str | None:
    """Returns that masks saved beside photos are not used; None where there are none."""
    saved = [mask for photo in photos if (mask := photo.with_name(mask_name(photo.stem))).is_file()]
    if not saved:
        return None
    if len(photos) == 1:
        return f"The mask beside the photo is not used; use it with --mask {shlex.quote(str(saved[0]))}."
    folders = {mask.parent for mask in saved}
    folder = shlex.quote(str(saved[0].parent)) if len(folders) == 1 else "DIR"
    return f"Masks beside {len(saved)} of the photos are not used; use them with --masks {folder}."


def heading_note(photos: Sequence[Path], heading_deg: float | None) -> str | None:
    """Returns that a heading given takes the place of those which several photos state; None otherwise."""
    if heading_deg is None or len(photos) < 2:
        return None
    stated = 0
    for photo in photos:
        try:
            stated += read_photo_metadata(photo).gimbal_yaw_deg is not None
        except DatasetError:  # the answer for that photo says so
            continue
    if not stated:
        return None
    return f"--heading {heading_deg:g} overrides the heading in the metadata of {count_of(stated, 'photos')}."
