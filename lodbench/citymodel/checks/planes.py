"""Are polygons sound in their planes? Rings that touch themselves, holes outside, nested or turned."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel import codes
from lodbench.citymodel.derive import part_blocks
from lodbench.citymodel.model import (
    CityModel,
    Polygons,
    SurfaceKind,
    select_polygons,
)
from lodbench.citymodel.triangulate import (
    CHUNK_POLYGONS,
    MAX_CORNERS,
    PLANAR_TOLERANCE_M,
    newell,
    triangulate,
)
from lodbench.findings import FindingCode, Findings

# What GEOS says is wrong, by the beginning of its reason.
_REASONS: tuple[tuple[str, FindingCode], ...] = (
    ("Ring Self-intersection", codes.RING_SELF_CONTACT),
    ("Self-intersection", codes.RINGS_INTERSECT),
    ("Hole lies outside", codes.HOLE_OUTSIDE),
    ("Nested holes", codes.HOLES_NESTED),
    ("Holes are nested", codes.HOLES_NESTED),
    ("Interior is disconnected", codes.INTERIOR_SPLIT),
    ("Duplicate Rings", codes.RINGS_EQUAL),
)

_PLACE = re.compile(r"\[(\S+) (\S+)\]")

_MAX_TURN_DEG = 20.0  # as val3dity has it

_MIN_OVERLAP_M2, _MIN_OVERLAP_M = 0.1, 0.1


class _Flattened(NamedTuple):
    """P polygons of R rings laid into their planes."""

    areas: NDArray[np.float64]  # (P,) square metres
    anchors: NDArray[np.float64]  # (P, 3) where planes have their origins, metres
    frames: NDArray[np.float64]  # (P, 3, 2) their axes
    rings: NDArray[Any]  # (R,) as shapely has them
    shapes: NDArray[Any]  # (P,) likewise polygons
    ring_polygon: NDArray[np.int64]  # (R,) the polygon of each ring


def check_planes(model: CityModel, findings: Findings) -> None:
    """Adds what is wrong with polygons viewed along their normals, each with its number and place.

    Args:
        model: The city.
        findings: Receives one finding of a kind per polygon.
    """
    import shapely

    is_outer = model.polygons.kind != SurfaceKind.INTERIOR
    # Larger ones are reported as not cut; crossings of a million edges would take hours.
    corners = np.diff(model.polygons.ring_starts[model.polygons.polygon_starts])
    outer = np.flatnonzero(is_outer & (corners <= MAX_CORNERS))
    polygons = select_polygons(model.polygons, outer)
    if len(polygons) == 0:
        return
    areas, anchors, frames, rings, shapes, ring_polygon = _flattened(polygons)
    has_area = areas > 1e-6

    def add(code: FindingCode, n: int, detail: str, spot: NDArray[np.float64]) -> None:
        place = anchors[n] + frames[n] @ spot + model.origin
        building = model.building_ids[polygons.building[n]]
        findings.add(code, building, detail, polygon=int(outer[n]), place=tuple(place.tolist()))

    for n in np.flatnonzero(~shapely.is_valid(shapes) & has_area).tolist():
        reason = str(shapely.is_valid_reason(shapes[n]))
        found = _PLACE.search(reason)
        spot = np.zeros(2) if found is None else np.array([float(found[1]), float(found[2])])
        code = _code_of(reason, rings[polygons.polygon_starts[n] : polygons.polygon_starts[n + 1]])
        add(code, n, reason.partition("[")[0].strip().lower(), spot)
    is_hole = np.ones(len(rings), np.bool_)
    is_hole[polygons.polygon_starts[:-1]] = False
    is_turned = is_hole & shapely.is_ccw(rings) & has_area[ring_polygon]
    for n in np.unique(ring_polygon[is_turned]).tolist():
        add(codes.HOLE_TURNED, n, "a hole runs the way of its outline", np.zeros(2))


def _flattened(polygons: Polygons) -> _Flattened:
    """Returns polygons laid into their own planes."""
    import shapely

    vectors, areas = newell(polygons)
    unit = vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)[:, None]
    helper = np.eye(3)[np.argmin(np.abs(unit), axis=1)]
    across = np.cross(helper, unit)
    across /= np.maximum(np.linalg.norm(across, axis=1), 1e-300)[:, None]
    frames = np.stack([across, np.cross(unit, across)], axis=2)
    anchors = polygons.points[polygons.ring_starts[polygons.polygon_starts[:-1]]]
    owner = np.repeat(np.arange(len(polygons)), np.diff(polygons.ring_starts[polygons.polygon_starts]))
    plane = np.einsum("pi,pij->pj", polygons.points - anchors[owner], frames[owner])
    lengths = np.diff(polygons.ring_starts)
    closed = np.insert(plane, np.cumsum(lengths), plane[polygons.ring_starts[:-1]], axis=0)
    rings = shapely.linearrings(closed, indices=np.repeat(np.arange(len(lengths)), lengths + 1))
    ring_polygon = np.repeat(np.arange(len(polygons)), np.diff(polygons.polygon_starts))
    return _Flattened(
        areas, anchors, frames, rings, shapely.polygons(rings, indices=ring_polygon), ring_polygon
    )


def _code_of(reason: str, rings: NDArray[Any]) -> FindingCode:
    """Returns the finding for the reason why a polygon of these rings is not valid."""
    import shapely

    code = next((code for start, code in _REASONS if reason.startswith(start)), codes.RING_SELF_CONTACT)
    if code is not codes.RINGS_INTERSECT:
        return code
    if not shapely.is_simple(rings).all():
        return codes.RING_SELF_CONTACT
    are_equal = any(shapely.equals(ring, rings[k + 1 :]).any() for k, ring in enumerate(rings))
    return codes.RINGS_EQUAL if are_equal else code


def check_folds(model: CityModel, findings: Findings) -> None:
    """Adds polygons with a piece turned from their plane although no corner is a centimetre off it."""
    outer = np.flatnonzero(model.polygons.kind != SurfaceKind.INTERIOR)
    for first in range(0, len(outer), CHUNK_POLYGONS):
        own = outer[first : first + CHUNK_POLYGONS]
        polygons = select_polygons(model.polygons, own)
        result = triangulate(polygons, model.building_ids, Findings())
        corners = polygons.points[result.triangles]
        vectors = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        sizes = np.linalg.norm(vectors, axis=1)
        normals, _ = newell(polygons)
        unit = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
        along = np.einsum("ij,ij->i", vectors, unit[result.polygon])
        longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        # What is narrower than corners may be off their plane has no direction worth the name.
        is_wide = 2.0 * sizes > PLANAR_TOLERANCE_M * longest
        is_folded = (np.abs(along) < np.cos(np.radians(_MAX_TURN_DEG)) * sizes) & is_wide
        is_folded &= result.deviation_m[result.polygon] <= PLANAR_TOLERANCE_M
        at, where = np.unique(result.polygon[is_folded], return_index=True)
        spots = corners[is_folded][where].mean(axis=1) + model.origin
        for n, spot in zip(at.tolist(), spots.tolist(), strict=True):
            building = model.building_ids[polygons.building[n]]
            findings.add(codes.FOLDED, building, "a fold", polygon=int(own[n]), place=tuple(spot))


def check_parts(model: CityModel, findings: Findings) -> None:
    """Adds parts of a building whose insides overlap for certain.

    Viewed from above, between the lowest point of each part and the lowest point of its roof: what overlaps
    there overlaps whatever the shape of the roofs.

    Args:
        model: The city.
        findings: Receives one finding per pair of parts.
    """
    import shapely

    if model.objects is None or model.polygons.part is None:
        return
    for lod in model.lods:
        plans, owner, bottom, top = part_blocks(model, lod)
        if len(owner) < 2:
            continue
        tree = shapely.STRtree(plans)
        first, second = tree.query(plans, predicate="intersects")
        building = model.objects.building[owner]
        is_pair = (owner[first] < owner[second]) & (building[first] == building[second])
        first, second = first[is_pair], second[is_pair]
        shared = shapely.intersection(plans[first], plans[second])
        areas = shapely.area(shared)
        a, b = owner[first], owner[second]
        heights = np.minimum(top[a], top[b]) - np.maximum(bottom[a], bottom[b])
        for n in np.flatnonzero((areas > _MIN_OVERLAP_M2) & (heights > _MIN_OVERLAP_M)).tolist():
            names = model.objects.ids[a[n]], model.objects.ids[b[n]]
            spot = shapely.get_coordinates(shapely.point_on_surface(shared[n]))[0]
            place = np.array([*spot, max(bottom[a[n]], bottom[b[n]])]) + model.origin
            findings.add(
                codes.PARTS_OVERLAP,
                model.building_ids[int(building[first[n]])],
                f"LoD{lod}: {names[0]} and {names[1]}, {areas[n]:.2f} m2 over {heights[n]:.2f} m",
                place=tuple(place.tolist()),
            )
