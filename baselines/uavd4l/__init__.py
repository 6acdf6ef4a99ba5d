"""``method=uavd4l``: match the photo with views of a textured map, lift, solve (Wu et al., 3DV 2024)."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.geometry import Camera
from lodbench.methods import Input

from ..render_and_match import RenderAndMatch, RenderAndMatchParams

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Uavd4lParams(RenderAndMatchParams):
    """Settings of ``method=uavd4l``; see ``RenderAndMatchParams``."""

    name: str = "uavd4l"


class Uavd4l(RenderAndMatch):
    """Views show the textured map, and depths are its own: ground and trees are matched too."""

    params_type = Uavd4lParams
    name = "uavd4l"
    requires = frozenset({Input.IMAGE, Input.TEXTURED_MAP})
    # The best of five each on the town to train on (`make thresholds`), whose map has no error of place.
    thresholds_px = MappingProxyType({"sift_nn": 2.0, "xfeat": 2.0, "xfeat_lighterglue": 2.0})

    def draw(
        self, city_map: CityMap, camera: Camera, rotations: Floats, centers: Floats
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Returns pictures and depths of the textured map."""
        pictures = city_map.colour(camera, rotations, centers)
        return pictures, city_map.surface_depth(camera, rotations, centers)
