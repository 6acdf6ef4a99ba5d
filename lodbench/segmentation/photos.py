"""Photos as segmenters see them: any image file as 8 bit RGB."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import QueryFault
from lodbench.photos.pictures import decoded, has_too_many_pixels, in_8_bits
from lodbench.storage.digest import read_content


def read_photo(path: str | Path) -> NDArray[np.uint8]:
    """Returns an image file as (H, W, 3) uint8 RGB, in the order of its pixels in the file.

    16 bits are brought to 8 over the range in use, grey is repeated, transparent pixels show black.
    A turn that EXIF asks for is not made: the camera and its pose are those of the file's pixels.

    Raises:
        QueryFault: The file is missing or no image, has too many pixels, or neither 8 nor 16 bits.
    """
    name = Path(path).name
    try:
        content = read_content(Path(path))
    except OSError as error:
        raise QueryFault(f"photo {name} cannot be read: {error.strerror}", "Check the path.") from error
    return photo_of(content, name)


def photo_of(content: bytes, name: str) -> NDArray[np.uint8]:
    """Returns the bytes of an image file as `read_photo` does.

    Raises:
        QueryFault: They are no image, have too many pixels, or neither 8 nor 16 bits nor, without alpha,
            floating-point numbers.
    """
    if has_too_many_pixels(content):
        raise QueryFault(f"photo {name} has too many pixels", "Scale it down.")
    image = decoded(content, as_stored=True)
    if image is None or not _is_photo(image):
        raise QueryFault(f"photo {name} is not a readable 8 or 16 bit image", "Is it a JPEG, PNG or TIFF?")
    return as_rgb(image)


def _is_photo(image: NDArray[Any]) -> bool:
    """Tells whether pixels can be brought to 8 bits; radiometric thermal photos have 32, floating-point."""
    has_alpha = image.ndim == 3 and image.shape[2] in (2, 4)
    return str(image.dtype) in ("uint8", "uint16") or (str(image.dtype) == "float32" and not has_alpha)


def as_rgb(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Returns a decoded image, (H, W) or (H, W, 1 to 4) in OpenCV's order, as RGB; float32 has no alpha."""
    if image.ndim == 2:
        image = image[:, :, None]
    has_alpha = image.shape[2] in (2, 4)
    colours, alpha = (image[:, :, :-1], image[:, :, -1:]) if has_alpha else (image, None)
    colours = in_8_bits(colours)
    if alpha is not None:
        share = alpha.astype(np.float32) / np.float32(np.iinfo(image.dtype).max)
        colours = (colours * share + 0.5).astype(np.uint8)
    image = colours
    if image.shape[2] == 1:
        return np.ascontiguousarray(np.repeat(image, 3, axis=2))
    return np.ascontiguousarray(image[:, :, ::-1])
