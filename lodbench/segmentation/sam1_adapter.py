"""``segmenter=sam1_adapter``: SAM with adapters, the paper's second network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodbench.errors import ConfigError
from lodbench.segmentation.probability import check_normalise
from lodbench.segmentation.torch_segmenter import RANDOM, TorchSegmenter, weights_file


@dataclass(frozen=True, slots=True)
class Sam1AdapterParams:
    """Settings of ``segmenter=sam1_adapter``.

    Attributes:
        name: Name to report.
        encoder: Size of SAM's encoder: ``base``, ``large`` or ``huge``.
        weights: Weights of ``lodbench train segmenter=sam1_adapter``; ``random`` makes a run invalid.
        encoder_weights: SAM to train on, by transformers' names: file, folder or id of a repository
            fetched before; None for none.
        size: Photos are brought to ``size`` x ``size``, pixels.
        normalise: ``paper`` or ``none``; see ``probability_of``.
        device: ``auto``, ``cpu``, ``cuda``, ...

    Raises:
        ConfigError: A setting is out of range.
    """

    name: str = "sam1_adapter"
    encoder: str = "huge"
    weights: str = RANDOM
    encoder_weights: str | None = None
    size: int = 1024
    normalise: str = "paper"
    device: str = "auto"

    def __post_init__(self) -> None:
        if not 32 <= self.size <= 4096 or self.size % 32:
            raise ConfigError(f"segmenter.size={self.size} is no multiple of 32 within 32 to 4096.")
        check_normalise(self.normalise)


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

        net = Sam1Adapter(self.params.encoder, self.params.size)
        if init is None and self.params.encoder_weights is not None:
            path = weights_file(self.params.encoder_weights, self.name)
            fill_sam(net, read_weights(Path(path)), str(path))
        return load_own(net, init)
