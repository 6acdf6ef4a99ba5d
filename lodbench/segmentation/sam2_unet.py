"""``segmenter=sam2_unet``: the paper's network, on SAM2's Hiera encoder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodbench.errors import ConfigError
from lodbench.segmentation.probability import check_normalise
from lodbench.segmentation.torch_segmenter import ENCODER_SETTING, TorchSegmenter, weights_file


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
        check_normalise(self.normalise)


class Sam2UNetSegmenter(TorchSegmenter):
    """SAM2-UNet: 216 million weights with the large encoder, 4.3 million of them trained."""

    params_type = Sam2UNetParams

    def build(self, init: str | None) -> Any:
        """Returns the network with a checkpoint's weights; else random ones over ``encoder_weights``.

        Raises:
            ConfigError: A file does not hold weights of this network.
        """
        from lodbench.segmentation.nets.sam2_unet import Sam2UNet, fill_encoder, whole_checkpoint
        from lodbench.segmentation.nets.weights import fill, read_weights

        self.require_room(lambda: Sam2UNet(self.params.encoder), init)
        net = Sam2UNet(self.params.encoder)
        if init is not None:
            fill(net, whole_checkpoint(read_weights(Path(init).expanduser())), init)
        elif self.params.encoder_weights is not None:
            path = weights_file(self.params.encoder_weights, self.name, ENCODER_SETTING)
            fill_encoder(net, read_weights(path), str(path))
        return net


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
        from lodbench.segmentation.nets.sam1_adapter import Sam1Adapter, fill_sam
        from lodbench.segmentation.nets.weights import load_own, read_weights

        self.require_room(lambda: Sam1Adapter(self.params.encoder, self.params.size), init)
        net = Sam1Adapter(self.params.encoder, self.params.size)
        if init is None and self.params.encoder_weights is not None:
            path = weights_file(self.params.encoder_weights, self.name, ENCODER_SETTING)
            fill_sam(net, read_weights(Path(path)), str(path))
        return load_own(net, init)
