"""Photos with masks traced by hand: a folder per place, ``photos`` and ``masks`` in it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from lodbench.errors import DatasetError

_ENDINGS = (".jpg", ".jpeg", ".png", ".tif", ".tiff")


def traced_photos(folder: Path) -> list[tuple[Path, Path]]:
    """Returns the photos of a folder and their masks, by place and name.

    Args:
        folder: Holds a folder per place with ``photos``, and ``masks`` (PNG, 255 = building, grey = not
            known) of their names; or a folder ``labelled`` of these.

    Raises:
        DatasetError: There are no photos, two of one name, or one has no mask.
    """
    root = folder / "labelled" if (folder / "labelled").is_dir() else folder
    photos = sorted(path for path in root.glob("*/photos/*") if path.suffix.lower() in _ENDINGS)
    if not photos:
        hint = "Put them in PLACE/photos, and their masks in PLACE/masks."
        if (root / "photos").is_dir():
            hint = f"It is one place: name the folder that holds it, {root.parent}."
        raise DatasetError(f"{folder} holds no photos.", hint)
    masks = Counter(map(traced_mask, photos))
    for photo in photos:
        if masks[traced_mask(photo)] > 1:
            raise DatasetError(f"{photo} and another photo share a name: their masks would be one.")
    pairs = [(photo, traced_mask(photo)) for photo in photos]
    for photo, mask in pairs:
        if not mask.is_file():
            raise DatasetError(f"{photo} has no mask.", f"Trace one as {mask}: 255 = building.")
    return pairs


def traced_mask(photo: Path) -> Path:
    """Returns the file of a photo's mask."""
    return photo.parent.parent / "masks" / f"{photo.stem}.png"
