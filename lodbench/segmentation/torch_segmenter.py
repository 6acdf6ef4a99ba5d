"""Segmenters that run a torch network, SAM2-UNet and SAM's adapter among them: device, memory, weights."""

from __future__ import annotations

import sys
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError
from lodbench.extras import require
from lodbench.segmentation import probability
from lodbench.segmentation.photo_segmenter import PhotoSegmenter
from lodbench.segmentation.weight_files import RANDOM, weights_file

_HINT = "{}= takes a file, a folder with one safetensors file, or a hub id fetched before."


class TorchSegmenter(PhotoSegmenter):
    """Segments photos with a torch network, in tiles where memory does not suffice.

    Args:
        params: Settings with ``name``, ``size``, ``weights``, ``device`` and ``normalise``.

    Raises:
        ConfigError: A package is missing.
    """

    stride = 32
    # Whether photos are brought to size x size whatever their aspect, as the paper does.
    is_square = True
    # Whether the network answers to smaller pictures as well.
    can_tile = True

    def __init__(self, params: Any) -> None:
        super().__init__(params)
        for package in ("torch", "transformers", "safetensors"):
            require(package, "models", f"segmenter={params.name}")
        self._memory = probability.MemoryTiles(params.name, params.size, self.stride, self.can_tile)

    @abstractmethod
    def build(self, init: str | None) -> Any:
        """Returns the network; see ``TrainableSegmenter``."""

    def packaged_weights(self) -> Path | None:
        """Returns a note that the package holds none."""
        return None

    @cached_property
    def weights_digest(self) -> str:
        """Returns the SHA-256 of the weights' file, or ``random``, of which it warns.

        Raises:
            ConfigError: No weights are named, or they are not there.
        """
        if self.params.weights is None:
            raise ConfigError(
                f"segmenter={self.name} comes without weights.",
                "segmenter.weights=FILE; segmenter.weights=random tries it without any: the run is invalid.",
            )
        if self.params.weights == RANDOM:
            sys.stderr.write(f"lodbench: INVALID from here on: {self.name} has random weights.\n")
            return RANDOM
        self._path = weights_file(self.params.weights, _HINT.format("segmenter.weights"))
        return super().weights_digest

    def notes(self) -> tuple[str, ...]:
        """Returns a note that the weights are random, where they are."""
        if self.params.weights != RANDOM:
            return ()
        return (
            f"segmenter {self.name} has random weights: nothing it says counts. Set segmenter.weights=FILE",
        )

    @cached_property
    def _net(self) -> Any:
        import torch

        device = self._device  # checked before anything is built
        torch.manual_seed(0)
        return self.build(self._init()).to(device).eval()

    def _init(self) -> str | None:
        """Returns the file that the network's weights are in, or None for random ones."""
        # Reported first: nobody shall take a random network for one that has learnt.
        return None if self.weights_digest == RANDOM else str(self._path)

    def encoder_file(self) -> Path:
        """Returns the file that ``encoder_weights`` names."""
        return weights_file(self.params.encoder_weights, _HINT.format("segmenter.encoder_weights"))

    def require_room(self, build: Callable[[], Any], init: str | None) -> None:
        """Makes sure that a network, and the file it is filled from, fit into memory.

        Raises:
            ConfigError: They do not.
        """
        import torch

        with torch.device("meta"):
            net = build()
        stored = sum(weight.numel() * weight.element_size() for weight in net.state_dict().values())
        is_filled = init is not None or self.params.encoder_weights is not None
        require_memory(f"The weights of {self.name}", 2 * stored if is_filled else stored)

    @cached_property
    def _device(self) -> Any:
        """Returns torch's device."""
        import torch

        wanted = self.params.device
        if wanted == "auto":
            wanted = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            return torch.zeros(1, device=wanted).device
        except (RuntimeError, AssertionError) as error:
            raise ConfigError(
                f"segmenter.device={wanted} is not there.", "`segmenter.device=cpu` is; auto takes the best."
            ) from error

    def logits(self, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Returns (h, w) logits of a (H, W, 3) RGB photo, at its own aspect.

        Raises:
            QueryFault: The photo does not fit into memory, not even in tiles.
        """
        height, width = photo.shape[:2]
        width, height = probability.working_size(width, height, self.params.size)
        input_size = (self.params.size, self.params.size) if self.is_square else (width, height)
        image = probability.padded_photo(probability.resized_photo(photo, *input_size), self.stride)
        logits = self._memory.run(image, self._run)[: input_size[1], : input_size[0]]
        if (input_size[1], input_size[0]) == (height, width):
            return logits
        import cv2

        return np.asarray(cv2.resize(logits, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)

    def _run(self, tile: NDArray[np.uint8]) -> NDArray[np.float32]:
        import torch

        blob = np.ascontiguousarray(tile.transpose(2, 0, 1)[None], np.float32) / np.float32(255)
        with torch.no_grad():
            answer = self._net(torch.from_numpy(blob).to(self._device))[0]
        return np.asarray(answer[0, 0].float().cpu().numpy(), np.float32)

    def store(self, net: Any, folder: Path) -> Path:
        """Writes a trained network as safetensors and returns the file."""
        from lodbench.segmentation.nets.weights import save_weights

        path = folder / f"{self.name}.safetensors"
        save_weights(net, path)
        return path


_MEMINFO = Path("/proc/meminfo")
_GIB = float(1 << 30)


def free_bytes() -> int | None:
    """Returns the memory that can be had without swapping; None where the system does not say."""
    try:
        for line in _MEMINFO.read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return 1024 * int(line.split()[1])
    except (OSError, ValueError, IndexError):
        return None
    return None


def require_memory(what: str, needed: float, smaller: str = "a smaller segmenter.encoder") -> None:
    """Makes sure that something fits into memory.

    Args:
        what: Needs it, in the plural: ``The weights of sam2_unet``.
        needed: Bytes.
        smaller: What needs less.

    Raises:
        ConfigError: They do not.
    """
    free = free_bytes()
    if free is not None and needed > free:
        raise ConfigError(
            f"{what} need {needed / _GIB:.1f} GiB of memory, {free / _GIB:.1f} GiB are free.",
            f"Take {smaller}, or a machine with more memory.",
        )


@dataclass(frozen=True, slots=True)
class Sam2UNetParams:
    """Settings of ``segmenter=sam2_unet``.

    Attributes:
        name: Name to report.
        encoder: Size of the encoder: ``tiny``, ``small``, ``base_plus`` or ``large``.
        weights: Checkpoint of the whole network, by its authors' names or ours: safetensors or torch;
            ``random`` for none, which makes a run invalid; None where it is trained.
        encoder_weights: SAM2's encoder to train on: Meta's file, transformers' file or folder, or the id
            of a repository fetched before; None for none.
        size: Photos are brought to ``size`` x ``size``, pixels.
        normalise: ``paper`` or ``none``; see ``probability_of``.
        device: ``auto``, ``cpu``, ``cuda``, ...

    Raises:
        ConfigError: A setting is out of range.
    """

    name: str = "sam2_unet"
    encoder: str = "large"
    weights: str | None = None
    encoder_weights: str | None = None
    size: int = 1024
    normalise: str = "paper"
    device: str = "auto"

    def __post_init__(self) -> None:
        if not 32 <= self.size <= 4096 or self.size % 32:
            raise ConfigError(f"segmenter.size={self.size} is no multiple of 32 within 32 to 4096.")
        probability.check_normalise(self.normalise)


class Sam2UNetSegmenter(TorchSegmenter):
    """SAM2-UNet: 216 million weights with the large encoder, 4.3 million of them trained."""

    params_type = Sam2UNetParams

    def build(self, init: str | None) -> Any:
        """Returns the network with a checkpoint's weights; else random ones over ``encoder_weights``.

        Raises:
            ConfigError: A file does not hold weights of this network.
        """
        from lodbench.segmentation.nets.sam import Sam2UNet, fill_encoder, whole_checkpoint
        from lodbench.segmentation.nets.weights import load_weights, read_weights

        self.require_room(lambda: Sam2UNet(self.params.encoder), init)
        net = Sam2UNet(self.params.encoder)
        if init is None and self.params.encoder_weights is not None:
            path = self.encoder_file()
            fill_encoder(net, read_weights(path), str(path))
        return load_weights(net, init, whole_checkpoint)


@dataclass(frozen=True, slots=True)
class Sam1AdapterParams(Sam2UNetParams):
    """Settings of ``segmenter=sam1_adapter``: those of ``sam2_unet``, on SAM's encoders.

    Attributes:
        encoder: Size of SAM's encoder: ``base``, ``large`` or ``huge``.
    """

    name: str = "sam1_adapter"
    encoder: str = "huge"


class Sam1AdapterSegmenter(TorchSegmenter):
    """SAM's frozen encoder with prompts before each block, and its mask decoder."""

    params_type = Sam1AdapterParams
    # Its position embeddings are of one size: tiles would need others.
    can_tile = False

    def build(self, init: str | None) -> Any:
        """Returns the network with trained weights; else random ones over ``encoder_weights``.

        Raises:
            ConfigError: A file does not hold weights of this network.
        """
        from lodbench.segmentation.nets.sam import Sam1Adapter, fill_sam
        from lodbench.segmentation.nets.weights import load_weights, read_weights

        self.require_room(lambda: Sam1Adapter(self.params.encoder, self.params.size), init)
        net = Sam1Adapter(self.params.encoder, self.params.size)
        if init is None and self.params.encoder_weights is not None:
            path = self.encoder_file()
            fill_sam(net, read_weights(path), str(path))
        return load_weights(net, init)
