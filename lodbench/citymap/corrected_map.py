"""The map with its buildings as high as photos or their source say, drawn again.

What a silhouette does where a roof is metres higher is told to first order only, and not at all beyond the
reach of a robust kernel: buildings far off are drawn where they are thought to be, and measured from there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap.city_map import CityMap
from lodbench.citymodel.raw import take_segments
from lodbench.rendering.silhouette import SilhouetteRenderer

# No building is lowered below this height, metres.
_LOWEST_M = 2.0
_ENDS = (np.minimum, np.maximum)


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
    chosen = np.flatnonzero((np.abs(heights_m) > least_m) & (counts > 0))
    rows, starts = take_segments(scene.vertex_starts, chosen)
    heights = scene.vertices[rows, 2].astype(np.float64)
    floors, tops = (each.reduceat(heights, starts[:-1]) if len(chosen) else heights for each in _ENDS)
    rises = tops - floors
    moved = np.where(rises > 0, np.maximum(heights_m[chosen], np.minimum(_LOWEST_M - rises, 0.0)), 0.0)
    changed = np.zeros(len(counts))
    changed[chosen] = moved
    if not changed.any():
        return city_map, changed
    floor, stretch = (np.repeat(v, counts[chosen]) for v in (floors, 1.0 + moved / np.maximum(rises, 1e-6)))
    vertices = scene.vertices.copy()
    vertices[rows, 2] = floor + (heights - floor) * stretch
    if isinstance(city_map, CityMap) and city_map.name == SilhouetteRenderer.name:
        return city_map.with_vertices(vertices), changed
    # A map in another process may be drawn there by what is not to be had here.
    renderer = city_map.name if isinstance(city_map, CityMap) else SilhouetteRenderer.name
    drawn = CityMap(replace(scene, vertices=vertices, stored_digest=""), renderer, city_map.threads)
    drawn.usage = city_map.usage
    return drawn, changed
