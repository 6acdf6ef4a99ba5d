"""Networks in ONNX files, run by OpenCV: no torch, nothing unpickled, no other file opened."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.errors import ConfigError
from lodbench.segmentation.onnx_check import onnx_fault
from lodbench.storage.contents import read_content

# The largest network that is run here has 0.3 GB.
_MAX_BYTES = 2 * 10**9
# A reader that takes longer, seconds, will not end.
_PROBE_S = 120.0
_PROBE = """
import sys, cv2, numpy
try:
    cv2.dnn.readNetFromONNX(numpy.frombuffer(sys.stdin.buffer.read(), numpy.uint8))
except cv2.error:
    sys.exit(3)
"""


def read_onnx(path: Path, hint: str, is_ours: bool = False) -> Any:
    """Returns OpenCV's network of a file.

    OpenCV's reader dies of some damage that ``onnx_fault`` does not see (ADR 0022): a file that is not ours
    is read in a process of its own first.

    Args:
        path: The file; its name may hold what OpenCV's own reader cannot open.
        hint: Where to get a proper one.
        is_ours: It came with the package: believed.

    Raises:
        ConfigError: It cannot be read, holds what a network in one file never does, or nothing that OpenCV
            can run.
    """
    import cv2

    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ConfigError(f"{path} has {path.stat().st_size / 1e9:.1f} GB, too many for a network.", hint)
        content = read_content(path)
        fault = "" if is_ours else onnx_fault(content) or _probed(content)
        if fault:
            raise ConfigError(f"{path} is no ONNX network to be trusted: {fault}.", hint)
        return cv2.dnn.readNetFromONNX(np.frombuffer(content, np.uint8))
    except (cv2.error, OSError) as error:
        raise ConfigError(f"{path} is no ONNX network that OpenCV can read.", hint) from error


def _probed(content: bytes) -> str:
    """Returns how OpenCV's reader ends in a process of its own, unless with an answer or an error."""
    command = [sys.executable, "-I", "-c", _PROBE]
    try:
        done = subprocess.run(command, input=content, capture_output=True, timeout=_PROBE_S)  # noqa: S603
    except subprocess.TimeoutExpired:
        return "OpenCV's reader does not end"
    return "" if done.returncode in (0, 3) else "OpenCV's reader breaks down"
