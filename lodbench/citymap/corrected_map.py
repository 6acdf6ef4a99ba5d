"""The map with its buildings as high as photos or their source say, drawn again.

What a silhouette does where a roof is metres higher is told to first order only, and not at all beyond the
reach of a robust kernel: buildings far off are drawn where they are thought to be, and measured from there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap.city_map import CityMap
from lodbench.rendering.silhouette import SilhouetteRenderer

# No building is lowered below this height, metres.
_LOWEST_M = 2.0


def corrected_map(
    city_map: CityMap, heights_m: NDArray[np.float64], least_m: float = 0.5
) -> tuple[CityMap, NDArray[np.float64]]:
    """Returns the map with buildings made higher, and (B,) by how much each is, metres.

    Poses drawn of it count as drawn of the map.

    Args:
        city_map: The map.
        heights_m: (B,) by how much its buildings are higher in truth, metres.
        least_m: Buildings nearer to the map than this stay as they are.
    """
    scene = city_map.scene
    counts = np.diff(scene.vertex_starts)
    changed = np.where((np.abs(heights_m) > least_m) & (counts > 0), heights_m, 0.0)
    if not changed.any():
        return city_map, changed
    vertices = scene.vertices.copy()
    for building in np.flatnonzero(changed):
        part = slice(scene.vertex_starts[building], scene.vertex_starts[building + 1])
        heights = vertices[part, 2].astype(np.float64)
        floor, rise = heights.min(), float(np.ptp(heights))
        changed[building] = max(changed[building], min(_LOWEST_M - rise, 0.0)) if rise > 0 else 0.0
        vertices[part, 2] = floor + (heights - floor) * (1.0 + changed[building] / max(rise, 1e-6))
    if isinstance(city_map, CityMap) and city_map.name == SilhouetteRenderer.name:
        return city_map.with_vertices(vertices), changed
    moved = replace(scene, vertices=vertices, stored_digest="")
    drawn = CityMap(moved, city_map.name, city_map.threads)
    drawn.usage = city_map.usage
    return drawn, changed
