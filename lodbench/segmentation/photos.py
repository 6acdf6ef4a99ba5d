"""Photos as segmenters see them: any image file as 8 bit RGB."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import QueryFault


def read_photo(path: str | Path) -> NDArray[np.uint8]:
    """Returns an image file as (H, W, 3) uint8 RGB, in the order of its pixels in the file.

    16 bits are brought to 8 over the range in use, grey is repeated, transparent pixels show black.
    A turn that EXIF asks for is not made: the camera and its pose are those of the file's pixels.

    Raises:
        QueryFault: The file is missing or no image, or has neither 8 nor 16 bits.
    """
    import cv2

    name = Path(path).name
    try:
        content = np.frombuffer(Path(path).read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise QueryFault(f"photo {name} cannot be read: {error.strerror}") from error
    try:
        image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if len(content) else None
    except cv2.error:
        image = None
    if image is None or str(image.dtype) not in ("uint8", "uint16"):
        raise QueryFault(f"photo {name} is not a readable 8 or 16 bit image")
    return as_rgb(np.asarray(image))


def as_rgb(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Returns a decoded image, (H, W) or (H, W, 1 to 4) uint8 or uint16 in OpenCV's order, as RGB."""
    if image.dtype == np.uint16:
        # A thermal or raw-like picture uses a small part of 16 bits: its own range is what is there to see.
        low, high = int(image.min()), int(image.max())
        image = ((image.astype(np.float32) - low) * (255.0 / max(high - low, 1)) + 0.5).astype(np.uint8)
    if image.ndim == 2:
        image = image[:, :, None]
    channels = image.shape[2]
    if channels in (2, 4):
        alpha = image[:, :, -1:].astype(np.float32) / 255.0
        image = (image[:, :, :-1] * alpha + 0.5).astype(np.uint8)
    if image.shape[2] == 1:
        return np.ascontiguousarray(np.repeat(image, 3, axis=2))
    return np.ascontiguousarray(image[:, :, ::-1])
