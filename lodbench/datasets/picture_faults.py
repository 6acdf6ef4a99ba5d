"""Whether photos and masks fit their cameras, by their headers, and are whole."""

from __future__ import annotations

import warnings
from pathlib import Path

from lodbench.datasets.pictures import picture_size
from lodbench.datasets.query import Entry

# Beyond this a mask shows another part of the scene; ``check_mask`` holds the decoded ones to the same.
_ASPECT_TOLERANCE = 0.02


def photo_fault(entry: Entry) -> str:
    """Returns why a query's photo cannot be used; "" if it can, or if there is none."""
    if entry.image is None or entry.camera is None:
        return ""
    size, camera = picture_size(entry.image), (entry.camera.width, entry.camera.height)
    if size is None:
        return f"the photo {entry.image.name} cannot be read"
    if size != camera:
        return f"the photo is {size[0]} x {size[1]}, its intrinsics are of {camera[0]} x {camera[1]}"
    return ""


def mask_fault(mask: Path, size: tuple[int, int]) -> str:
    """Returns why a mask's file does not fit a photo of some width and height; "" if it does."""
    found = picture_size(mask)
    if found is None:
        return f"the mask {mask.name} cannot be read"
    return aspect_fault(found, size)


def aspect_fault(found: tuple[int, int], size: tuple[int, int]) -> str:
    """Returns why a mask of some width and height does not fit a photo of another; "" if it does."""
    width, height = found
    apart = abs((width / height) / (size[0] / size[1]) - 1.0)
    # Sides are whole: of a photo a few pixels wide, rounding alone changes the aspect by more.
    if apart > max(_ASPECT_TOLERANCE, 0.5 / width, 0.5 / height):
        return f"the mask is {width} x {height}, the photo {size[0]} x {size[1]}: another aspect"
    return ""


def is_decodable(path: Path) -> bool:
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
