"""Footprints to blocks: floor, flat roof and walls, holes included, faces outward."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import STAYS_FLAT
from lodbench.citymodel.lods import select_polygons
from lodbench.citymodel.model import CityModel, Polygons, SurfaceKind
from lodbench.citymodel.raw import starts_of, take_segments
from lodbench.citymodel.scene import Scene, build_scene
from lodbench.findings import Findings


@dataclass(frozen=True, slots=True)
class Blocks:
    """Extruded footprints, flat: floors, then roofs, then walls."""

    points: NDArray[np.float64]  # (P, 3) float64
    ring_lengths: NDArray[np.int64]  # (R,) int64
    ring_counts: NDArray[np.int64]  # (N,) int64
    footprint: NDArray[np.int64]  # (N,) int64 which footprint each polygon comes from
    kind: NDArray[np.uint8]  # (N,) uint8


def extrude(
    points: NDArray[np.float64],
    ring_starts: NDArray[np.int64],
    polygon_starts: NDArray[np.int64],
    bottom: NDArray[np.float64],
    top: NDArray[np.float64],
) -> Blocks:
    """Returns blocks over footprints.

    Args:
        points: (P, 2) float64, x east, y north; rings of three points or more, not closed.
        ring_starts: (R + 1,) offsets into ``points``.
        polygon_starts: (N + 1,) offsets into the rings; the first ring is the outline.
        bottom: (N,) height of each floor.
        top: (N,) height of each roof.
    """
    points = _orient(points, ring_starts, polygon_starts)
    ring_lengths, ring_counts = np.diff(ring_starts), np.diff(polygon_starts)
    count = len(ring_counts)
    ring_polygon = np.repeat(np.arange(count), ring_counts)
    point_ring = np.repeat(np.arange(len(ring_lengths)), ring_lengths)
    low, high = bottom[ring_polygon[point_ring]], top[ring_polygon[point_ring]]
    floors = np.column_stack([points, low])[_reversed_order(ring_starts)]
    roofs = np.column_stack([points, high])
    following = np.arange(len(points)) + 1
    following[ring_starts[1:] - 1] = ring_starts[:-1]
    walls = np.stack(
        [
            np.column_stack([points, low]),
            np.column_stack([points[following], low]),
            np.column_stack([points[following], high]),
            np.column_stack([points, high]),
        ],
        axis=1,
    ).reshape(-1, 3)
    kinds = (SurfaceKind.GROUND, SurfaceKind.ROOF, SurfaceKind.WALL)
    return Blocks(
        points=np.concatenate([floors, roofs, walls]),
        ring_lengths=np.concatenate([ring_lengths, ring_lengths, np.full(len(points), 4)]),
        ring_counts=np.concatenate([ring_counts, ring_counts, np.ones(len(points), np.int64)]),
        footprint=np.concatenate([np.arange(count), np.arange(count), ring_polygon[point_ring]]),
        kind=np.repeat(np.array(kinds, np.uint8), [count, count, len(points)]),
    )


def ring_areas(points: NDArray[np.float64], ring_starts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Returns the signed areas of plane rings, positive counter-clockwise."""
    if len(ring_starts) < 2:
        return np.zeros(0)
    local = points - np.repeat(points[ring_starts[:-1]], np.diff(ring_starts), axis=0)
    following = np.roll(local, -1, axis=0)
    following[ring_starts[1:] - 1] = 0.0
    cross = local[:, 0] * following[:, 1] - local[:, 1] * following[:, 0]
    areas: NDArray[np.float64] = 0.5 * np.add.reduceat(cross, ring_starts[:-1])
    return areas


def _orient(
    points: NDArray[np.float64], ring_starts: NDArray[np.int64], polygon_starts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Returns the points with outlines counter-clockwise and holes clockwise."""
    is_outline = np.zeros(len(ring_starts) - 1, np.bool_)
    is_outline[polygon_starts[:-1]] = True
    is_wrong = (ring_areas(points, ring_starts) > 0) != is_outline
    order = np.arange(len(points))
    wrong = np.flatnonzero(is_wrong)
    items, _ = take_segments(ring_starts, wrong)
    order[items] = _reversed_order(ring_starts)[items]
    return points[order]


def _reversed_order(ring_starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns, for each point, the one that takes its place when its ring is turned round."""
    ring = np.repeat(np.arange(len(ring_starts) - 1), np.diff(ring_starts))
    reversed_order: NDArray[np.int64] = ring_starts[ring] + ring_starts[ring + 1] - 1 - np.arange(len(ring))
    return reversed_order


def clean_rings(
    rings: list[NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Returns rings without closing and repeated points: points (P, 2), starts, repeats per ring."""
    lengths = np.asarray([len(ring) for ring in rings], np.int64)
    points = np.concatenate(rings)[:, :2] if rings else np.zeros((0, 2))
    starts = starts_of(lengths)
    ring = np.repeat(np.arange(len(lengths)), lengths)
    following = np.arange(len(points)) + 1
    filled = lengths > 0
    following[starts[1:][filled] - 1] = starts[:-1][filled]
    # A point equal to the next of its ring goes; that takes the closing point, too.
    kept = np.any(points != points[following], axis=1) if len(points) else np.zeros(0, np.bool_)
    new_lengths = np.bincount(ring[kept], minlength=len(lengths))
    repeats = lengths - new_lengths - 1
    return points[kept], starts_of(new_lengths), np.maximum(repeats, 0)


# A block's corners count x, y, z in binary; no floor.
_FACES = np.array([(0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5), (1, 5, 7, 3)])


def scene_of_blocks(
    blocks: Sequence[tuple[float, float, float, float, float, float]],
    origin: NDArray[np.float64] | None = None,
) -> Scene:
    """Returns a scene of upright blocks, one building each.

    Args:
        blocks: West, south, east, north, base and top of each, metres.
        origin: (3,) origin to record, zero by default.
    """
    corners = [
        (x, y, z)
        for west, south, east, north, base, top in blocks
        for x in (west, east)
        for y in (south, north)
        for z in (base, top)
    ]
    faces = np.concatenate([8 * k + _FACES for k in range(len(blocks))])
    triangles = faces[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    building = np.repeat(np.arange(len(blocks), dtype=np.int32), 2 * len(_FACES))
    names = tuple(f"block {k}" for k in range(1, len(blocks) + 1))
    return build_scene(np.array(corners), triangles, building, names, origin=origin)


FLAT = "0"  # what names of levels without walls begin with


def is_flat(model: CityModel) -> NDArray[np.bool_]:
    """Returns which buildings have a known height, and outlines at level 0 alone; (B,)."""
    if model.measured_m is None:
        return np.zeros(len(model.building_ids), np.bool_)
    polygons = model.polygons
    has_walls, has_outline = np.zeros((2, len(model.building_ids)), np.bool_)
    at_level_0 = np.array([name.startswith(FLAT) for name in model.lods], np.bool_)[polygons.lod]
    has_outline[polygons.building[at_level_0]] = True
    has_walls[polygons.building[~at_level_0 & (polygons.kind != SurfaceKind.INTERIOR)]] = True
    return has_outline & ~has_walls & np.isfinite(model.measured_m)


def tell_flat(model: CityModel, findings: Findings) -> None:
    """Adds a finding for each building that is drawn flat though its height is known."""
    if model.measured_m is not None:
        for n in np.flatnonzero(is_flat(model)).tolist():
            detail = f"{model.measured_m[n]:g} m high; as a block with lod=1 and roof_height=max"
            findings.add(STAYS_FLAT, model.building_ids[n], detail)


def raise_flat(model: CityModel, level: str) -> CityModel:
    """Returns a city whose flat buildings with a height have blocks of that height too, at a level.

    They stand on the lowest point of their footprint, or end at the edge of their roof where there is no
    more than that.

    Args:
        model: The city.
        level: One of its levels, or a new one.
    """
    flat = is_flat(model)
    if model.measured_m is None or not flat.any():
        return model
    own = select_polygons(model.polygons, np.flatnonzero(flat[model.polygons.building]))
    is_edge = own.kind == SurfaceKind.ROOF
    has_footprint = np.zeros(len(flat), np.bool_)
    has_footprint[own.building[~is_edge]] = True
    chosen = np.flatnonzero(~is_edge | ~has_footprint[own.building])
    own, is_edge = select_polygons(own, chosen), is_edge[chosen]
    point_building = np.repeat(own.building, np.diff(own.ring_starts[own.polygon_starts]))
    low, high = np.full(len(flat), np.inf), np.full(len(flat), -np.inf)
    np.minimum.at(low, point_building, own.points[:, 2])
    np.maximum.at(high, point_building, own.points[:, 2])
    height_m = model.measured_m[own.building]
    bottom = np.where(is_edge, high[own.building] - height_m, low[own.building])
    blocks = extrude(own.points[:, :2], own.ring_starts, own.polygon_starts, bottom, bottom + height_m)
    lods = model.lods if level in model.lods else (*model.lods, level)
    raised = Polygons(
        blocks.points,
        starts_of(blocks.ring_lengths),
        starts_of(blocks.ring_counts),
        own.building[blocks.footprint],
        np.full(len(blocks.kind), lods.index(level), np.int16),
        blocks.kind,
        None if own.part is None else own.part[blocks.footprint],
    )
    return replace(model, lods=lods, polygons=_both(model.polygons, raised))


def _both(first: Polygons, second: Polygons) -> Polygons:
    """Returns the polygons of both, without pictures."""
    return Polygons(
        np.concatenate([first.points, second.points]),
        np.append(first.ring_starts, second.ring_starts[1:] + first.ring_starts[-1]),
        np.append(first.polygon_starts, second.polygon_starts[1:] + first.polygon_starts[-1]),
        np.append(first.building, second.building),
        np.append(first.lod, second.lod),
        np.append(first.kind, second.kind),
        None if first.part is None or second.part is None else np.append(first.part, second.part),
    )


# What is no wall rises by a share of its length, and what is level by nearly all of it; less is rounding.
_LEAST_RISE, _LEVEL = 0.15, 0.999
# The share of a block's roof that may slant: chimneys.
_SLANTED_SHARE = 0.05


def pitched_blocks(scene: Scene) -> NDArray[np.bool_]:
    """Returns (B,) which buildings of a scene are blocks, where the source states pitched roofs.

    Roofs are the faces above half a building's height that are no walls: floors may follow the ground.
    """
    if scene.pitched is None:
        return np.zeros(scene.num_buildings, np.bool_)
    stated = np.flatnonzero(scene.pitched & (np.diff(scene.triangle_starts) > 0))
    faces, _ = take_segments(scene.triangle_starts, stated)
    owner = np.repeat(np.arange(len(stated)), np.diff(scene.triangle_starts)[stated])
    corners = scene.vertices[scene.triangles[faces]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas, rises = np.linalg.norm(normals, axis=1), np.abs(normals[:, 2])
    lowest, highest = corners[..., 2].min(axis=1), corners[..., 2].max(axis=1)
    low, high = np.full(len(stated), np.inf), np.full(len(stated), -np.inf)
    np.minimum.at(low, owner, lowest)
    np.maximum.at(high, owner, highest)
    is_roof = (rises > _LEAST_RISE * areas) & (lowest + highest > (low + high)[owner])
    covered, slanted = (
        np.bincount(owner, weights=areas * chosen, minlength=len(stated))
        for chosen in (is_roof, is_roof & (rises < _LEVEL * areas))
    )
    blocks = np.zeros(scene.num_buildings, np.bool_)
    blocks[stated] = slanted <= _SLANTED_SHARE * covered
    return blocks
