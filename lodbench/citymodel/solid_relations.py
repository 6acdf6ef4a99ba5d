"""Do the solids of a composite hang together, and is the inside of a solid with holes in one piece?"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from lodbench.citymodel.codes import INTERIOR_DISCONNECTED, SOLIDS_DISCONNECTED
from lodbench.citymodel.identity import connected_components
from lodbench.citymodel.objects import Solids
from lodbench.citymodel.shells import ShellReport
from lodbench.citymodel.solid_faces import TOUCH_M, Floats, Ints, SolidFaces, passes, winding

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
            report.add(SOLIDS_DISCONNECTED, shell, point, f"{len(members)} solids in {len(pieces)} pieces")


def _share_a_face(first: Floats, second: Floats) -> bool:
    """Tells whether two sets of triangles lie on each other somewhere, face to face."""
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
        cut: Pairs of shells that cut each other, which are told already.
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
            report.add(INTERIOR_DISCONNECTED, shells[0], point, f"pieces: {count}")


def _touch(corners: Floats, shell: Ints) -> bool:
    """Tells whether a corner of one shell lies on a face of another."""
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
        seen = _seen_from(points[is_mine], points[~is_mine], corners)
        if seen.any():
            piece[np.isin(piece, piece[~is_mine][seen])] = piece[is_mine][0]
        else:
            num_apart += 1
            points, piece = points[~is_mine], piece[~is_mine]
    return num_apart


def _seen_from(points: Floats, others: Floats, corners: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Tells which other points some of the points see; the first of them that see any are enough."""
    seen = np.zeros(len(others), np.bool_)
    step = max(1, _MOST_PAIRS // max(1, len(others)))
    for k in range(0, len(points), step):
        block = points[k : k + step]
        ways = np.repeat(block, len(others), axis=0), np.tile(others, (len(block), 1))
        seen = np.asarray(_is_free(*ways, corners).reshape(len(block), len(others)).any(axis=0))
        if seen.any():
            break
    return seen


def _is_free(start: Floats, end: Floats, corners: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Tells which ways pass through no triangle."""
    unit = _unit_normals(corners)
    is_free = np.ones(len(start), np.bool_)
    for triangle, normal in zip(corners, unit, strict=True):
        open_ = np.flatnonzero(is_free)
        count = len(open_)
        is_hit = passes(start[open_], end[open_], np.broadcast_to(triangle, (count, 3, 3)),
                        np.broadcast_to(normal, (count, 3)), -TOUCH_M)  # fmt: skip
        is_free[open_[is_hit]] = False
    return is_free
