"""Do solids cut themselves, each other, or lie where they should not? Edges against triangles, city-wide.

An edge cuts a face where it passes through its inside by more than two millimetres on both sides; what only
touches does not. Candidates come from one tree of bounding boxes over all solids.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lodbench.citymodel.codes import (
    SHELL_OUTSIDE,
    SHELL_SELF_INTERSECTION,
    SHELLS_EQUAL,
    SHELLS_INTERSECT,
    SOLIDS_EQUAL,
    SOLIDS_INTERSECT,
)
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.objects import Solids
from lodbench.citymodel.shells import ShellReport
from lodbench.citymodel.solid_faces import SNAP_M, Ints, SolidFaces, faces_of, passes, winding
from lodbench.citymodel.solid_relations import check_composites, check_insides
from lodbench.findings import Findings

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
    overlapping = {(int(shell_solid[a]), int(shell_solid[b])) for a, b in seen}
    check_composites(report, faces, solids, shell_solid, overlapping)
    check_insides(report, faces, solids, seen)


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
        told = b"".join(sorted({point.tobytes() for point in corners.reshape(-1, 3)}))
        other = known.setdefault((int(part[shell]), int(lod[shell]), told), shell)
        if other != shell:
            is_one = shell_solid[other] == shell_solid[shell]
            code, words = (SHELLS_EQUAL, "shells") if is_one else (SOLIDS_EQUAL, "solids")
            report.add(code, shell, int(faces.point[own[0]]), f"two {words} have the same corners")


def _check_inner(report: ShellReport, faces: SolidFaces, solids: Solids, cut: set[tuple[int, int]]) -> None:
    """Reports inner shells that lie outside of the outer one; those that cut it are told already."""
    for solid in np.flatnonzero(np.diff(solids.shell_starts) > 1).tolist():
        outer = int(solids.shell_starts[solid])
        around = faces.corners[faces.shell == outer]
        for inner in range(outer + 1, int(solids.shell_starts[solid + 1])):
            own = np.flatnonzero(faces.edge_shell == inner)
            if len(own) and (outer, inner) not in cut:
                middle = faces.start[own].mean(axis=0)
                if abs(winding(around, middle)) < 0.5:
                    report.add(
                        SHELL_OUTSIDE, inner, int(faces.point[own[0]]), "a hole of a solid lies outside"
                    )
