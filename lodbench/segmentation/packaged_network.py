"""Networks that come with the package: run by OpenCV from ONNX files, trained by ``lodbench train``."""

from __future__ import annotations

import json
from abc import abstractmethod
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError
from lodbench.segmentation.onnx_file import read_onnx
from lodbench.segmentation.photo_segmenter import PhotoSegmenter
from lodbench.segmentation.probability import (
    MemoryTiles,
    is_out_of_memory,
    padded_photo,
    resized_photo,
    without_unsure_parts,
    working_size,
)
from lodbench.storage import file_digest

# What a file calls the answer of a network, by what that has learnt: networks may be alike in all else.
_ANSWERS = {"masks": "logits", "interiors": "interiors", "classes": "classes"}

# Logits of networks that have learnt something stay below a few hundred.
_MOST_LOGIT = 1e6


class PackagedNetwork(PhotoSegmenter):
    """Segments photos with a network whose weights come with the package, or from a training of one's own.

    Args:
        params: Its settings: ``name``, ``size``, ``normalise``, ``sure`` and ``weights``.

    Raises:
        ConfigError: The weights are missing or no network of this kind.
    """

    # Name of the package's weights, without ending; and what they were trained on, in a word.
    weights_name: str
    domain: str
    # ``sure`` of the package's weights, where no setting says otherwise.
    packaged_sure = 0.0
    # How photos are padded: rows that repeat may look like a wall.
    padding: Literal["edge", "symmetric"] = "edge"
    # Whether weights are stored in 16 bits: a large network shall not make the package large.
    stores_half = False
    # Sides of what the network sees are multiples of this.
    stride = 32
    learns = "masks"
    # Logits per pixel.
    channels = 1

    def __init__(self, params: Any) -> None:
        super().__init__(params)
        self._memory = MemoryTiles(params.name, params.size, self.stride)
        given = params.weights
        self._path = Path(given).expanduser() if given else self.packaged_weights()
        if given and not self._path.is_file():
            is_folder = self._path.is_dir()
            raise ConfigError(
                f"{self._path} is a folder." if is_folder else f"There are no weights {self._path}.",
                "`segmenter.weights=FILE` takes an ONNX file; without it those of the package are taken.",
            )

    @cached_property
    def weights_digest(self) -> str:
        """Returns the SHA-256 of the ONNX file."""
        if not self._path.is_file():
            raise ConfigError(f"There are no weights {self._path}.", "Set `segmenter.weights=FILE`.")
        return file_digest(self._path)

    @cached_property
    def _net(self) -> Any:
        """Returns OpenCV's network; read on first use.

        Raises:
            ConfigError: It cannot be read, has several outputs, or has learnt something else.
        """
        hint = f"lodbench train segmenter={self.name} writes one."
        net = read_onnx(self._path, hint, is_ours=self.params.weights is None, digest=self.weights_digest)
        outputs = net.getUnconnectedOutLayersNames()
        if len(outputs) != 1:
            raise ConfigError(f"{self._path} has {len(outputs)} outputs instead of one.", hint)
        learnt = next((what for what, answer in _ANSWERS.items() if answer == outputs[0]), self.learns)
        # The package's files were written before answers had names.
        if learnt != self.learns and self._path.resolve() != self.packaged_weights().resolve():
            raise ConfigError(f"{self._path} has learnt {learnt} of buildings, not {self.learns}.", hint)
        return net

    @abstractmethod
    def new_net(self, is_filled: bool) -> Any:
        """Returns the torch network as a training starts with it.

        Args:
            is_filled: Whether all its weights are about to be replaced.
        """

    def probability(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns the (h, w) float32 probability of building of a (H, W, 3) RGB photo."""
        sure = self.params.sure
        if sure is None:
            sure = 0.0 if self.params.weights else self.packaged_sure
        return without_unsure_parts(super().probability(photo), sure)

    def logits(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns (h, w), or (h, w, channels), logits of a (H, W, 3) RGB photo, its long side ``size``.

        Raises:
            ConfigError: The weights are no network of this kind.
            QueryFault: The photo does not fit into memory, not even in tiles.
        """
        return self.logits_at(photo, self.params.size)

    def logits_at(self, photo: NDArray[np.uint8], size: int) -> NDArray[np.float32]:
        """Returns (h, w) logits of a (H, W, 3) RGB photo whose long side is brought to some other size.

        Raises:
            LodbenchError: As for ``logits``.
        """
        height, width = photo.shape[:2]
        width, height = working_size(width, height, size)
        image = padded_photo(resized_photo(photo, width, height), self.stride, self.padding)
        return self._memory.run(image, self._run)[:height, :width]

    def _run(self, tile: NDArray[np.uint8]) -> NDArray[np.float32]:
        blob = np.ascontiguousarray(tile.transpose(2, 0, 1)[None], np.float32) / np.float32(255)
        hint = f"lodbench train segmenter={self.name} writes networks that answer {self.channels} per pixel."
        try:
            self._net.setInput(blob)
            found = np.asarray(self._net.forward(), np.float32)
        except cv2.error as error:
            if is_out_of_memory(error):
                raise
            raise ConfigError(f"{self._path} is no network of photos: OpenCV cannot ask it.", hint) from error
        if found.shape != (1, self.channels, *tile.shape[:2]):
            raise ConfigError(
                f"{self._path} answers {found.shape} to a photo of {tile.shape[:2]}.",
                hint,
            )
        if self.params.weights:
            _require_logits(found, self._path, hint)
        return np.asarray(found[0, 0] if self.channels == 1 else found[0].transpose(1, 2, 0))

    def build(self, init: str | None) -> Any:
        """Returns the torch network, with random weights, those of a checkpoint or those of an ONNX file.

        Raises:
            ConfigError: The file holds no weights of this network.
        """
        from lodbench.segmentation.nets.weights import load_onnx, load_own

        if init is not None and init.endswith(".onnx"):
            return load_onnx(self.new_net(True), Path(init).expanduser(), self.stride)
        return load_own(self.new_net(init is not None), init)

    def packaged_weights(self) -> Path:
        """Returns the weights in the package."""
        return packaged_file(f"{self.weights_name}.onnx")

    def packaged_training(self) -> dict[str, Any]:
        """Returns what the package's weights were trained on and how."""
        path = packaged_file(f"{self.weights_name}.json")
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        return found

    def store(self, net: Any, folder: Path) -> Path:
        """Writes a network as ONNX, its normalisations folded into the convolutions; returns the file."""
        from lodbench.segmentation.nets.weights import write_onnx

        path = folder / f"{self.weights_name}.onnx"
        write_onnx(net, path, self.stride, self.stores_half, _ANSWERS[self.learns])
        return path


def _require_logits(found: NDArray[np.float32], path: Path, hint: str) -> None:
    """Makes sure that a network answers logits: of anything else the whole photo would be building.

    Raises:
        ConfigError: Its answers are no numbers, too large for any that has learnt something, or without one
            below 0, as of probabilities, of classes and of masks.
    """
    # OpenCV makes the largest of all numbers of NaN.
    if not np.abs(found).max() < _MOST_LOGIT:
        raise ConfigError(f"{path} answers NaN, or values beyond {_MOST_LOGIT:g}: it is damaged.", hint)
    if 0 <= found.min() and (found.max() <= 1 or found.min() == 0):
        within = f"{abs(found.min()):g} to {abs(found.max()):g}"  # no negative zeros
        raise ConfigError(
            f"{path} answers values of {within}, as probabilities and classes are, where logits are wanted.",
            "Export it without the sigmoid, or whatever else is at its end.",
        )


def packaged_file(name: str) -> Path:
    """Returns a file of the package's weights."""
    return Path(str(files("lodbench.segmentation") / "weights" / name))
