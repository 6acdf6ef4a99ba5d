"""Do solids cut themselves, each other, or lie where they should not? Edges against triangles, city-wide.

An edge cuts a face where it passes through its inside by more than two millimetres on both sides; what only
touches does not. Candidates come from one tree of bounding boxes over all solids.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from lodbench.citymodel import codes
from lodbench.citymodel.checks.shells import (
    SNAP_M,
    TOUCH_M,
    Floats,
    Ints,
    ShellReport,
    SolidFaces,
    faces_of,
    passes,
    winding,
)
from lodbench.citymodel.model import CityModel, Solids
from lodbench.citymodel.scene import connected_components
from lodbench.findings import Findings

# Two faces are one on the other where they share this much.
_MIN_SHARED_M2 = 1e-4
_PARALLEL = 1.0 - 1e-6
# Points inside of a solid that are joined where they see each other, and triangles up to which it is done.
_NUM_SAMPLES, _MAX_TRIANGLES = 240, 2000
_OFF_FACE_M = 0.01
# Of each point so many neighbours are tried first, and so many pairs at a time after that.
_NEIGHBOURS, _MOST_PAIRS = 16, 100_000


def check_composites(
    report: ShellReport,
    faces: SolidFaces,
    solids: Solids,
    shell_solid: Ints,
    overlapping: set[tuple[int, int]],
) -> None:
    """Reports composite solids whose solids do not all hang together by faces that they share.

    Args:
        report: Receives a finding per composite.
        faces: Of all shells.
        solids: Of the city.
        shell_solid: Solid of each shell.
        overlapping: Pairs of solids that cut each other, which are connected, if for the wrong reason.
    """
    solid_of = shell_solid[faces.shell]
    for composite in np.unique(solids.composite[solids.composite >= 0]).tolist():
        members = np.flatnonzero(solids.composite == composite)
        members = members[np.isin(members, solid_of)]
        corners = [faces.corners[solid_of == member] for member in members]
        joined = [
            (a, b)
            for a, b in combinations(range(len(members)), 2)
            if {(int(members[a]), int(members[b])), (int(members[b]), int(members[a]))} & overlapping
            or _share_a_face(corners[a], corners[b])
        ]
        pairs = np.array(joined, np.int64).reshape(-1, 2)
        pieces = np.unique(connected_components(len(members), pairs[:, 0], pairs[:, 1]))
        if len(pieces) > 1:
            shell = int(solids.shell_starts[members[pieces[1]]])
            point = int(faces.point[np.argmax(faces.edge_shell == shell)])
            report.add(
                codes.SOLIDS_DISCONNECTED, shell, point, f"{len(members)} solids in {len(pieces)} pieces"
            )


def _share_a_face(first: Floats, second: Floats) -> bool:
    """Returns whether two sets of triangles lie on each other somewhere, face to face."""
    import shapely

    gap = np.maximum(first.min(axis=(0, 1)) - second.max(axis=(0, 1)),
                     second.min(axis=(0, 1)) - first.max(axis=(0, 1)))  # fmt: skip
    if (gap > TOUCH_M).any():
        return False
    normals = [_unit_normals(corners) for corners in (first, second)]
    one, other = np.nonzero(np.abs(normals[0] @ normals[1].T) > _PARALLEL)
    offsets = second[other] - first[one, :1]
    is_near = np.abs(np.einsum("ijk,ik->ij", offsets, normals[0][one])).max(axis=1) < TOUCH_M
    one, other = one[is_near], other[is_near]
    across = first[one, 1] - first[one, 0]
    across /= np.maximum(np.linalg.norm(across, axis=1), 1e-300)[:, None]
    frames = np.stack([across, np.cross(normals[0][one], across)], axis=2)
    shapes = [
        shapely.polygons(np.einsum("ijk,ikl->ijl", corners - first[one, :1], frames))
        for corners in (first[one], second[other])
    ]
    return bool((shapely.area(shapely.intersection(*shapes)) > _MIN_SHARED_M2).any())


def _unit_normals(corners: Floats) -> Floats:
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit: Floats = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    return unit


def check_insides(report: ShellReport, faces: SolidFaces, solids: Solids, cut: set[tuple[int, int]]) -> None:
    """Reports solids whose holes cut their inside in two.

    Points inside are joined where the way between them is free; holes that touch nothing cut nothing, so that
    only solids with a shell that touches another are looked at.

    Args:
        report: Receives a finding per solid.
        faces: Of all shells.
        solids: Of the city.
        cut: Pairs of shells that cut each other, which are reported already.
    """
    for solid in np.flatnonzero(np.diff(solids.shell_starts) > 1).tolist():
        shells = range(int(solids.shell_starts[solid]), int(solids.shell_starts[solid + 1]))
        is_own = np.isin(faces.shell, shells)
        corners, shell = faces.corners[is_own], faces.shell[is_own]
        is_crossed = any((a, b) in cut for a in shells for b in shells)
        if is_crossed or len(corners) > _MAX_TRIANGLES or not _touch(corners, shell):
            continue
        count = _num_pieces(_inside_points(corners), corners)
        if count > 1:
            point = int(faces.point[np.argmax(faces.edge_shell == shells[1])])
            report.add(codes.INTERIOR_DISCONNECTED, shells[0], point, f"pieces: {count}")


def _touch(corners: Floats, shell: Ints) -> bool:
    """Returns whether a corner of one shell lies on a face of another."""
    unit = _unit_normals(corners)
    for own in np.unique(shell):
        points = corners[shell == own].reshape(-1, 3)
        others, normals = corners[shell != own], unit[shell != own]
        for point in np.unique(points, axis=0):
            is_on = np.abs(np.einsum("ij,ij->i", point - others[:, 0], normals)) < TOUCH_M
            for k in range(3):
                side = others[:, (k + 1) % 3] - others[:, k]
                inward = np.cross(normals, side)
                inward /= np.maximum(np.linalg.norm(inward, axis=1), 1e-300)[:, None]
                is_on &= np.einsum("ij,ij->i", point - others[:, k], inward) > -TOUCH_M
            if is_on.any():
                return True
    return False


def _inside_points(corners: Floats) -> Floats:
    """Returns points inside of a solid: just off its faces, on both their sides, and all over it."""
    unit = _unit_normals(corners)
    middle = corners.mean(axis=1)
    shares = np.array([[0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8]])
    spots = np.concatenate([middle, *np.einsum("sk,tkc->stc", shares, corners)])
    normals = np.tile(unit, (4, 1))
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    generator = np.random.Generator(np.random.Philox(key=len(corners)))
    points = np.concatenate(
        [
            spots + _OFF_FACE_M * normals,
            spots - _OFF_FACE_M * normals,
            generator.uniform(low, high, (_NUM_SAMPLES, 3)),
        ]
    )
    is_inside = [abs(winding(corners, point)) > 0.5 for point in points]
    return points[is_inside]


def _num_pieces(points: Floats, corners: Floats) -> int:
    """Returns how many pieces points fall into that are joined where they see each other.

    Neighbours are tried first, then the smallest piece against all others: of thousands of points all pairs
    would not fit into memory.
    """
    from scipy.spatial import KDTree

    if len(points) < 2:
        return len(points)
    _, near = KDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))
    first, second = np.repeat(np.arange(len(points)), near.shape[1]), near.ravel()
    is_free = _is_free(points[first], points[second], corners)
    piece = connected_components(len(points), first[is_free], second[is_free])
    num_apart = 0
    while len(piece):
        labels, sizes = np.unique(piece, return_counts=True)
        is_mine = piece == labels[np.argmin(sizes)]
        is_visible = _in_sight(points[is_mine], points[~is_mine], corners)
        if is_visible.any():
            piece[np.isin(piece, piece[~is_mine][is_visible])] = piece[is_mine][0]
        else:
            num_apart += 1
            points, piece = points[~is_mine], piece[~is_mine]
    return num_apart


def _in_sight(points: Floats, others: Floats, corners: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Returns which other points some of the points see; the first of them that see any are enough."""
    is_visible = np.zeros(len(others), np.bool_)
    step = max(1, _MOST_PAIRS // max(1, len(others)))
    for k in range(0, len(points), step):
        block = points[k : k + step]
        ways = np.repeat(block, len(others), axis=0), np.tile(others, (len(block), 1))
        is_visible = np.asarray(_is_free(*ways, corners).reshape(len(block), len(others)).any(axis=0))
        if is_visible.any():
            break
    return is_visible


def _is_free(start: Floats, end: Floats, corners: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Returns which ways pass through no triangle."""
    unit = _unit_normals(corners)
    is_free = np.ones(len(start), np.bool_)
    for triangle, normal in zip(corners, unit, strict=True):
        open_ = np.flatnonzero(is_free)
        count = len(open_)
        is_hit = passes(start[open_], end[open_], np.broadcast_to(triangle, (count, 3, 3)),
                        np.broadcast_to(normal, (count, 3)), -TOUCH_M)  # fmt: skip
        is_free[open_[is_hit]] = False
    return is_free


# Edges looked up at a time: some hundred candidates each are held meanwhile.
_BLOCK_EDGES = 1 << 14


def check_solids(model: CityModel, findings: Findings) -> None:
    """Adds solids and shells that cut themselves or each other, lie twice, or lie outside of their outside.

    Args:
        model: Read with ``ReadOptions(has_details=True)``; without solids nothing is found.
        findings: Receives at most one finding per pair of shells, with a place.
    """
    solids = model.solids
    if solids is None or not (solids.faces >= 0).any():
        return
    faces = faces_of(model, solids)
    shell_solid = np.repeat(np.arange(len(solids.part)), np.diff(solids.shell_starts))
    report = ShellReport(model, findings, solids.part[shell_solid])
    lod = _lods(model, solids)
    part = solids.part[shell_solid].astype(np.int64)
    cut_pairs: set[tuple[int, int]] = set()
    for first, second, point in _crossings(faces, part, lod):
        pair = (min(first, second), max(first, second))
        if pair in cut_pairs:
            continue
        cut_pairs.add(pair)
        if first == second:
            report.add(
                codes.SHELL_SELF_INTERSECTION, first, point, "an edge passes through a face of its shell"
            )
        elif shell_solid[first] == shell_solid[second]:
            report.add(codes.SHELLS_INTERSECT, first, point, "two shells of a solid cut each other")
        else:
            report.add(codes.SOLIDS_INTERSECT, first, point, "an edge passes through a face of another solid")
    _check_twins(report, faces, shell_solid, part, lod)
    _check_inner(report, faces, solids, cut_pairs)
    overlapping = {(int(shell_solid[a]), int(shell_solid[b])) for a, b in cut_pairs}
    check_composites(report, faces, solids, shell_solid, overlapping)
    check_insides(report, faces, solids, cut_pairs)


def _lods(model: CityModel, solids: Solids) -> Ints:
    """Returns the level of each shell: of its first face that is there, -1 without any."""
    lod = np.full(len(solids.face_starts) - 1, -1, np.int64)
    kept = np.flatnonzero(solids.faces >= 0)
    shells, first = np.unique(np.searchsorted(solids.face_starts, kept, side="right") - 1, return_index=True)
    lod[shells] = model.polygons.lod[solids.faces[kept[first]]]
    return lod


def _crossings(faces: SolidFaces, part: Ints, lod: Ints) -> Iterator[tuple[int, int, int]]:
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
        is_cut = passes(faces.start[edge], faces.end[edge], faces.corners[triangle], unit[triangle])
        hits = zip(
            faces.edge_shell[edge[is_cut]],
            faces.shell[triangle[is_cut]],
            faces.point[edge[is_cut]],
            strict=True,
        )
        yield from ((int(a), int(b), int(p)) for a, b, p in hits)


def _check_twins(report: ShellReport, faces: SolidFaces, shell_solid: Ints, part: Ints, lod: Ints) -> None:
    """Reports shells of one object and level that have the same corners."""
    known: dict[tuple[int, int, bytes], int] = {}
    order = np.argsort(faces.edge_shell, kind="stable")
    snapped = np.rint(np.stack([faces.start, faces.end], axis=1) / SNAP_M).astype(np.int64)[order]
    shells, firsts = np.unique(faces.edge_shell[order], return_index=True)
    for shell, own, corners in zip(
        shells.tolist(), np.split(order, firsts[1:]), np.split(snapped, firsts[1:]), strict=True
    ):
        stated = b"".join(sorted({point.tobytes() for point in corners.reshape(-1, 3)}))
        other = known.setdefault((int(part[shell]), int(lod[shell]), stated), shell)
        if other != shell:
            is_one = shell_solid[other] == shell_solid[shell]
            code, words = (codes.SHELLS_EQUAL, "shells") if is_one else (codes.SOLIDS_EQUAL, "solids")
            report.add(code, shell, int(faces.point[own[0]]), f"two {words} have the same corners")


def _check_inner(report: ShellReport, faces: SolidFaces, solids: Solids, cut: set[tuple[int, int]]) -> None:
    """Reports inner shells that lie outside of the outer one; those that cut it are reported already."""
    for solid in np.flatnonzero(np.diff(solids.shell_starts) > 1).tolist():
        outer = int(solids.shell_starts[solid])
        outer_corners = faces.corners[faces.shell == outer]
        for inner in range(outer + 1, int(solids.shell_starts[solid + 1])):
            own = np.flatnonzero(faces.edge_shell == inner)
            if len(own) and (outer, inner) not in cut:
                middle = faces.start[own].mean(axis=0)
                if abs(winding(outer_corners, middle)) < 0.5:
                    report.add(
                        codes.SHELL_OUTSIDE, inner, int(faces.point[own[0]]), "a hole of a solid lies outside"
                    )
