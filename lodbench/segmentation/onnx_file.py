"""Networks in ONNX files, run by OpenCV: no torch, nothing unpickled, no other file opened."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.datasets.pictures import opencv_silenced
from lodbench.errors import ConfigError
from lodbench.segmentation.onnx_check import onnx_fault
from lodbench.storage.contents import read_content

# The largest network that is run here has 0.3 GB.
_MAX_BYTES = 2 * 10**9
# A reader that takes longer, seconds, will not end.
_PROBE_S = 120.0
# Beyond what the file itself takes: importing OpenCV maps 1.5 GB.
_PROBE_BYTES = 8 << 30
_PROBE = """
import sys, cv2, numpy
content = sys.stdin.buffer.read()
try:
    import resource
    most = resource.getrlimit(resource.RLIMIT_AS)[1]
    wanted = int(sys.argv[1]) + 4 * len(content)
    wanted = wanted if most == resource.RLIM_INFINITY else min(wanted, most)
    resource.setrlimit(resource.RLIMIT_AS, (wanted, most))
except ImportError:
    pass
try:
    network = cv2.dnn.readNetFromONNX(numpy.frombuffer(content, numpy.uint8))
    network.setInput(numpy.zeros((1, 3, 64, 64), numpy.float32))
    network.forward()
except MemoryError:
    sys.exit(4)
except cv2.error as error:
    sys.exit(4 if error.code == cv2.Error.StsNoMem else 3)
"""


def read_onnx(path: Path, hint: str, is_ours: bool = False, digest: str | None = None) -> Any:
    """Returns OpenCV's network of a file.

    OpenCV's reader dies of some damage that ``onnx_fault`` does not see (ADR 0022): a file that is not ours
    is read, and asked about a small picture, in a process of its own first.

    Args:
        path: The file; its name may hold what OpenCV's own reader cannot open.
        hint: Where to get a proper one.
        is_ours: It came with the package: believed.
        digest: SHA-256 that answers are kept under; None for any.

    Raises:
        InputChanged: The file is another than that of the digest.
        ConfigError: It cannot be read, holds what a network in one file never does, or nothing that OpenCV
            can run.
    """
    import cv2

    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ConfigError(f"{path} has {path.stat().st_size / 1e9:.1f} GB, too many for a network.", hint)
        content = read_content(path, digest)
        fault = "" if is_ours else onnx_fault(content) or _probed(content)
        if fault:
            raise ConfigError(f"{path} is not a safe ONNX network: {fault}.", hint)
        with opencv_silenced():
            return cv2.dnn.readNetFromONNX(np.frombuffer(content, np.uint8))
    except (cv2.error, OSError) as error:
        raise ConfigError(f"{path} is not an ONNX network that OpenCV can read.", hint) from error


def _probed(content: bytes) -> str:
    """Returns how OpenCV's reader ends in a process of its own, unless with an answer or an error."""
    command = [sys.executable, "-I", "-c", _PROBE, str(_PROBE_BYTES)]
    try:
        done = subprocess.run(command, input=content, capture_output=True, timeout=_PROBE_S)  # noqa: S603
    except subprocess.TimeoutExpired:
        return "OpenCV's reader does not end"
    if done.returncode == 4:
        return "it takes too much memory"
    return "" if done.returncode in (0, 3) else "OpenCV's reader breaks down"
