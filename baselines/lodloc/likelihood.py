"""The network on a photo: maps of how well a wireframe's line fits each place."""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError
from lodbench.segmentation.onnx_file import read_onnx
from lodbench.segmentation.probability import padded_photo, resized_photo

Map = NDArray[np.float32]
_STRIDE, _CHANNELS = 32, 10
_HINT = "lodbench train method=lodloc writes such files."


class Maps(NamedTuple):
    """Maps of one photo, (h, w) float32, without padding.

    Attributes:
        stages: Log-likelihoods at a quarter, a half and the full working size.
        refinement: At full size, 0 on the wireframe.
    """

    stages: tuple[Map, Map, Map]
    refinement: Map


def weights_file(weights: str | None) -> Path:
    """Returns the file of the weights.

    Raises:
        ConfigError: There is none.
    """
    packaged = Path(str(files("lodbench.baselines.lodloc") / "weights" / "lodloc.onnx"))
    path = Path(weights).expanduser() if weights else packaged
    if not path.is_file():
        raise ConfigError(
            f"There are no weights {path}.", "Leave method.weights out for those of the package."
        )
    return path


@lru_cache(maxsize=2)
def _network(path: Path, is_ours: bool) -> Any:
    return read_onnx(path, _HINT, is_ours=is_ours)


def maps_of(photo: NDArray[np.uint8], width: int, height: int, weights: str | None) -> Maps:
    """Returns the maps of an (H, W, 3) RGB photo brought to a working size.

    Raises:
        ConfigError: The weights are missing or of another network.
    """
    image = padded_photo(resized_photo(photo, width, height), _STRIDE)
    blob = np.ascontiguousarray(image.transpose(2, 0, 1)[None], np.float32) / np.float32(255)
    path = weights_file(weights)
    network = _network(path, weights is None)
    network.setInput(blob)
    packed = np.asarray(network.forward(), np.float32)
    wanted = (1, _CHANNELS, image.shape[0] // 2, image.shape[1] // 2)
    if packed.shape != wanted:
        raise ConfigError(f"{path} answers {packed.shape} where {wanted} is wanted.", _HINT)
    return unpacked(packed[0], width, height)


def unpacked(packed: NDArray[np.float32], width: int, height: int) -> Maps:
    """Returns the maps that (10, H / 2, W / 2) hold, cut to a picture; ``WireframeNet`` says how."""
    quarter, half = packed[0, ::2, ::2], packed[1]
    full, refinement = (_spread(packed[first : first + 4]) for first in (2, 6))
    sizes = ((-(-height // scale), -(-width // scale)) for scale in (4, 2, 1, 1))
    cut = [
        np.ascontiguousarray(values[:rows, :columns])
        for values, (rows, columns) in zip((quarter, half, full, refinement), sizes, strict=True)
    ]
    return Maps((cut[0], cut[1], cut[2]), cut[3])


def _spread(channels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns (2 h, 2 w) of (4, h, w): four channels are a square of pixels, row by row."""
    _, rows, columns = channels.shape
    return channels.reshape(2, 2, rows, columns).transpose(2, 0, 3, 1).reshape(2 * rows, 2 * columns)
