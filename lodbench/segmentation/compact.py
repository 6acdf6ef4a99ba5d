"""``segmenter=compact``: the small network that comes with the package; needs OpenCV only."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError
from lodbench.segmentation.onnx_file import read_onnx
from lodbench.segmentation.photo_segmenter import PhotoSegmenter
from lodbench.segmentation.probability import check_normalise, without_unsure_parts
from lodbench.segmentation.tiles import MemoryTiles
from lodbench.segmentation.working_size import padded_photo, resized_photo, working_size
from lodbench.storage import file_digest

WEIGHTS_FILE = "compact.onnx"
_TRAINING_FILE = "compact.json"


# A tenth of each part of a mask is at least so probable, where it is a building to the package's weights.
_SURE = 0.99


@dataclass(frozen=True, slots=True)
class CompactParams:
    """Settings of ``segmenter=compact``.

    Attributes:
        name: Name to report.
        size: Long side that photos are brought to, pixels.
        normalise: ``none``, or ``paper`` for a stretch to 0 to 1 per photo; see ``probability_of``.
        sure: Parts of the mask are dropped unless a tenth of them is at least so probable; 0 keeps all. None:
            0.99 for the package's weights, 0 for others, which may never be so sure.
        weights: ONNX file of ``lodbench train segmenter=compact``; None for the weights in the package.

    Raises:
        ConfigError: A setting is out of range.
    """

    name: str = "compact"
    size: int = 512
    normalise: str = "none"
    sure: float | None = None
    weights: str | None = None

    def __post_init__(self) -> None:
        if not 32 <= self.size <= 4096:
            raise ConfigError(f"segmenter.size={self.size} is not within 32 to 4096.")
        if self.sure is not None and not 0.0 <= self.sure <= 1.0:
            raise ConfigError(f"segmenter.sure={self.sure} is not within 0 to 1.")
        check_normalise(self.normalise)


class Compact(PhotoSegmenter):
    """A residual U-Net of 1.5 million weights, run by OpenCV.

    Args:
        params: Its settings.

    Raises:
        ConfigError: The weights are missing or no network of this kind.
    """

    params_type = CompactParams
    domain = "synthetic"
    # Sides of what the network sees are multiples of this.
    stride = 32

    def __init__(self, params: CompactParams) -> None:
        super().__init__(params)
        self._memory = MemoryTiles(params.name, params.size, self.stride)
        given = params.weights
        self._path = Path(given).expanduser() if given else packaged_weights()
        if given and not self._path.is_file():
            raise ConfigError(
                f"There are no weights {self._path}.", "Leave segmenter.weights out for those of the package."
            )

    @cached_property
    def weights_digest(self) -> str:
        """Returns the SHA-256 of the ONNX file."""
        if not self._path.is_file():
            raise ConfigError(f"There are no weights {self._path}.", "Set segmenter.weights=FILE.")
        return file_digest(self._path)

    @cached_property
    def _net(self) -> Any:
        """Returns OpenCV's network; read on first use."""
        hint = "lodbench train segmenter=compact writes one."
        return read_onnx(self._path, hint, is_ours=self.params.weights is None)

    def notes(self) -> tuple[str, ...]:
        """Returns that the network has seen made-up pictures only."""
        training = packaged_training()
        views = training.get("views", {}).get("train") if self.params.weights is None else None
        seen = f"{views} rendered views" if views else "rendered views"
        return (f"segmenter compact, domain: {self.domain}: trained on {seen}; real photos look different",)

    def probability(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns the (h, w) float32 probability of building of a (H, W, 3) RGB photo."""
        sure = self.params.sure
        if sure is None:
            sure = 0.0 if self.params.weights else _SURE
        return without_unsure_parts(super().probability(photo), sure)

    def logits(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns (h, w) logits of a (H, W, 3) RGB photo whose long side is brought to ``size``.

        Raises:
            ConfigError: The weights are no network of this kind.
            QueryFault: The photo does not fit into memory, not even in tiles.
        """
        height, width = photo.shape[:2]
        width, height = working_size(width, height, self.params.size)
        image = padded_photo(resized_photo(photo, width, height), self.stride)
        return self._memory.run(image, self._run)[:height, :width]

    def _run(self, tile: NDArray[np.uint8]) -> NDArray[np.float32]:
        blob = np.ascontiguousarray(tile.transpose(2, 0, 1)[None], np.float32) / np.float32(255)
        self._net.setInput(blob)
        found = np.asarray(self._net.forward(), np.float32)
        if found.shape != (1, 1, *tile.shape[:2]):
            raise ConfigError(
                f"{self._path} answers {found.shape} to a photo of {tile.shape[:2]}.",
                "lodbench train segmenter=compact writes networks that answer one value per pixel.",
            )
        return np.asarray(found[0, 0])

    def build(self, init: str | None) -> Any:
        """Returns the torch network, with random weights, those of a checkpoint or those of an ONNX file.

        Raises:
            ConfigError: The file holds no weights of this network.
        """
        from lodbench.segmentation.nets.compact import CompactNet
        from lodbench.segmentation.nets.onnx_import import load_onnx
        from lodbench.segmentation.nets.weights import load_own

        if init is not None and init.endswith(".onnx"):
            return load_onnx(CompactNet(), Path(init).expanduser(), self.stride)
        return load_own(CompactNet(), init)

    def packaged_weights(self) -> Path | None:
        """Returns the weights in the package."""
        return packaged_weights()

    def store(self, net: Any, folder: Path) -> Path:
        """Writes a network as ONNX, its normalisations folded into the convolutions; returns the file."""
        from lodbench.segmentation.nets.onnx_export import write_onnx

        path = folder / WEIGHTS_FILE
        write_onnx(net, path, self.stride)
        return path


def packaged_weights() -> Path:
    """Returns the weights that come with the package."""
    return Path(str(files("lodbench.segmentation") / "weights" / WEIGHTS_FILE))


def packaged_training() -> dict[str, Any]:
    """Returns what the package's weights were trained on and how."""
    path = packaged_weights().with_name(_TRAINING_FILE)
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return found
