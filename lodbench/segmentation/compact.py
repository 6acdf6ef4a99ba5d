"""``segmenter=compact``: the small network that comes with the package; needs OpenCV only."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodbench.errors import require_within
from lodbench.segmentation.packaged_network import PackagedNetwork, packaged_file
from lodbench.segmentation.probability import check_normalise


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
        require_within("segmenter.size", self.size, 32, 4096)
        require_within("segmenter.sure", self.sure, 0, 1)
        check_normalise(self.normalise)


class Compact(PackagedNetwork):
    """A residual U-Net of 1.5 million weights, run by OpenCV; see ``PackagedNetwork``."""

    params_type = CompactParams
    weights_name = "compact"
    domain = "synthetic"
    # A tenth of each part of a mask is at least so probable, where it is a building to the package's weights.
    packaged_sure = 0.99

    def notes(self) -> tuple[str, ...]:
        """Returns that the network has seen made-up pictures only, or whose weights it has."""
        if self.params.weights is not None:
            return (f"segmenter compact, weights of {Path(self.params.weights).name}",)
        views = self.packaged_training().get("views", {}).get("train")
        seen = f"{views} rendered views" if views else "rendered views"
        return (f"segmenter compact, domain: {self.domain}: trained on {seen}; real photos look different",)

    def new_net(self, is_filled: bool) -> Any:
        """Returns the torch network with random weights."""
        from lodbench.segmentation.nets.compact import CompactNet

        return CompactNet()


def packaged_weights() -> Path:
    """Returns the weights of ``compact`` that come with the package."""
    return packaged_file("compact.onnx")
