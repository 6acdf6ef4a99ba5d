"""Triangles and edges of the shells of a city's solids, and where these lie to each other.

Are solids watertight? Shells of polygons as closed, consistently turned, two-manifold surfaces. Points
nearer than a millimetre are one vertex. All shells of a city are looked at together: half-edges are sorted
once, and every test is a count over them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel import codes
from lodbench.citymodel.model import CityModel, Polygons, Solids, select_polygons, take_segments
from lodbench.citymodel.scene import connected_components, number_rows
from lodbench.citymodel.triangulate import triangulate
from lodbench.findings import FindingCode, Findings

_SNAP_M = 1e-3
_MIN_FACES = 4


@dataclass(frozen=True, slots=True)
class _Edges:
    """Half-edges of all shells, each from a corner of a face to the next."""

    # (E,) shell, and face among all faces
    shell: NDArray[np.int64]
    face: NDArray[np.int64]
    # (E,) vertices
    start: NDArray[np.int64]
    end: NDArray[np.int64]
    following: NDArray[np.int64]  # (E,) the half-edge that goes on from ``end`` in the same ring
    point: NDArray[np.int64]  # (E,) index of the start among the polygons' points
    group: NDArray[np.int64]  # (E,) number of the undirected edge within its shell


def check_shells(model: CityModel, findings: Findings) -> None:
    """Adds what is wrong with the shells of a city's solids.

    Args:
        model: Read with ``ReadOptions(has_details=True)``; without solids nothing is found.
        findings: Receives at most one finding of a kind per shell, with the first place.
    """
    solids = model.solids
    if solids is None or len(solids.faces) == 0:
        return
    edges = _edges(model.polygons, solids)
    num_shells = len(solids.face_starts) - 1
    shell_solid = np.repeat(np.arange(len(solids.part)), np.diff(solids.shell_starts))
    report = ShellReport(model, findings, solids.part[shell_solid])

    num_faces = np.diff(solids.face_starts)
    for shell in np.flatnonzero(num_faces < _MIN_FACES).tolist():
        report.add(codes.SHELL_TOO_FEW_FACES, shell, -1, f"faces: {num_faces[shell]}")
    count = np.bincount(edges.group)
    forward = np.bincount(edges.group, edges.start < edges.end)
    is_open = (count == 1)[edges.group]
    is_many = (count > 2)[edges.group]
    is_turned = ((count == 2) & (forward != 1))[edges.group]
    for code, is_met, words in (
        (codes.SHELL_NOT_CLOSED, is_open, "edges with one face only"),
        (codes.NON_MANIFOLD_EDGE, is_many, "edges with three faces or more"),
        (codes.FACE_TURNED, is_turned, "edges that both faces run along the same way"),
    ):
        _report_edges(report, code, edges, is_met, words)
    has_fault = np.zeros(num_shells, np.bool_)
    has_fault[edges.shell[is_open | is_many]] = True
    has_fault |= num_faces < _MIN_FACES
    _check_vertices(report, edges, ~has_fault)
    _check_pieces(report, edges, solids, ~has_fault)
    has_fault[edges.shell[is_turned]] = True
    _check_volumes(report, model.polygons, solids, ~has_fault)


class ShellReport:
    """Adds findings of shells under the ids of their buildings."""

    def __init__(self, model: CityModel, findings: Findings, part: NDArray[np.int32]) -> None:
        self._model = model
        self._findings = findings
        self._part = part

    def add(self, code: FindingCode, shell: int, point: int, detail: str) -> None:
        """Adds a finding of a shell, at one of the polygons' points or nowhere (-1)."""
        model = self._model
        part = int(self._part[shell])
        name = model.objects.ids[part] if model.objects is not None else model.building_ids[part]
        building = int(model.objects.building[part]) if model.objects is not None else part
        own = "" if name == model.building_ids[building] else f"{name}: "
        place = None if point < 0 else tuple((model.polygons.points[point] + model.origin).tolist())
        self._findings.add(code, model.building_ids[building], own + detail, place=place)


def _edges(polygons: Polygons, solids: Solids) -> _Edges:
    """Returns the half-edges of all shells; those within a vertex are left out."""
    is_there = solids.faces >= 0
    face_shell = np.repeat(np.arange(len(solids.face_starts) - 1), np.diff(solids.face_starts))
    faces, face_shell = solids.faces[is_there], face_shell[is_there]
    is_flipped = solids.is_flipped[is_there]
    rings, ring_starts = take_segments(polygons.polygon_starts, faces)
    points, point_starts = take_segments(polygons.ring_starts, rings)
    ring_face = np.repeat(np.arange(len(faces)), np.diff(ring_starts))
    face = np.repeat(ring_face, np.diff(point_starts))
    used, inverse = np.unique(points, return_inverse=True)
    snapped = np.rint(polygons.points[used] / _SNAP_M).astype(np.int64).view(np.uint64)
    vertex = number_rows([np.ascontiguousarray(column) for column in snapped.T])[0][inverse.reshape(-1)]
    # Corners that repeat their follower make no edge.
    following = np.arange(len(points)) + 1
    following[point_starts[1:] - 1] = point_starts[:-1]
    kept = np.flatnonzero(vertex != vertex[following])
    points, vertex, face = points[kept], vertex[kept], face[kept]
    ring = np.repeat(np.arange(len(rings)), np.diff(point_starts))[kept]
    is_last = np.append(ring[1:] != ring[:-1], True)[: len(ring)]
    firsts = np.flatnonzero(np.append(True, ring[1:] != ring[:-1])[: len(ring)])
    following = np.arange(len(kept)) + 1
    following[is_last] = firsts
    start, end = vertex, vertex[following]
    before = np.empty_like(following)
    before[following] = np.arange(len(following))
    turn = is_flipped[face]
    # Viewed from behind an edge runs from its end to its start, and what follows is what came before.
    shell = face_shell[face]
    low, high = np.minimum(start, end), np.maximum(start, end)
    columns = [column.astype(np.uint64) for column in (shell, low, high)]
    return _Edges(
        shell=shell,
        face=face,
        start=np.where(turn, end, start),
        end=np.where(turn, start, end),
        following=np.where(turn, before, following),
        point=np.where(turn, points[following], points),
        group=number_rows(columns)[0],
    )


def _report_edges(
    report: ShellReport, code: FindingCode, edges: _Edges, is_met: NDArray[np.bool_], words: str
) -> None:
    met = np.flatnonzero(is_met)
    met = met[np.unique(edges.group[met], return_index=True)[1]]  # one half of each edge
    shells, first, counts = np.unique(edges.shell[met], return_index=True, return_counts=True)
    points = edges.point[met[first]]
    for shell, point, count in zip(shells.tolist(), points.tolist(), counts.tolist(), strict=True):
        report.add(code, shell, point, f"{words}: {count}")


def _pairs(edges: _Edges, is_sound: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the two half-edges of every edge of the sound shells, which have two each."""
    own = np.flatnonzero(is_sound[edges.shell])
    order = own[np.argsort(edges.group[own], kind="stable")]
    return order[0::2], order[1::2]


def _check_vertices(report: ShellReport, edges: _Edges, is_sound: NDArray[np.bool_]) -> None:
    """Reports vertices whose faces hang together in more than one fan."""
    first, second = _pairs(edges, is_sound)
    is_opposite = edges.start[first] != edges.start[second]
    after_first, after_second = edges.following[first], edges.following[second]
    # A half-edge stands for the corner of its face where it starts.
    one = np.concatenate([first, after_first])
    other = np.concatenate(
        [np.where(is_opposite, after_second, second), np.where(is_opposite, second, after_second)]
    )
    fan = connected_components(len(edges.shell), one, other)
    own = np.flatnonzero(is_sound[edges.shell])
    shell, vertex = edges.shell[own], edges.start[own]
    order = np.lexsort((fan[own], vertex, shell))
    shell, vertex, fans, corners = shell[order], vertex[order], fan[own][order], own[order]
    is_split = (shell[1:] == shell[:-1]) & (vertex[1:] == vertex[:-1]) & (fans[1:] != fans[:-1])
    where = np.flatnonzero(is_split) + 1
    shells, first_place, counts = np.unique(shell[where], return_index=True, return_counts=True)
    for number, place, count in zip(shells.tolist(), first_place.tolist(), counts.tolist(), strict=True):
        point = int(edges.point[corners[where[place]]])
        report.add(codes.NON_MANIFOLD_VERTEX, number, point, f"vertices where fans of faces touch: {count}")


def _check_pieces(report: ShellReport, edges: _Edges, solids: Solids, is_sound: NDArray[np.bool_]) -> None:
    """Reports shells whose faces do not all hang together by edges."""
    first, second = _pairs(edges, is_sound)
    piece = connected_components(int(edges.face.max(initial=-1)) + 1, edges.face[first], edges.face[second])
    own = np.flatnonzero(is_sound[edges.shell])
    pairs = np.unique(np.stack([edges.shell[own], piece[edges.face[own]]]), axis=1)
    shells, counts = np.unique(pairs[0], return_counts=True)
    for shell in shells[counts > 1].tolist():
        point = int(edges.point[own[np.argmax(edges.shell[own] == shell)]])
        report.add(codes.SHELL_IN_PIECES, shell, point, f"pieces: {int(counts[shells == shell][0])}")


def _check_volumes(
    report: ShellReport, polygons: Polygons, solids: Solids, is_sound: NDArray[np.bool_]
) -> None:
    """Reports outer shells that enclose a negative volume, and inner ones a positive one."""
    rings = np.diff(polygons.ring_starts)
    origin = polygons.points[polygons.ring_starts[:-1]]
    relative = polygons.points - np.repeat(origin, rings, axis=0)
    following = np.concatenate([relative[1:], relative[:1]])
    following[polygons.ring_starts[1:] - 1] = 0.0
    vectors = 0.5 * np.add.reduceat(np.cross(relative, following), polygons.ring_starts[:-1], axis=0)
    is_outer = np.zeros(len(solids.face_starts) - 1, np.bool_)
    is_outer[solids.shell_starts[:-1]] = True
    for shell in np.flatnonzero(is_sound).tolist():
        span = slice(solids.face_starts[shell], solids.face_starts[shell + 1])
        faces, turned = solids.faces[span], solids.is_flipped[span]
        faces, turned = faces[faces >= 0], turned[faces >= 0]
        if len(faces) == 0:
            continue  # of a level that was left out
        own, starts = take_segments(polygons.polygon_starts, faces)
        sign = np.repeat(np.where(turned, -1.0, 1.0), np.diff(starts))
        middle = origin[own[0]]
        volume = float(np.sum(sign * np.einsum("ij,ij->i", origin[own] - middle, vectors[own])) / 3.0)
        if (volume < 0) == bool(is_outer[shell]) and abs(volume) > _SNAP_M:
            point = int(polygons.ring_starts[own[0]])
            report.add(codes.SHELL_INSIDE_OUT, shell, point, f"encloses {volume:.3f} m3")


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

TOUCH_M = 2e-3
SNAP_M = 1e-3


@dataclass(frozen=True, slots=True)
class SolidFaces:
    """Triangles and edges of all shells."""

    corners: Floats  # (T, 3, 3) of the triangles
    shell: Ints  # (T,) of each triangle
    # (E, 3) of the edges, each once per shell
    start: Floats
    end: Floats
    edge_shell: Ints  # (E,) of each edge
    point: Ints  # (E,) index of the start among the polygons' points


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
    """Returns which edges pass through their triangles, (N,), further from the rim than ``rim_m``."""
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
