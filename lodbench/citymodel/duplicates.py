"""Surfaces written twice: inline in a solid, and again as the walls and roofs that bound it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import DUPLICATE_POLYGON
from lodbench.citymodel.identity import number_rows, point_bits
from lodbench.citymodel.model import Polygons, SurfaceKind
from lodbench.citymodel.selection import group_cuts, select_polygons
from lodbench.findings import Findings

# Polygons compared at a time: some thirty times their points are held meanwhile.
_BLOCK_POLYGONS = 1 << 14


def drop_repeated_solids(polygons: Polygons, building_ids: tuple[str, ...], findings: Findings) -> Polygons:
    """Returns the polygons less those of solids that also stand as surfaces of a known kind.

    XLinks say so; some writers copy the coordinates instead, and the area would count twice. Two
    polygons are the same when they belong to the same building and level and have the same corners.
    Walls that two parts share are of equal kind, and stay.

    Args:
        polygons: Clean polygons.
        building_ids: For the findings.
        findings: Receives ``DUPLICATE_POLYGON`` for each polygon dropped.
    """
    is_solid = polygons.kind == SurfaceKind.UNKNOWN
    if is_solid.all() or not is_solid.any():
        return polygons
    # Only buildings that have both at one level can repeat themselves.
    level = polygons.building.astype(np.int64) * (int(polygons.lod.max()) + 1) + polygons.lod
    count = int(level.max()) + 1
    has_solid, has_known = (
        np.bincount(level[is_met], minlength=count) > 0 for is_met in (is_solid, ~is_solid)
    )
    has_both = has_solid & has_known
    candidates = np.flatnonzero(has_both[level])
    candidates = candidates[np.argsort(level[candidates], kind="stable")]
    is_repeated = np.zeros(len(polygons), np.bool_)
    for first, last in pairwise(group_cuts(level[candidates], _BLOCK_POLYGONS)):
        block = candidates[first:last]
        is_repeated[block] = _repeats(select_polygons(polygons, block), is_solid[block])
    for polygon in np.flatnonzero(is_repeated):
        findings.add(DUPLICATE_POLYGON, building_ids[polygons.building[polygon]])
    return select_polygons(polygons, np.flatnonzero(~is_repeated))


def _repeats(polygons: Polygons, is_solid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tells which polygons of solids have the corners of one of a known kind."""
    point_counts = np.diff(polygons.ring_starts[polygons.polygon_starts])
    corner = number_rows(point_bits(polygons.points))[0]
    # Two 64-bit sums over a polygon's corners stand for the set of them, wherever its rings begin.
    weights = _spread(corner)
    first = np.concatenate([[0], np.cumsum(point_counts)[:-1]])
    columns = [
        polygons.building.astype(np.uint64),
        polygons.lod.astype(np.uint64),
        point_counts.astype(np.uint64),
        np.add.reduceat(weights, first),
        np.bitwise_xor.reduceat(weights, first),
    ]
    number, _ = number_rows(columns)
    is_known = np.bincount(number[~is_solid], minlength=int(number.max()) + 1) > 0
    is_repeated: NDArray[np.bool_] = is_solid & is_known[number]
    return is_repeated


def _spread(numbers: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Returns well mixed bits for small numbers, so that sums of them tell sets apart."""
    bits = numbers.astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))
