"""Do solids cut themselves, each other, or lie where they should not? Edges against triangles, city-wide.

An edge cuts a face where it passes through its inside by more than two millimetres on both sides; what only
touches does not. Candidates come from one tree of bounding boxes over all solids.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import (
    SHELL_OUTSIDE,
    SHELL_SELF_INTERSECTION,
    SHELLS_EQUAL,
    SHELLS_INTERSECT,
    SOLIDS_EQUAL,
    SOLIDS_INTERSECT,
)
from lodbench.citymodel.identity import number_rows
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.objects import Solids
from lodbench.citymodel.raw import take_segments
from lodbench.citymodel.selection import select_polygons
from lodbench.citymodel.shells import ShellReport
from lodbench.citymodel.triangulate import triangulate
from lodbench.findings import Findings

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_TOUCH_M = 2e-3
_SNAP_M = 1e-3
# Edges looked up at a time: some hundred candidates each are held meanwhile.
_BLOCK_EDGES = 1 << 14


@dataclass(frozen=True, slots=True)
class _Faces:
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


def check_solids(model: CityModel, findings: Findings) -> None:
    """Adds solids and shells that cut themselves or each other, lie twice, or lie outside of their outside.

    Args:
        model: Read with ``ReadOptions(has_details=True)``; without solids nothing is found.
        findings: Receives at most one finding per pair of shells, with a place.
    """
    solids = model.solids
    if solids is None or len(solids.faces) == 0:
        return
    faces = _faces(model, solids)
    shell_solid = np.repeat(np.arange(len(solids.part)), np.diff(solids.shell_starts))
    report = ShellReport(model, findings, solids.part[shell_solid])
    of_shell = solids.face_starts[:-1]
    lod = np.full(len(shell_solid), -1, np.int64)
    filled = np.flatnonzero(np.diff(solids.face_starts))
    lod[filled] = model.polygons.lod[np.maximum(solids.faces[of_shell[filled]], 0)]
    part = solids.part[shell_solid].astype(np.int64)
    seen: set[tuple[int, int]] = set()
    for first, second, point in _crossings(faces, part, lod):
        pair = (min(first, second), max(first, second))
        if pair in seen:
            continue
        seen.add(pair)
        if first == second:
            report.add(SHELL_SELF_INTERSECTION, first, point, "an edge passes through a face of its shell")
        elif shell_solid[first] == shell_solid[second]:
            report.add(SHELLS_INTERSECT, first, point, "two shells of a solid cut each other")
        else:
            report.add(SOLIDS_INTERSECT, first, point, "an edge passes through a face of another solid")
    _check_twins(report, faces, shell_solid, part, lod)
    _check_inner(report, faces, solids, seen)


def _faces(model: CityModel, solids: Solids) -> _Faces:
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
    snapped = np.rint(np.stack([start, end]) / _SNAP_M).astype(np.int64).view(np.uint64)
    corner = number_rows(
        [edge_shell.repeat(2).astype(np.uint64), *snapped.transpose(1, 0, 2).reshape(-1, 3).T]
    )[0]
    ends = np.sort(corner.reshape(-1, 2), axis=1).astype(np.uint64)
    _, first = number_rows([ends[:, 0], ends[:, 1]])
    return _Faces(corners, shell, start[first], end[first], edge_shell[first], points[first])


def _crossings(faces: _Faces, part: Ints, lod: Ints) -> Iterator[tuple[int, int, int]]:
    """Yields the shell of an edge, that of a face of its object and level that it cuts, and its start."""
    import shapely

    low, high = faces.corners.min(axis=1), faces.corners.max(axis=1)
    tree = shapely.STRtree(shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1]))
    normals = np.cross(faces.corners[:, 1] - faces.corners[:, 0], faces.corners[:, 2] - faces.corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    unit = normals / np.maximum(lengths, 1e-300)[:, None]
    edge_low, edge_high = np.minimum(faces.start, faces.end), np.maximum(faces.start, faces.end)
    boxes = shapely.box(edge_low[:, 0], edge_low[:, 1], edge_high[:, 0], edge_high[:, 1])
    for block in range(0, len(boxes), _BLOCK_EDGES):
        edge, triangle = tree.query(boxes[block : block + _BLOCK_EDGES])
        edge += block
        one, other = faces.edge_shell[edge], faces.shell[triangle]
        is_near = (part[one] == part[other]) & (lod[one] == lod[other]) & (lengths[triangle] > 0)
        is_near &= (edge_low[edge, 2] <= high[triangle, 2]) & (edge_high[edge, 2] >= low[triangle, 2])
        edge, triangle = edge[is_near], triangle[is_near]
        is_cut = _passes(faces.start[edge], faces.end[edge], faces.corners[triangle], unit[triangle])
        hits = zip(
            faces.edge_shell[edge[is_cut]],
            faces.shell[triangle[is_cut]],
            faces.point[edge[is_cut]],
            strict=True,
        )
        yield from ((int(a), int(b), int(p)) for a, b, p in hits)


def _passes(start: Floats, end: Floats, corners: Floats, unit: Floats) -> NDArray[np.bool_]:
    """Tells which edges pass through the insides of their triangles, (N,)."""
    before = np.einsum("ij,ij->i", start - corners[:, 0], unit)
    after = np.einsum("ij,ij->i", end - corners[:, 0], unit)
    is_cut: NDArray[np.bool_] = before * after < 0
    is_cut &= np.minimum(np.abs(before), np.abs(after)) > _TOUCH_M
    chosen = np.flatnonzero(is_cut)  # a few: most edges stay on one side
    share = before[chosen] / (before[chosen] - after[chosen])
    place = start[chosen] + share[:, None] * (end[chosen] - start[chosen])
    for k in range(3):
        side = corners[chosen, (k + 1) % 3] - corners[chosen, k]
        inward = np.cross(unit[chosen], side)
        inward /= np.maximum(np.linalg.norm(inward, axis=1), 1e-300)[:, None]
        is_cut[chosen] &= np.einsum("ij,ij->i", place - corners[chosen, k], inward) > _TOUCH_M
    return is_cut


def _check_twins(report: ShellReport, faces: _Faces, shell_solid: Ints, part: Ints, lod: Ints) -> None:
    """Reports shells of one object and level that have the same corners."""
    known: dict[tuple[int, int, bytes], int] = {}
    order = np.argsort(faces.edge_shell, kind="stable")
    snapped = np.rint(np.stack([faces.start, faces.end], axis=1) / _SNAP_M).astype(np.int64)[order]
    shells, firsts = np.unique(faces.edge_shell[order], return_index=True)
    for shell, own, corners in zip(
        shells.tolist(), np.split(order, firsts[1:]), np.split(snapped, firsts[1:]), strict=True
    ):
        told = b"".join(sorted({point.tobytes() for point in corners.reshape(-1, 3)}))
        other = known.setdefault((int(part[shell]), int(lod[shell]), told), shell)
        if other != shell:
            is_one = shell_solid[other] == shell_solid[shell]
            code, words = (SHELLS_EQUAL, "shells") if is_one else (SOLIDS_EQUAL, "solids")
            report.add(code, shell, int(faces.point[own[0]]), f"two {words} have the same corners")


def _check_inner(report: ShellReport, faces: _Faces, solids: Solids, cut: set[tuple[int, int]]) -> None:
    """Reports inner shells that lie outside of the outer one; those that cut it are told already."""
    for solid in np.flatnonzero(np.diff(solids.shell_starts) > 1).tolist():
        outer = int(solids.shell_starts[solid])
        around = faces.corners[faces.shell == outer]
        for inner in range(outer + 1, int(solids.shell_starts[solid + 1])):
            own = np.flatnonzero(faces.edge_shell == inner)
            if len(own) and (outer, inner) not in cut:
                middle = faces.start[own].mean(axis=0)
                if abs(_winding(around, middle)) < 0.5:
                    report.add(
                        SHELL_OUTSIDE, inner, int(faces.point[own[0]]), "a hole of a solid lies outside"
                    )


def _winding(corners: Floats, point: Floats) -> float:
    """Returns how often triangles go round a point, by their solid angles (van Oosterom and Strackee)."""
    a, b, c = (corners[:, k] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = (
        np.einsum("ij,ij->i", a, b) * lc + np.einsum("ij,ij->i", b, c) * la + np.einsum("ij,ij->i", c, a) * lb
    )
    return float(np.arctan2(volume, la * lb * lc + dots).sum() / (2 * np.pi))
