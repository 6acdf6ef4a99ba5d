"""Surfaces written twice: inline in a solid and as the walls that bound it, or once more for no reason."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel import small_cities
from lodbench.citymodel.codes import DUPLICATE_POLYGON
from lodbench.citymodel.identity import number_rows
from lodbench.citymodel.model import Polygons, SurfaceKind
from lodbench.citymodel.selection import group_cuts, select_polygons
from lodbench.findings import Findings

# Polygons compared at a time: some hundred bytes each are held meanwhile.
_BLOCK_POLYGONS = 1 << 16


def drop_repeats(
    polygons: Polygons, building_ids: tuple[str, ...], findings: Findings
) -> tuple[Polygons, NDArray[np.int64], NDArray[np.int64]]:
    """Returns the polygons less those that stand twice in a building at one level.

    XLinks say so; some writers copy the coordinates instead, and the area would count twice. Two polygons
    are the same when they have the same corners, whichever way round. Of a surface and the face of a
    solid the surface is kept, whatever the part; of two faces of one kind the first, within a part:
    walls that two parts share are walls of both. Interiors are their own.

    Returns:
        polygons: What is left.
        kept_as: (N,) the index among them of each polygon given, or of what it repeats.
        kept: (M,) the index among those given of each polygon left.
    """
    kept_as = np.arange(len(polygons))
    building = polygons.building
    order = np.arange(len(polygons))
    if np.any(building[1:] < building[:-1]):
        order = np.argsort(building, kind="stable")
    for first, last in pairwise(group_cuts(building[order], _BLOCK_POLYGONS)):
        _find_repeats(polygons, order[first:last], kept_as)
    is_kept = kept_as == np.arange(len(polygons))
    if is_kept.all():
        return polygons, kept_as, kept_as
    for owner in building[~is_kept].tolist():
        findings.add(DUPLICATE_POLYGON, building_ids[owner])
    rank = np.cumsum(is_kept) - 1
    kept = np.flatnonzero(is_kept)
    return select_polygons(polygons, kept), rank[kept_as], kept


def _find_repeats(polygons: Polygons, chosen: NDArray[np.int64], kept_as: NDArray[np.int64]) -> None:
    """Writes which polygon each of the chosen repeats, if any; the chosen are whole buildings."""
    hashes = np.zeros((2, len(chosen)), np.uint64)
    bits = polygons.points.view(np.uint64)
    hash_corners = small_cities.hash_corners
    if not small_cities.is_few(polygons.points.size):
        from lodbench.kernels.city import hash_corners
    hash_corners(bits, polygons.ring_starts, polygons.polygon_starts, chosen, hashes)
    is_interior = polygons.kind[chosen] == SurfaceKind.INTERIOR
    owner = polygons.building[chosen].astype(np.uint64)
    # Most cities repeat nothing, which one sort of short keys tells.
    keys = np.sort(hashes[0] ^ (owner << np.uint64(32)))
    if not np.any(keys[1:] == keys[:-1]):
        return
    columns = [owner, polygons.lod[chosen].astype(np.uint64), is_interior.astype(np.uint64), *hashes]
    number, _ = number_rows(columns)
    sizes = np.bincount(number)
    twice = np.flatnonzero((sizes[number] > 1) & ~is_interior)
    if len(twice) == 0:
        return
    part = polygons.building if polygons.part is None else polygons.part
    polygon, group = chosen[twice], number[twice]
    is_surface = polygons.kind[polygon] != SurfaceKind.UNKNOWN
    first_surface = np.full(len(sizes), -1, np.int64)
    first_surface[group[is_surface][::-1]] = polygon[is_surface][::-1]  # the first of a group is written last
    stand_in = first_surface[group]
    # Among surfaces, and among faces that no surface repeats, the first of each part stays.
    own = np.flatnonzero(is_surface | (stand_in < 0))
    rank, first = number_rows([group[own].astype(np.uint64), part[polygon[own]].astype(np.uint64)])
    stand_in[own] = polygon[own[first[rank]]]
    kept_as[polygon] = stand_in
