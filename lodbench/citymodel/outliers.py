"""Buildings that lie nowhere near the others: told, and no reason to move the local frame away from these."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import FAR_AWAY
from lodbench.citymodel.model import Polygons
from lodbench.findings import Findings

# So far from a frame's origin float32 is 2 cm off; few countries are as wide.
_FAR_M = 500_000.0


def frame_origin(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns whole metres at the south-west corner of points, (P, 3), strays left out; its height is 0."""
    is_far = far_from_most(points)
    near = points[~is_far] if is_far.any() else points
    return np.array([np.floor(near[:, 0].min()), np.floor(near[:, 1].min()), 0.0])


def far_from_most(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tells which points, (P, 3), lie more than 500 km from the middle of all: a zero that was no place."""
    plane = points[:, :2]
    if max(np.ptp(plane[:, 0]), np.ptp(plane[:, 1])) <= _FAR_M:  # along rows it takes 20 times as long
        return np.zeros(len(points), np.bool_)
    middle = np.median(plane, axis=0)
    # Of two halves the middle may be nowhere: the point next to it is somewhere.
    middle = plane[np.argmin(np.abs(plane - middle).sum(axis=1))]
    return np.asarray(np.abs(plane - middle).max(axis=1) > _FAR_M)


def report_outliers(polygons: Polygons, building_ids: tuple[str, ...], findings: Findings) -> None:
    """Adds a finding for each building with a point that lies far from most.

    Args:
        polygons: In metres of one reference system.
        building_ids: For the findings.
        findings: Receives ``FAR_AWAY``.
    """
    far = np.flatnonzero(far_from_most(polygons.points))
    point_starts = polygons.ring_starts[polygons.polygon_starts]
    polygon = np.searchsorted(point_starts, far, side="right") - 1
    buildings, first = np.unique(polygons.building[polygon], return_index=True)
    for building, n in zip(buildings.tolist(), first.tolist(), strict=True):
        east, north, up = polygons.points[far[n]].tolist()
        where = f"at {east:.0f}, {north:.0f}"
        findings.add(FAR_AWAY, building_ids[building], where, place=(east, north, up))
