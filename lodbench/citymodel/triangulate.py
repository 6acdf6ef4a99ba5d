"""Polygons of a level to triangles: three and four corners at once, earcut for the rest, areas checked.

Every polygon is seen along its Newell normal, from an origin of its own, in
float64. The areas of its triangles must add up to its Newell area; where they do not, the polygon
is not planar or crosses itself, and a finding gives both areas.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import AREA_MISMATCH, FAR_FROM_PLANAR, NOT_PLANAR, ZERO_AREA
from lodbench.citymodel.model import (
    COARSEST,
    FINEST,
    CityModel,
    Polygons,
    SurfaceKind,
    choose_lod,
    outer_parts,
    plain_level,
    slice_polygons,
    take_segments,
)
from lodbench.findings import Findings

PLANAR_TOLERANCE_M = 0.01  # what surveys promise for a planar face; 3D city validators use the same
_MAX_BEND_M = 1.0  # beyond it nobody knows which surface was meant
AREA_TOLERANCE = 1e-4  # relative
# Below this a surface is invisible at any distance a drone keeps, and relative areas mean nothing.
_MIN_AREA_M2 = 1e-6
# Cutting ears takes the square of a polygon's corners: 4 s at this many that cross each other, hours at
# millions. No roof, wall or ground of a building comes near; a larger polygon is not cut, and told as lost.
MAX_CORNERS = 10_000
# A few megabytes of points at a time: fast in the processor's cache, and no peak on large cities.
CHUNK_POLYGONS = 16384


@dataclass(frozen=True, slots=True)
class Triangulation:
    """Triangles of polygons, and what became of each polygon's area."""

    triangles: NDArray[np.int64]  # (T, 3) int64 indices into the polygons' points
    polygon: NDArray[np.int64]  # (T,) int64 polygon of each triangle, ascending
    # (N,) Newell area, holes taken off; where it cancels out, what the outline goes round
    area_m2: NDArray[np.float64]
    meshed_m2: NDArray[np.float64]  # (N,) summed area of the triangles
    # (N,) the same, seen along the polygon's normal: what the triangles cover of it
    covered_m2: NDArray[np.float64]
    deviation_m: NDArray[np.float64]  # (N,) largest distance of a corner from the mean plane

    @property
    def lost_m2(self) -> float:
        """Area the triangles do not cover, over all polygons that come out smaller than they are."""
        return float(np.maximum(self.area_m2 - self.covered_m2, 0.0).sum())

    @property
    def excess_m2(self) -> float:
        """Area the triangles cover beyond their polygons, over all polygons that cross themselves."""
        return float(np.maximum(self.covered_m2 - self.area_m2, 0.0).sum())


def triangulate(
    polygons: Polygons, building_ids: tuple[str, ...], findings: Findings, *, num_before: int = 0
) -> Triangulation:
    """Returns the triangles of all polygons, oriented as the polygons are.

    Args:
        polygons: Clean polygons: finite points, rings of three points or more.
        building_ids: For the findings.
        findings: Receives ``ZERO_AREA``, ``NOT_PLANAR`` and ``AREA_MISMATCH``.
        num_before: Polygons of the level in earlier calls; the findings number them through.
    """
    chunks = range(0, max(len(polygons), 1), CHUNK_POLYGONS)
    parts = [_triangulate(slice_polygons(polygons, n, n + CHUNK_POLYGONS)) for n in chunks]
    first = polygons.ring_starts[polygons.polygon_starts[: len(polygons)]][::CHUNK_POLYGONS].tolist()
    joined = {field.name: [getattr(part, field.name) for part in parts] for field in fields(Triangulation)}
    for n, point in zip(chunks, first, strict=False):
        joined["triangles"][n // CHUNK_POLYGONS] += point
        joined["polygon"][n // CHUNK_POLYGONS] += n
    result = Triangulation(**{name: np.concatenate(arrays) for name, arrays in joined.items()})
    _report(result, polygons, building_ids, findings, num_before)
    return result


def _triangulate(polygons: Polygons) -> Triangulation:
    """Returns the triangles of a few polygons: about ten times their points are held meanwhile."""
    normals, areas = newell(polygons)
    local = local_points(polygons)
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    point_counts = points_per_polygon(polygons)
    has_holes = np.diff(polygons.polygon_starts) > 1
    is_flat = areas < _MIN_AREA_M2
    plane = project(local, unit, point_counts)

    simple = ~has_holes & ~is_flat
    threes = np.flatnonzero(simple & (point_counts == 3))
    fours = np.flatnonzero(simple & (point_counts == 4))
    first = polygons.ring_starts[polygons.polygon_starts[:-1]]
    four_triangles, is_crossed = _split_quads(plane, first[fours])
    rest = np.concatenate([np.flatnonzero(~is_flat & (has_holes | (point_counts > 4))), fours[is_crossed]])
    ear_triangles, ear_counts = _cut_ears(polygons, plane, np.sort(rest))
    triangles = np.concatenate(
        [first[threes][:, None] + np.arange(3), four_triangles[~is_crossed].reshape(-1, 3), ear_triangles]
    )
    owner = np.concatenate([threes, np.repeat(fours[~is_crossed], 2), np.repeat(np.sort(rest), ear_counts)])
    order = np.argsort(owner, kind="stable")
    triangles, owner = triangles[order], owner[order]
    vectors = _triangle_vectors(local, triangles)
    covered = np.abs(np.einsum("ij,ij->i", vectors, unit[owner]))
    return Triangulation(
        triangles,
        owner,
        area_m2=_with_knots(areas, is_flat & (point_counts <= MAX_CORNERS), polygons, normals),
        meshed_m2=_sum_by(owner, np.linalg.norm(vectors, axis=1), len(polygons)),
        covered_m2=_sum_by(owner, covered, len(polygons)),
        deviation_m=deviation(polygons, local, unit, point_counts),
    )


def _with_knots(
    areas: NDArray[np.float64], is_flat: NDArray[np.bool_], polygons: Polygons, normals: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the areas with those of outlines among the flat ones whose parts cancel each other out."""
    stated = areas.copy()
    is_asked = is_flat & (np.linalg.norm(normals, axis=1) < 2 * _MIN_AREA_M2)
    for n in np.flatnonzero(is_asked).tolist():
        ring = polygons.polygon_starts[n]
        outline = polygons.points[polygons.ring_starts[ring] : polygons.ring_starts[ring + 1]]
        stated[n] = max(stated[n], enclosed_area(outline))
    return stated


def _sum_by(owner: NDArray[np.int64], weights: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    return np.bincount(owner, weights, minlength=size).astype(np.float64)


def _turn(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns twice the signed areas of plane triangles, each corner (N, 2)."""
    first, second = b - a, c - a
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def _split_quads(
    plane: NDArray[np.float64], first: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Returns (Q, 2, 3) triangles of quadrilaterals, and which of them cross themselves.

    A diagonal lies inside when it leaves two triangles of positive area. Where both do, the one
    with the larger smaller triangle is taken, so that a corner on a straight edge costs no sliver.
    """
    a, b, c, d = (plane[first + i] for i in range(4))
    by_ac = np.minimum(_turn(a, b, c), _turn(a, c, d))
    by_bd = np.minimum(_turn(a, b, d), _turn(b, c, d))
    # Slightly concave by rounding is not crossed: earcut decides those that are clearly neither.
    is_crossed = np.maximum(by_ac, by_bd) < 0
    offsets = np.where((by_ac >= by_bd)[:, None, None], [[[0, 1, 2], [0, 2, 3]]], [[[0, 1, 3], [1, 2, 3]]])
    return first[:, None, None] + offsets, is_crossed


def _cut_ears(
    polygons: Polygons, plane: NDArray[np.float64], chosen: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the triangles of the chosen polygons in a row, and how many each has."""
    if len(chosen) == 0:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    import mapbox_earcut

    earcut = mapbox_earcut.triangulate_float64
    rings, cuts = take_segments(polygons.polygon_starts, chosen)
    first = polygons.ring_starts[polygons.polygon_starts[chosen]]
    last = polygons.ring_starts[polygons.polygon_starts[chosen + 1]]
    ends = (polygons.ring_starts[rings + 1] - np.repeat(first, np.diff(cuts))).astype(np.uint32)
    uncut = np.zeros(0, np.uint32)
    pieces = [
        earcut(plane[begin:end], ends[ring:next_ring]) if end - begin <= MAX_CORNERS else uncut
        for begin, end, (ring, next_ring) in zip(
            first.tolist(), last.tolist(), pairwise(cuts.tolist()), strict=True
        )
    ]
    counts = np.array(list(map(len, pieces)), np.int64)
    corners = np.concatenate(pieces).astype(np.int64) + np.repeat(first, counts)
    return corners.reshape(-1, 3), counts // 3


def _triangle_vectors(points: NDArray[np.float64], triangles: NDArray[np.int64]) -> NDArray[np.float64]:
    """Returns (T, 3) normals as long as the triangles' areas."""
    corners = points[triangles]
    return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _report(
    result: Triangulation,
    polygons: Polygons,
    building_ids: tuple[str, ...],
    findings: Findings,
    num_before: int,
) -> None:
    is_flat = result.area_m2 < _MIN_AREA_M2
    tolerance = AREA_TOLERANCE * result.area_m2
    counts = points_per_polygon(polygons)
    is_off = ~is_flat & (np.abs(result.covered_m2 - result.area_m2) > tolerance + _MIN_AREA_M2)
    is_bent = ~is_flat & ~is_off & (result.deviation_m > PLANAR_TOLERANCE_M)
    is_far = is_bent & (result.deviation_m > _MAX_BEND_M)
    for code, is_met in (
        (ZERO_AREA, is_flat),
        (NOT_PLANAR, is_bent & ~is_far),
        (FAR_FROM_PLANAR, is_far),
        (AREA_MISMATCH, is_off),
    ):
        for polygon in np.flatnonzero(is_met):
            detail = (
                f"polygon {num_before + polygon}: {result.deviation_m[polygon]:.3f} m off its plane, "
                f"area {result.area_m2[polygon]:.4f} m2, triangles {result.meshed_m2[polygon]:.4f} m2"
            )
            if counts[polygon] > MAX_CORNERS:
                detail += f", {counts[polygon]:,} corners are not cut"
            corner = polygons.points[polygons.ring_starts[polygons.polygon_starts[polygon]]]
            findings.add(
                code,
                building_ids[polygons.building[polygon]],
                detail,
                polygon=num_before + int(polygon),
                place=tuple(corner.tolist()),
            )


# What is narrower is a line: there and back by rounding.
_LINE_M = 1e-3


def newell(polygons: Polygons) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the outlines' Newell vectors (N, 3), of twice their area, and the areas less holes (N,)."""
    points, starts = polygons.points, polygons.ring_starts
    lengths = np.diff(starts)
    if len(lengths) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    relative = points - np.repeat(points[starts[:-1]], lengths, axis=0)
    following = np.concatenate([relative[1:], relative[:1]])
    following[starts[1:] - 1] = 0.0  # the first point of each ring, relative to itself
    ring_vectors = np.add.reduceat(np.cross(relative, following), starts[:-1], axis=0)
    ring_areas = 0.5 * np.linalg.norm(ring_vectors, axis=1)
    outlines = polygons.polygon_starts[:-1]
    total = np.add.reduceat(ring_areas, outlines)
    return ring_vectors[outlines], np.maximum(2.0 * ring_areas[outlines] - total, 0.0)


def enclosed_area(ring: NDArray[np.float64]) -> float:
    """Returns what a ring, (n, 3), goes round in its mean plane: of a bow tie both halves, of a line nothing.

    Newell's area of a symmetric bow tie is nothing either, for its halves run opposite ways.
    """
    centred = ring - ring.mean(axis=0)
    _, lengths, axes = np.linalg.svd(centred, full_matrices=False)
    if lengths[1] <= _LINE_M:
        return 0.0
    import shapely

    edges = shapely.unary_union(shapely.linearrings(centred @ axes[:2].T))
    area = float(shapely.area(shapely.polygonize(shapely.get_parts(edges))))
    return area if area > _LINE_M * shapely.length(edges) else 0.0


def points_per_polygon(polygons: Polygons) -> NDArray[np.int64]:
    """Returns (N,) corners of each polygon, those of its holes included."""
    return np.diff(polygons.ring_starts[polygons.polygon_starts])


def local_points(polygons: Polygons) -> NDArray[np.float64]:
    """Returns the points with each polygon's first point as its origin."""
    first = polygons.ring_starts[polygons.polygon_starts[:-1]]
    return polygons.points - np.repeat(polygons.points[first], points_per_polygon(polygons), axis=0)


def project(
    local: NDArray[np.float64], unit: NDArray[np.float64], point_counts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Returns (P, 2) points seen against each polygon's normal, outlines counter-clockwise.

    The exact normal matters: seen along the nearest axis instead, a narrow polygon that is bent by
    a millimetre can fold over itself.
    """
    helper = np.eye(3)[np.argmin(np.abs(unit), axis=1)]
    across = np.cross(helper, unit)
    across /= np.maximum(np.linalg.norm(across, axis=1), 1e-300)[:, None]
    frames = np.stack([across, np.cross(unit, across)], axis=2)
    plane: NDArray[np.float64] = np.einsum("pi,pij->pj", local, np.repeat(frames, point_counts, axis=0))
    return plane


def deviation(
    polygons: Polygons, local: NDArray[np.float64], unit: NDArray[np.float64], point_counts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Returns each polygon's largest corner distance from the plane through its mean point, metres."""
    if len(polygons) == 0:
        return np.zeros(0)
    height = np.einsum("ij,ij->i", local, np.repeat(unit, point_counts, axis=0))
    first = polygons.ring_starts[polygons.polygon_starts[:-1]]
    mean = np.add.reduceat(height, first) / point_counts
    return np.maximum.reduceat(np.abs(height - np.repeat(mean, point_counts)), first)


def polygons_at(
    model: CityModel, wanted: str | None, findings: Findings, stands_in: bool = True
) -> tuple[str, NDArray[np.bool_]]:
    """Returns the name of what is meshed, and (P,) which of the model's P polygons belong to it.

    Args:
        model: The city.
        wanted: A level of the whole file, see ``choose_lod``; or ``finest`` or ``coarsest``: of each building
            its own. Cities mix levels: a few landmarks at LoD2 among blocks at LoD1. Footprints (LoD0) are
            no building's finest or coarsest, interiors nobody's. An object that is no building and lacks the
            level has its finest below it, else its coarsest above.
        findings: See ``choose_lod``.
        stands_in: Whether it has it.

    Raises:
        CityModelError: The level is absent.
    """
    polygons = model.polygons
    wish = None if wanted is None else plain_level(wanted)
    is_building = model.is_building() | (not stands_in)
    if wish not in (FINEST, COARSEST):
        used = np.unique(polygons.lod[is_building[polygons.building]]).tolist()
        present = [model.lods[n] for n in used] if used and not is_building.all() else model.lods
        name = choose_lod(present, wanted, findings, model.measured_m is not None)
        at_level: NDArray[np.bool_] = polygons.lod == model.lods.index(name)
        if not is_building.all():
            at_level |= _own_level(model, name, ~is_building)
        return name, at_level
    order = {name: rank for rank, name in enumerate(sorted(model.lods))}
    ranks = np.array([order[name] for name in model.lods], np.int64)
    ranks = ranks if wish == FINEST else len(ranks) - 1 - ranks
    has_walls = np.array([not name.startswith("0") for name in model.lods], np.bool_)
    counts = has_walls[polygons.lod] & (polygons.kind != SurfaceKind.INTERIOR)
    rank = np.where(counts, ranks[polygons.lod], -1)
    unit, is_lead = _units(model, counts, wish)
    best = np.full(int(unit.max(initial=-1)) + 1, -1, np.int64)
    np.maximum.at(best, unit[is_lead], rank[is_lead])
    is_led = best[unit] >= 0
    np.maximum.at(best, unit[~is_led], rank[~is_led])
    return wish, counts & (rank == best[unit])


def _units(
    model: CityModel, counts: NDArray[np.bool_], wish: str
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Returns what each polygon chooses its level with, and whether it has a say in it."""
    polygons, objects = model.polygons, model.objects
    if polygons.part is None or objects is None:
        return polygons.building.astype(np.int64), counts
    own = polygons.part.astype(np.int64)
    outer = outer_parts(objects)[own].astype(np.int64)
    is_lead = counts & (outer == own)
    root = np.zeros(len(model.building_ids), np.int64)
    is_root = objects.parents < 0
    root[objects.building[is_root]] = np.flatnonzero(is_root)
    # Walls of the building itself may stand for those of all its parts.
    is_whole = np.zeros(len(root), np.bool_)
    is_whole[polygons.building[is_lead & is_root[own]]] = True
    unit = np.where(is_whole[polygons.building], root[polygons.building], outer)
    return (np.where(outer == own, unit, own) if wish == FINEST else unit), is_lead


def _own_level(model: CityModel, name: str, is_other: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns which polygons are of objects that lack a level, at the level that stands in for it."""
    polygons = model.polygons
    order = {other: rank for rank, other in enumerate(sorted(model.lods))}
    ranks = np.array([order[other] for other in model.lods], np.int64)
    # Below the level the finest is best, above it the coarsest; above counts after all below.
    distance = np.where(ranks <= order[name], order[name] - ranks, len(ranks) + ranks - order[name])
    own = np.where(is_other[polygons.building], distance[polygons.lod], 2 * len(ranks))
    best = np.full(len(model.building_ids), 2 * len(ranks), np.int64)
    np.minimum.at(best, polygons.building, own)
    is_best: NDArray[np.bool_] = is_other[polygons.building] & (own == best[polygons.building])
    return is_best
