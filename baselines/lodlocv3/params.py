"""Settings of LoD-Loc v3: the search's are LoD-Loc v2's."""

from __future__ import annotations

from dataclasses import dataclass

from lodbench.errors import ConfigError, require_choice
from lodbench.methods.lodlocv2 import LodLocV2Params

WEIGHTS = ("box", "area", "equal")
SELECTS = ("silhouette", "instances")


@dataclass(frozen=True, slots=True)
class LodLocV3Params(LodLocV2Params):
    """Settings of ``method=lodlocv3``; those not named here are LoD-Loc v2's and mean the same.

    Attributes:
        weights: How much each building of the photo counts: by its bounding ``box``, the paper's, by its
            ``area`` in pixels, or all ``equal``.
        select: What the grid is ranked by: ``silhouette``, of all buildings, whose fit reaches as far as
            the grid's steps, by ``fit``; or ``instances``, as the filter always is, and both where they
            have one size. Where silhouettes are not compared, ``fit`` is not to be set.

    Raises:
        ConfigError: A value is unknown or out of range.
    """

    name: str = "lodlocv3"
    weights: str = "box"
    select: str = "silhouette"

    def __post_init__(self) -> None:
        super(LodLocV3Params, self).__post_init__()
        require_choice("method.weights", self.weights, WEIGHTS)
        require_choice("method.select", self.select, SELECTS)
        if self.fit != "iou" and not self.by_silhouette:
            raise ConfigError(
                f"method.fit={self.fit} compares silhouettes, which nothing does here.",
                "Set method.select=silhouette, and two sizes.",
            )

    @property
    def by_silhouette(self) -> bool:
        """Returns whether the grid is ranked by the silhouette of all buildings."""
        return self.select == "silhouette" and self.coarse_size != self.fine_size
