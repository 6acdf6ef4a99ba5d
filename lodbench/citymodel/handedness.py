"""Which of the first two columns is the easting, by the walls and roofs of houses: they face outside."""

from __future__ import annotations

import numpy as np

from lodbench.citymodel.model import Polygons
from lodbench.citymodel.newell import newell
from lodbench.citymodel.selection import select_polygons

# So many buildings are enough to tell.
_SAMPLE_BUILDINGS = 4096
# Of a body whose faces all look outside each adds to the volume; of one drawn at random they cancel out.
_LEAST_SHARE = 0.5
# So many of the buildings that tell anything must tell the same.
_LEAST_AGREEING = 0.9


def faces_tell_north_first(polygons: Polygons) -> bool | None:
    """Tells whether northings stand first: exchanged columns mirror houses, whose faces then look inside.

    Args:
        polygons: In the coordinates of the file.

    Returns:
        None where faces do not tell: footprints have none, some publishers draw them at random.
    """
    step = 1 + int(polygons.building.max(initial=0)) // _SAMPLE_BUILDINGS
    chosen = select_polygons(polygons, np.flatnonzero(polygons.building % step == 0))
    if len(chosen) == 0:
        return None
    vectors, _ = newell(chosen)
    _, building = np.unique(chosen.building, return_inverse=True)
    corners = chosen.points[chosen.ring_starts[chosen.polygon_starts[:-1]]]
    counts = np.bincount(building)
    feet = np.stack([np.bincount(building, corners[:, k]) / counts for k in range(3)], axis=1)
    feet[:, 2] = np.inf
    np.minimum.at(feet[:, 2], building, corners[:, 2])  # where walls have no floor, nothing is missing
    volumes = np.einsum("ij,ij->i", corners - feet[building], vectors)
    total, largest = np.bincount(building, volumes), np.bincount(building, np.abs(volumes))
    is_outside, is_inside = total > _LEAST_SHARE * largest, total < -_LEAST_SHARE * largest
    share = is_inside.sum() / max(is_inside.sum() + is_outside.sum(), 1)
    if share >= _LEAST_AGREEING:
        return True
    return False if is_outside.any() and share <= 1.0 - _LEAST_AGREEING else None
