"""Networks in ONNX files, run by OpenCV: no torch, nothing unpickled."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lodbench.errors import ConfigError


def read_onnx(path: Path, hint: str) -> Any:
    """Returns OpenCV's network of a file.

    Args:
        path: The file; its name may hold what OpenCV's own reader cannot open.
        hint: Where to get a proper one.

    Raises:
        ConfigError: It cannot be read, or holds no network that OpenCV can run.
    """
    import cv2

    try:
        return cv2.dnn.readNetFromONNX(np.frombuffer(path.read_bytes(), np.uint8))
    except (cv2.error, OSError) as error:
        raise ConfigError(f"{path} is no ONNX network that OpenCV can read.", hint) from error
