"""Which files are copies of one photo: a flight would count it twice, and be the surer."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from lodbench.storage import file_digest


def copies_among(
    photos: Sequence[Path], masks: Sequence[Path | None]
) -> tuple[dict[int, str], dict[int, str]]:
    """Returns by row which photo another is a copy of, and why others cannot be read, in words.

    The original is one that has a mask, if any has, of the shortest name: copies are called ``NAME (1)``,
    which comes before ``NAME`` in a folder, and masks go by the name of the original.

    Args:
        photos: The files.
        masks: The mask of each, or None.
    """
    unreadable: dict[int, str] = {}
    same: dict[str, list[int]] = defaultdict(list)
    for row, photo in enumerate(photos):
        try:
            same[file_digest(photo)].append(row)
        except OSError as error:
            unreadable[row] = f"it cannot be read: {error.strerror}"
    copies: dict[int, str] = {}
    for rows in same.values():
        original = min(rows, key=lambda row: (masks[row] is None, len(photos[row].name), row))
        copies |= {
            row: f"it is a copy of {photos[original]}" for row in rows if photos[row] != photos[original]
        }
    return dict(sorted(copies.items())), unreadable
