"""``method=cadloc``: match the photo with views of the untextured city model (Panek et al., CVPR 2023)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.geometry import Camera

from ..render_and_match import ORACLE, RenderAndMatch, RenderAndMatchParams, shaded_views

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CadlocParams(RenderAndMatchParams):
    """Settings of ``method=cadloc``; see ``RenderAndMatchParams``."""

    name: str = "cadloc"


class Cadloc(RenderAndMatch):
    """Views show the plain model, each face in the grey that a light gives it; only buildings are matched."""

    params_type = CadlocParams
    name = "cadloc"
    params: CadlocParams

    def params_for_trial(self) -> CadlocParams:
        """Returns true correspondences: blocks of plain colours give a matcher nothing to match."""
        return replace(self.params, matcher=ORACLE)

    def draw(
        self, city_map: CityMap, camera: Camera, rotations: Floats, centers: Floats
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Returns pictures of shaded faces, and the model's depths."""
        pictures = shaded_views(city_map, camera, rotations, centers)
        return pictures, city_map.depth(camera, rotations, centers)
