"""Roofs of stated shapes over footprints, as OpenStreetMap's Simple 3D Buildings names them.

A roof is made of plane facets over the smallest rectangle around a footprint, cut by its outline. Footprints
that fill little of that rectangle (L shapes, courtyards) keep their blocks: where their ridges run, no tag
says.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import SurfaceKind

Floats = NDArray[np.float64]

SHAPES = ("flat", "gabled", "hipped", "pyramidal")
# Footprints fill at least this share of the rectangle around them.
_LEAST_FILL = 0.8
# Facets that are smaller than this share of the footprint are what rounding leaves.
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
        around = shapely.get_coordinates(shapely.minimum_rotated_rectangle(outline))[:4]
        sides = around[1] - around[0], around[3] - around[0]
        along, across = sorted(sides, key=lambda side: -float(np.hypot(*side)))
        length, width = float(np.hypot(*along)), float(np.hypot(*across))
        if width <= 0 or eaves >= ridge or outline.area < _LEAST_FILL * length * width:
            return None
        centre = around.mean(axis=0)
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
    found = [Polygon3d(SurfaceKind.GROUND, _lifted(outline, np.array([0.0, 0.0, floor]), is_down=True))]
    found += [Polygon3d(SurfaceKind.ROOF, _lifted(piece, plane)) for piece, plane in facets]
    found += [Polygon3d(SurfaceKind.WALL, [wall]) for wall in _walls(facets, outline, floor)]
    return [Polygon3d(kind, [ring * back[0] + back[1] for ring in lifted]) for kind, lifted in found]


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
                feet = [(*start[:2], floor), (*end[:2], floor)]
                top = [each for each in (end, start) if each[2] > floor]
                if top:
                    walls.append(np.array([*feet, *map(tuple, top)]))
    return walls
