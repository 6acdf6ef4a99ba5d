"""``method=cadloc``: match the photo with views of the untextured city model (Panek et al., CVPR 2023)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.geometry import Camera

from ..render_and_match import RenderAndMatch, RenderAndMatchParams

Floats = NDArray[np.float64]

# A light from above and aside, so that no two walls of a corner are of one grey.
_LIGHT = np.array([0.35, 0.5, 0.79])
_DARK, _RANGE, _BACKGROUND = 70.0, 170.0, 60


@dataclass(frozen=True, slots=True)
class CadlocParams(RenderAndMatchParams):
    """Settings of ``method=cadloc``; see ``RenderAndMatchParams``."""

    name: str = "cadloc"


class Cadloc(RenderAndMatch):
    """Views show the plain model, each face in the grey that a light gives it; only buildings are matched."""

    params_type = CadlocParams
    name = "cadloc"

    def draw(
        self, city_map: CityMap, camera: Camera, rotations: Floats, centers: Floats
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Returns pictures of shaded faces, and the model's depths."""
        normals = city_map.normals(camera, rotations, centers)
        depths = city_map.depth(camera, rotations, centers)
        # Half as bright on the side away from the light, so that there too faces differ.
        shade = 0.5 + 0.5 * (normals @ _LIGHT.astype(np.float32))
        grey = np.where(depths > 0, _DARK + _RANGE * shade, _BACKGROUND).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=-1), depths
