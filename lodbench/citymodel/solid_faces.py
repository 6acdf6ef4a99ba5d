"""Triangles and edges of the shells of a city's solids, and where these lie to each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.identity import number_rows
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.objects import Solids
from lodbench.citymodel.raw import take_segments
from lodbench.citymodel.selection import select_polygons
from lodbench.citymodel.triangulate import triangulate
from lodbench.findings import Findings

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

TOUCH_M = 2e-3
SNAP_M = 1e-3


@dataclass(frozen=True, slots=True)
class SolidFaces:
    """Triangles and edges of all shells.

    Attributes:
        corners: (T, 3, 3) of the triangles.
        shell: (T,) of each triangle.
        start, end: (E, 3) of the edges, each once per shell.
        edge_shell: (E,) of each edge.
        point: (E,) index of the start among the polygons' points.
    """

    corners: Floats
    shell: Ints
    start: Floats
    end: Floats
    edge_shell: Ints
    point: Ints


def faces_of(model: CityModel, solids: Solids) -> SolidFaces:
    """Returns the triangles and edges of all shells."""
    polygons = model.polygons
    is_there = solids.faces >= 0
    face_shell = np.repeat(np.arange(len(solids.face_starts) - 1), np.diff(solids.face_starts))[is_there]
    used, place = np.unique(solids.faces[is_there], return_inverse=True)
    own = select_polygons(polygons, used)
    result = triangulate(own, model.building_ids, Findings())
    triangle_starts = np.searchsorted(result.polygon, np.arange(len(used) + 1))
    chosen, counts = take_segments(triangle_starts, place.reshape(-1))
    corners = own.points[result.triangles[chosen]]
    shell = np.repeat(face_shell, np.diff(counts))
    rings, ring_starts = take_segments(polygons.polygon_starts, solids.faces[is_there])
    points, point_starts = take_segments(polygons.ring_starts, rings)
    following = np.arange(len(points)) + 1
    following[point_starts[1:] - 1] = point_starts[:-1]
    edge_shell = np.repeat(np.repeat(face_shell, np.diff(ring_starts)), np.diff(point_starts))
    start, end = polygons.points[points], polygons.points[points[following]]
    # Two faces share an edge: one of them is enough.
    snapped = np.rint(np.stack([start, end]) / SNAP_M).astype(np.int64).view(np.uint64)
    corner = number_rows(
        [edge_shell.repeat(2).astype(np.uint64), *snapped.transpose(1, 0, 2).reshape(-1, 3).T]
    )[0]
    ends = np.sort(corner.reshape(-1, 2), axis=1).astype(np.uint64)
    _, first = number_rows([ends[:, 0], ends[:, 1]])
    return SolidFaces(corners, shell, start[first], end[first], edge_shell[first], points[first])


def passes(
    start: Floats, end: Floats, corners: Floats, unit: Floats, rim_m: float = TOUCH_M
) -> NDArray[np.bool_]:
    """Tells which edges pass through their triangles, (N,), further from the rim than ``rim_m``."""
    before = np.einsum("ij,ij->i", start - corners[:, 0], unit)
    after = np.einsum("ij,ij->i", end - corners[:, 0], unit)
    is_cut: NDArray[np.bool_] = before * after < 0
    is_cut &= np.minimum(np.abs(before), np.abs(after)) > TOUCH_M
    chosen = np.flatnonzero(is_cut)  # a few: most edges stay on one side
    share = before[chosen] / (before[chosen] - after[chosen])
    place = start[chosen] + share[:, None] * (end[chosen] - start[chosen])
    for k in range(3):
        side = corners[chosen, (k + 1) % 3] - corners[chosen, k]
        inward = np.cross(unit[chosen], side)
        inward /= np.maximum(np.linalg.norm(inward, axis=1), 1e-300)[:, None]
        is_cut[chosen] &= np.einsum("ij,ij->i", place - corners[chosen, k], inward) > rim_m
    return is_cut


def winding(corners: Floats, point: Floats) -> float:
    """Returns how often triangles go round a point, by their solid angles (van Oosterom and Strackee)."""
    a, b, c = (corners[:, k] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = (
        np.einsum("ij,ij->i", a, b) * lc + np.einsum("ij,ij->i", b, c) * la + np.einsum("ij,ij->i", c, a) * lb
    )
    return float(np.arctan2(volume, la * lb * lc + dots).sum() / (2 * np.pi))
