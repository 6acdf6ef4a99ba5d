"""``segmenter=sam1_adapter``: SAM with adapters, the paper's second network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodbench.segmentation.sam2_unet import Sam2UNetParams
from lodbench.segmentation.torch_segmenter import ENCODER_SETTING, TorchSegmenter, weights_file


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
