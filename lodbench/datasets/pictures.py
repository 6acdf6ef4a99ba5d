"""Pixels from files: read through numpy, since OpenCV's own file call cannot open every path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def read_picture(path: Path, *, as_stored: bool = False) -> NDArray[Any] | None:
    """Returns a picture's pixels, unturned: intrinsics belong to the pixels as they are stored.

    Args:
        path: The file.
        as_stored: With its own channels and depth; else as (H, W, 3) BGR of 8 bits.

    Returns:
        (H, W) or (H, W, C); None if the file cannot be read or decoded.
    """
    import cv2

    try:
        content = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError:
        return None
    if len(content) == 0:
        return None
    flags = cv2.IMREAD_UNCHANGED if as_stored else cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        picture = cv2.imdecode(content, flags)
    except cv2.error:
        return None
    return None if picture is None else np.asarray(picture)
