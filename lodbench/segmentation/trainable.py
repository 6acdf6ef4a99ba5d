"""What a segmenter offers besides segmenting so that `lodbench train` can train it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol


class TrainableSegmenter(Protocol):
    """Builds its network and stores its weights.

    Attributes:
        params: Its settings, a frozen dataclass.
        stride: Sides of pictures are padded to multiples of this.
        learns: Optional: ``masks``, which is meant where it is missing, or ``interiors`` of single buildings.
    """

    params: Any
    stride: int

    def build(self, init: str | None) -> Any:
        """Returns the network as a torch module, from a weights file or with random weights.

        It takes (B, 3, H, W) float32 RGB in [0, 1] and returns a tuple of logits (B, 1, H, W), the
        answer first.

        Raises:
            LodbenchError: The file does not hold weights of this network.
        """
        ...

    def packaged_weights(self) -> Path | None:
        """Returns the weights in the package, or None where there are none."""
        ...

    def store(self, net: Any, folder: Path) -> Path:
        """Writes a network's weights as ``segment`` loads them and returns the file."""
        ...
