"""Some of the polygons of a city: those of a level, or a few at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import Polygons
from lodbench.citymodel.raw import take_segments


def select_polygons(polygons: Polygons, chosen: NDArray[np.int64]) -> Polygons:
    """Returns some of the polygons, in the order given."""
    if len(chosen) == len(polygons):
        return polygons
    rings, polygon_starts = take_segments(polygons.polygon_starts, chosen)
    points, ring_starts = take_segments(polygons.ring_starts, rings)
    return Polygons(
        points=polygons.points[points],
        ring_starts=ring_starts,
        polygon_starts=polygon_starts,
        building=polygons.building[chosen],
        lod=polygons.lod[chosen],
        kind=polygons.kind[chosen],
    )


def slice_polygons(polygons: Polygons, first: int, last: int) -> Polygons:
    """Returns the polygons from ``first`` to before ``last``; their arrays are views."""
    if first == 0 and last >= len(polygons):
        return polygons
    rings = polygons.polygon_starts[first : last + 1]
    points = polygons.ring_starts[rings[0] : rings[-1] + 1]
    return Polygons(
        points=polygons.points[points[0] : points[-1]],
        ring_starts=points - points[0],
        polygon_starts=rings - rings[0],
        building=polygons.building[first:last],
        lod=polygons.lod[first:last],
        kind=polygons.kind[first:last],
    )
