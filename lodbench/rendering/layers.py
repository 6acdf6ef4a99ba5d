"""What every pixel of a view shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """What every pixel of a view shows.

    Attributes:
        depth: (H, W) float32 distance along the optical axis, metres; 0 where there is no building.
        building: (H, W) int32 index into ``scene.building_ids``, -1 where there is none.
        triangle: (H, W) int32 index into ``scene.triangles``, -1 where there is none.
        normal: (H, W, 3) float32 unit normal in world axes, on the camera's side of the surface, since
            the order of corners in published models is not to be trusted; 0 where there is none.
        colour: (H, W, 3) uint8 RGB, the building's plain colours in the sun.
    """

    depth: NDArray[np.float32]
    building: NDArray[np.int32]
    triangle: NDArray[np.int32]
    normal: NDArray[np.float32]
    colour: NDArray[np.uint8]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Returns the (H, W) silhouette."""
        return self.triangle >= 0

    def instance_masks(self) -> dict[int, NDArray[np.bool_]]:
        """Returns the (H, W) mask of what is seen of each building, by index, ascending.

        Buildings in front hide those behind: the masks do not overlap, and their union is ``mask``.
        """
        seen = np.unique(self.building)
        return {int(b): self.building == b for b in seen if b >= 0}
