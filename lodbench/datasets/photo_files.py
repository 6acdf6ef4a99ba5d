"""Which files of a folder are photos, and what they are called in lines of poses."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from lodbench.errors import DatasetError
from lodbench.storage import file_digest
from lodbench.storage.json_text import parse_json

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


def in_pose_lines(name: str) -> str:
    """Returns a name without what lines of poses cannot hold: spaces, and bytes that are no UTF-8."""
    return re.sub(r"[\s\ud800-\udfff]+", "_", name)


def find_photos(folder: Path, masks: Path | None = None, *others: Path | None) -> list[Path]:
    """Returns the photos of a folder and all below it, by name; or the one photo a path names.

    Masks that ``lodbench mask`` put beside them, overlays of ``lodbench localize``, and what macOS keeps of
    photos (``._NAME``), are none.

    Args:
        folder: The folder, or one photo.
        masks: Folder of masks, whose pictures are no photos; or None. If the photos lie in it, too, their
            masks are those that ``lodbench mask`` saved, and a PNG beside a photo in another format.
        others: More such folders, if they are below it: unused masks, results of an earlier command.

    Raises:
        DatasetError: There are none.
    """
    if folder.is_file():
        return [folder]
    pictures = (path for path in folder.rglob("*") if path.suffix.lower() in PHOTO_SUFFIXES)
    # macOS keeps files of its own beside photos that it copies to a card, in the same ending.
    found = sorted(path for path in pictures if not path.name.startswith("._") and not path.is_dir())
    if not found:
        raise DatasetError(f"{folder} holds no photos.", f"Looked for {', '.join(PHOTO_SUFFIXES)} files.")
    asked = [other.resolve() for other in (masks, *others) if other is not None]
    aside = [other for other in asked if not folder.resolve().is_relative_to(other)]
    are_photos = {
        parent: not any(parent.resolve().is_relative_to(other) for other in aside)
        for parent in {path.parent for path in found}
    }
    photos = [path for path in found if are_photos[path.parent]]
    made = {path.with_name(mask_name(path.stem)) for path in photos}
    if masks is not None and masks.resolve() not in aside:
        made |= {path.with_suffix(".png") for path in photos if path.suffix.lower() != ".png"}
    return [path for path in photos if path not in made and not _is_overlay(path)]


def _is_overlay(path: Path) -> bool:
    """Tells whether ``lodbench localize`` wrote a picture: with the answer beside it."""
    label = path.name.removesuffix("_overlay.png")
    if label == path.name:
        return False
    try:
        answer = parse_json(path.with_name(f"{label}.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    # Others put polygons into a file of that name.
    return isinstance(answer, dict) and "sha256" in answer and "pose" in answer


def mask_names(photo: str) -> tuple[str, ...]:
    """Returns what the mask of a photo of a name may be called in a folder of masks, in the order tried."""
    stem = PurePosixPath(photo).stem
    return photo, f"{stem}.png", mask_name(stem)


def mask_name(stem: str) -> str:
    """Returns what ``lodbench mask`` calls a photo's mask, which it puts beside it."""
    return f"{stem}_mask.png"


def require_photos(photos: Sequence[Path], source: Path) -> None:
    """Makes sure that a folder holds more than masks and results.

    Raises:
        DatasetError: There are no photos.
    """
    if not photos:
        raise DatasetError(
            f"{source} holds no photos outside the folders of masks and results.",
            "Put the masks into a folder of their own.",
        )


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
