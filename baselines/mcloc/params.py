"""Settings of MC-Loc: the loop's are LoD-Loc v2's, so that both spend the same hypotheses."""

from __future__ import annotations

from dataclasses import dataclass

from lodbench.errors import ConfigError, require_choice
from lodbench.methods.lodlocv2 import LodLocV2Params

MAPS = ("model", "textured")
FEATURES = ("hog", "xfeat", "dinov2", "roma")


@dataclass(frozen=True, slots=True)
class McLocParams(LodLocV2Params):
    """Settings of ``method=mcloc``; those not named here are LoD-Loc v2's and mean the same.

    Attributes:
        features: What pictures are compared by: ``hog``, ``xfeat``, ``dinov2`` or ``roma``.
        map: What is rendered: ``model``, shaded without textures as in the papers' tables, or ``textured``.
        weights: Of ``xfeat`` a file, of ``dinov2`` and ``roma`` a folder or hub id fetched before; ``random``
            for random ones, whose rows count for nothing; None for the features' own.

    Raises:
        ConfigError: A value is unknown or out of range.
    """

    name: str = "mcloc"
    features: str = "hog"
    map: str = "model"
    weights: str | None = None
    coarse_size: tuple[int, int] = (152, 112)
    fine_size: tuple[int, int] = (304, 224)

    def __post_init__(self) -> None:
        super(McLocParams, self).__post_init__()
        require_choice("method.features", self.features, FEATURES)
        require_choice("method.map", self.map, MAPS)
        if self.fit != "iou":
            raise ConfigError(
                f"method.fit={self.fit} compares silhouettes; mcloc compares features.",
                "method.features=NAME chooses what is compared.",
            )
