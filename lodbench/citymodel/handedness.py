"""Which of the first two columns is the easting, by the walls of houses: they face outside."""

from __future__ import annotations

import numpy as np

from lodbench.citymodel.model import Polygons
from lodbench.citymodel.newell import newell
from lodbench.citymodel.selection import select_polygons

# So many buildings are enough to tell.
_SAMPLE_BUILDINGS = 4096
# A wall covers less of the square around it in plan. Roofs and footprints are drawn this way and that.
_WALL_SHARE = 0.1
# Of walls that all look outside each adds to the area of the plan; of walls drawn at random they cancel out.
_LEAST_SHARE = 0.5
# So many of the buildings that tell anything must tell the same.
_LEAST_AGREEING = 0.9


def faces_tell_north_first(polygons: Polygons, least_buildings: int = 1) -> bool | None:
    """Tells whether northings stand first: exchanged columns mirror houses, whose walls then look inside.

    Args:
        polygons: In the coordinates of the file.
        least_buildings: So many have to tell something.

    Returns:
        None where walls do not tell: footprints have none, some publishers draw them at random.
    """
    step = 1 + int(polygons.building.max(initial=0)) // _SAMPLE_BUILDINGS
    chosen = select_polygons(polygons, np.flatnonzero(polygons.building % step == 0))
    if len(chosen) == 0:
        return None
    vectors, _ = newell(chosen)
    first = chosen.ring_starts[chosen.polygon_starts[:-1]]
    plan = chosen.points[:, :2]
    sides = np.maximum.reduceat(plan, first) - np.minimum.reduceat(plan, first)
    is_wall = np.abs(vectors[:, 2]) < _WALL_SHARE * (sides**2).sum(axis=1)
    _, building = np.unique(chosen.building, return_inverse=True)
    counts = np.bincount(building)
    middles = np.stack([np.bincount(building, plan[first, k]) / counts for k in (0, 1)], axis=1)
    areas = is_wall * ((plan[first] - middles[building]) * vectors[:, :2]).sum(axis=1)
    total, largest = np.bincount(building, areas), np.bincount(building, np.abs(areas))
    is_outside, is_inside = total > _LEAST_SHARE * largest, total < -_LEAST_SHARE * largest
    if is_inside.sum() + is_outside.sum() < least_buildings:
        return None
    share = is_inside.sum() / max(is_inside.sum() + is_outside.sum(), 1)
    if share >= _LEAST_AGREEING:
        return True
    return False if is_outside.any() and share <= 1.0 - _LEAST_AGREEING else None
