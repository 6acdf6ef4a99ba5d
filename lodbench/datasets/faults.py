"""Cameras that no photo has, and photos and masks that do not fit their cameras or are not whole."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

from lodbench.datasets.query import Entry
from lodbench.geometry import Camera
from lodbench.photos.camera import FIELD_DEG
from lodbench.photos.pictures import picture_size

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


# Pixels are square, to this factor.
_SQUARE = 1.5
# Principal points lie this near the middle, as a share of the side, and in no whole photo beyond the second.
_NEAR, _FAR = 0.05, 0.1
_CROPPED = 0.25


def field_fault(camera: Camera) -> str:
    """Returns why a camera's focal length is none of a photo; "" if it may be."""
    field = math.degrees(2 * math.atan(camera.width / (2 * camera.fx)))
    if not FIELD_DEG[0] <= field <= FIELD_DEG[1]:
        in_mm = " (is it in millimetres?)" if field > FIELD_DEG[1] else ""
        return f"a focal length of {camera.fx:.4g} px sees {field:.0f} degrees; no photo does{in_mm}"
    if not 1 / _SQUARE < camera.fx / camera.fy < _SQUARE:
        return f"fx is {camera.fx:.4g} and fy {camera.fy:.4g} px; pixels are square"
    return ""


def exchange_fault(camera: Camera) -> str:
    """Returns why cx and cy of a camera are exchanged; "" if they are not."""
    exchanged = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cy, camera.cx)
    if _off_middle(camera) > _FAR and _off_middle(exchanged) < _NEAR:
        return f"cx {camera.cx:.4g} and cy {camera.cy:.4g} of {camera.width} x {camera.height} are exchanged"
    return ""


def camera_fault(camera: Camera) -> str:
    """Returns why no photo was taken by a camera; "" if one may have been."""
    return field_fault(camera) or exchange_fault(camera)


def crop_doubt(camera: Camera) -> str:
    """Returns why a camera can only be of a crop; "" if it need not."""
    if _off_middle(camera) <= _CROPPED:
        return ""
    return f"cx {camera.cx:.4g}, cy {camera.cy:.4g} of {camera.width} x {camera.height}"


def _off_middle(camera: Camera) -> float:
    """Returns how far a principal point is from the middle, as a share of the side: the larger of both."""
    return max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))
