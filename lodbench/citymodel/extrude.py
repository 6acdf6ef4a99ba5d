"""Footprints to blocks: floor, flat roof and walls, holes included, faces outward."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import (
    CityModel,
    Polygons,
    SurfaceKind,
    is_flat,
    select_polygons,
    starts_of,
    take_segments,
)
from lodbench.citymodel.scene import Scene, build_scene


@dataclass(frozen=True, slots=True)
class Blocks:
    """Extruded footprints, flat: floors, then roofs, then walls."""

    points: NDArray[np.float64]  # (P, 3) float64
    ring_lengths: NDArray[np.int64]  # (R,) int64
    ring_counts: NDArray[np.int64]  # (N,) int64
    footprint: NDArray[np.int64]  # (N,) int64 which footprint each polygon comes from
    kind: NDArray[np.uint8]  # (N,) uint8

    def columns(self, building: NDArray[np.integer]) -> dict[str, NDArray[Any]]:
        """Returns them for ``city_of_columns``, of (N,) buildings."""
        columns = {name: getattr(self, name) for name in ("points", "ring_lengths", "ring_counts", "kind")}
        return columns | {"building": building}


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


Floats = NDArray[np.float64]

SHAPES = ("flat", "gabled", "hipped", "pyramidal")
# Footprints fill at least this share of the rectangle around them.
_LEAST_FILL = 0.8
# Facets smaller than this share of the footprint's area come from rounding and are dropped.
_LEAST_FACET = 1e-6


class Facet(NamedTuple):
    """A plane piece of a roof: its corners (N, 2) along and across, -1 to 1, and heights there, 0 to 1."""

    corners: Floats
    heights: Floats


class Polygon3d(NamedTuple):
    """A polygon of a building: its kind, and (N, 3) rings, outline first."""

    kind: SurfaceKind
    rings: list[Floats]


def facets_of(shape: str, length: float, width: float, is_across: bool) -> list[Facet]:
    """Returns the facets of a roof over a rectangle, whose longer side is along.

    Args:
        shape: One of ``SHAPES`` but flat.
        length: Of the longer side.
        width: Of the other, in the same unit.
        is_across: Whether a gable's ridge runs across.
    """
    corners = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    if shape == "gabled":
        half = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 0.0), (-1.0, 0.0)])
        halves = [half, -half]
        places = [side[:, ::-1][::-1] if is_across else side for side in halves]
        return [Facet(side, 1.0 - np.abs(side[:, 0 if is_across else 1])) for side in places]
    end = 0.0 if shape == "pyramidal" else 1.0 - width / length
    west, east = (-end, 0.0), (end, 0.0)
    a, b, c, d = map(tuple, corners.tolist())
    pieces = [[a, b, east, west], [c, d, west, east], [b, c, east], [d, a, west]]
    return [Facet(np.array(piece), np.array([1.0 - abs(v) for _, v in piece])) for piece in pieces]


def shaped_building(
    rings: Sequence[Floats], shape: str, heights: tuple[float, float, float], is_across: bool, squeeze: float
) -> list[Polygon3d] | None:
    """Returns floor, walls and roof of a building; None where the shape does not fit the footprint.

    Args:
        rings: (N, 2) east and north each, not closed, the outline first.
        shape: One of ``SHAPES``.
        heights: Of the floor, the eaves and the ridge.
        is_across: As for ``facets_of``.
        squeeze: Metres per unit to the east by those to the north: below 1 in degrees.
    """
    import shapely

    floor, eaves, ridge = heights
    # Around its own middle, in units of the same length both ways.
    middle = rings[0].mean(axis=0)
    scale = np.array([squeeze, 1.0])
    outline = shapely.Polygon((rings[0] - middle) * scale, [(ring - middle) * scale for ring in rings[1:]])
    outline = shapely.orient_polygons(outline)
    if not outline.is_valid or not floor <= eaves <= ridge or floor >= ridge:
        return None
    if shape == "flat":
        facets = [(outline, np.array([0.0, 0.0, ridge]))]
    else:
        rectangle = shapely.get_coordinates(shapely.minimum_rotated_rectangle(outline))[:4]
        sides = rectangle[1] - rectangle[0], rectangle[3] - rectangle[0]
        along, across = sorted(sides, key=lambda side: -float(np.hypot(*side)))
        length, width = float(np.hypot(*along)), float(np.hypot(*across))
        if width <= 0 or eaves >= ridge or outline.area < _LEAST_FILL * length * width:
            return None
        centre = rectangle.mean(axis=0)
        facets = []
        for facet in facets_of(shape, length, width, is_across):
            places = centre + 0.5 * facet.corners @ np.stack([along, across])
            plane = np.linalg.lstsq(
                np.column_stack([places, np.ones(len(places))]), eaves + (ridge - eaves) * facet.heights
            )[0]
            piece = shapely.intersection(outline, shapely.Polygon(places))
            kept = [each for each in shapely.get_parts(piece) if each.geom_type == "Polygon"]
            facets += [(each, plane) for each in kept if each.area > _LEAST_FACET * outline.area]
    back = np.array([1.0 / squeeze, 1.0, 1.0]), np.array([*middle, 0.0])
    polygons = [Polygon3d(SurfaceKind.GROUND, _lifted(outline, np.array([0.0, 0.0, floor]), is_down=True))]
    polygons += [Polygon3d(SurfaceKind.ROOF, _lifted(piece, plane)) for piece, plane in facets]
    polygons += [Polygon3d(SurfaceKind.WALL, [wall]) for wall in _walls(facets, outline, floor)]
    return [Polygon3d(kind, [ring * back[0] + back[1] for ring in lifted]) for kind, lifted in polygons]


def _lifted(polygon: Any, plane: Floats, is_down: bool = False) -> list[Floats]:
    """Returns the rings of a polygon at a plane's heights, seen counter-clockwise from above, or below."""
    import shapely

    polygon = shapely.orient_polygons(polygon)
    rings = [shapely.get_coordinates(ring)[:-1] for ring in (polygon.exterior, *polygon.interiors)]
    lifted = [np.column_stack([ring, np.column_stack([ring, np.ones(len(ring))]) @ plane]) for ring in rings]
    return [ring[::-1] for ring in lifted] if is_down else lifted


def _walls(facets: Sequence[tuple[Any, Floats]], outline: Any, floor: float) -> list[Floats]:
    """Returns a wall below every edge of the facets that lies on the outline, down to the floor."""
    import shapely

    walls = []
    reach = 1e-6 * float(np.sqrt(outline.area))
    for piece, plane in facets:
        for ring in _lifted(piece, plane):
            following = np.roll(ring, -1, axis=0)
            middles = shapely.points(0.5 * (ring + following)[:, :2])
            is_rim = shapely.dwithin(outline.boundary, middles, reach)
            for start, end in zip(ring[is_rim], following[is_rim], strict=True):
                bottom = [(*start[:2], floor), (*end[:2], floor)]
                top = [each for each in (end, start) if each[2] > floor]
                if top:
                    walls.append(np.array([*bottom, *map(tuple, top)]))
    return walls
