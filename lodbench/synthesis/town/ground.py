"""The town's ground as props: fields, meadows, the river, streets with markings, blocks, bridges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lodbench.storage import random_stream
from lodbench.synthesis.objects.mesh_builder import MeshBuilder
from lodbench.synthesis.objects.scene_props import SurfaceClass
from lodbench.synthesis.town.plane_mesh import filled, refined
from lodbench.synthesis.town.shapes import along_line, contains, inset, left_of, length_of, offset_line
from lodbench.synthesis.town.streets import Street
from lodbench.synthesis.town.town import Town

Points = NDArray[np.float64]

# Heights of layers above the bare ground, metres. Two meshes of one surface differ by up to 3 cm.
_MARKING_M, _PAVEMENT_M, _YARD_M = 0.05, 0.12, 0.17
# The land reaches this far from the middle of town: farther than a drone at 60 degrees sees detail.
_LAND_M = 4000.0
_WATER_HALF_M = 17.0
# Edges of ground triangles in town and beside the river, and the share of the distance beyond.
_NEAR_M, _BANK_EDGE_M, _FAR_SHARE = 12.0, 6.0, 0.06
_PAVEMENT_WIDTH_M = 2.2
_YARDS = {
    "old town": SurfaceClass.PAVEMENT,
    "inner town": SurfaceClass.GRASS,
    "garden suburb": SurfaceClass.GRASS,
    "estate": SurfaceClass.GRASS,
    "works": SurfaceClass.GROUND,
}
_STONE = np.array((158.0, 152.0, 144.0))
_EARTH = np.array((150.0, 138.0, 118.0))
_PAINT = np.array((222.0, 222.0, 216.0))
_FIELDS = np.array(
    [(122, 130, 76), (138, 138, 86), (154, 148, 98), (110, 124, 70), (130, 122, 86), (116, 132, 78)], float
)
_NUM_FIELDS = 420


def add_ground(builder: MeshBuilder, town: Town) -> None:
    """Adds everything that lies on the ground."""
    _add_land(builder, town)
    _add_river(builder, town)
    for number, (block, district) in enumerate(zip(town.streets.blocks, town.districts, strict=True)):
        chances = random_stream(town.seed, "demo", "yard", number)
        shade = float(chances.uniform(0.94, 1.06))
        _drape(builder, town, SurfaceClass.PAVEMENT, block.ring, _PAVEMENT_M, _STONE * shade)
        yard = inset(block.ring, _PAVEMENT_WIDTH_M)
        # The market square, the first block, is paved all over.
        if yard is not None and number > 0:
            kind = _YARDS[district]
            tint = {SurfaceClass.GRASS: _pick(chances, town.look.grass), SurfaceClass.GROUND: _EARTH}.get(
                kind, _STONE
            )
            _drape(builder, town, kind, yard, _YARD_M, tint * float(chances.uniform(0.92, 1.08)))
    for street in town.streets.streets:
        _add_markings(builder, town, street)


def _pick(chances: np.random.Generator, colours: tuple[tuple[int, int, int], ...]) -> Points:
    return np.array(colours[int(chances.integers(len(colours)))], dtype=float)


def on_ground(town: Town, points: Points, above_m: float) -> Points:
    """Returns positions, (N, 2), with the height of the ground and a little more, (N, 3)."""
    return np.column_stack([points, town.terrain.height(points) + above_m])


def _drape(
    builder: MeshBuilder, town: Town, surface: SurfaceClass, ring: Points, above_m: float, tint: Points
) -> None:
    points, triangles = refined(*filled(ring), lambda middles: np.full(len(middles), _NEAR_M))
    builder.add(surface, on_ground(town, points, above_m), triangles, tint)


def _add_land(builder: MeshBuilder, town: Town) -> None:
    """Adds the bare ground: streets under the town, fields, meadows beside the river, its bed."""
    square = _LAND_M * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])

    def longest(middles: Points) -> Points:
        distance = np.linalg.norm(middles, axis=1)
        far = np.maximum(_NEAR_M, _FAR_SHARE * (distance - 500.0))
        close = town.terrain.river_distance(middles)
        bank = np.maximum(_BANK_EDGE_M, np.maximum(0.4 * (close - 22.0), 0.02 * distance - 8.0))
        return np.asarray(np.minimum(far, bank))

    points, triangles = refined(*filled(square), longest)
    middles = points[triangles].mean(axis=1)
    river = town.terrain.river_distance(middles)
    chances = random_stream(town.seed, "demo", "fields")
    parcels = chances.uniform(-_LAND_M, _LAND_M, (_NUM_FIELDS, 2)) * chances.uniform(
        0.2, 1.0, (_NUM_FIELDS, 1)
    )
    colours = _FIELDS[chances.integers(len(_FIELDS), size=_NUM_FIELDS)] * chances.uniform(
        0.9, 1.1, (_NUM_FIELDS, 1)
    )
    tint = colours[cKDTree(parcels).query(middles)[1]]
    surface = np.full(len(middles), SurfaceClass.FIELD, np.uint8)
    meadow = river < 36.0
    surface[meadow], tint[meadow] = SurfaceClass.GRASS, np.array(town.look.grass[0])
    surface[river < 18.0], tint[river < 18.0] = SurfaceClass.GROUND, _EARTH * 0.8
    # Streets are what blocks leave free of the land: no triangle sticks out of it.
    is_town = np.logical_or(*[contains(bank, points) for bank in town.streets.banks])[triangles].all(axis=1)
    surface[is_town], tint[is_town] = SurfaceClass.ROAD, np.array(town.look.road)
    builder.add(surface, on_ground(town, points, 0.0), triangles, tint)


def _add_river(builder: MeshBuilder, town: Town) -> None:
    """Adds the water, level, and two bridges."""
    line = town.streets.river
    ribbon = _ribbon(line, _WATER_HALF_M, town.terrain.water_m)
    builder.add(SurfaceClass.WATER, *ribbon, town.look.water)
    half = 0.5 * length_of(line)
    for at in (half - 150.0, half + 170.0):
        (middle,), (along,) = along_line(line, np.array([at]))
        across = left_of(along)
        ends = middle + np.outer([-1.0, -0.5, 0.0, 0.5, 1.0], 33.0 * across)
        heights = town.terrain.water_m + np.array([2.75, 3.3, 3.5, 3.3, 2.75])
        deck = _ribbon(ends, 5.0, heights)
        number = builder.new_objects(1)
        builder.add(SurfaceClass.ROAD, *deck, town.look.road, number[0])
        for side in (-5.0, 5.0):
            wall = _upright(offset_line(ends, side), heights - 1.0, heights + 1.0)
            builder.add(SurfaceClass.PAVEMENT, *wall, (170, 164, 154), number[0])


def _ribbon(line: Points, half_m: float, height: float | Points) -> tuple[Points, NDArray[np.int64]]:
    """Returns a strip along a polyline, (2K, 3) and triangles."""
    sides = np.concatenate([offset_line(line, -half_m), offset_line(line, half_m)])
    z = np.broadcast_to(height, len(line))
    return np.column_stack([sides, np.concatenate([z, z])]), _strip_triangles(len(line))


def _upright(line: Points, low: Points, high: Points) -> tuple[Points, NDArray[np.int64]]:
    """Returns a wall along a polyline, (2K, 3) and triangles."""
    points = np.concatenate([np.column_stack([line, low]), np.column_stack([line, high])])
    return points, _strip_triangles(len(line))


def _strip_triangles(count: int) -> NDArray[np.int64]:
    """Returns the triangles between points 0 .. count - 1 and as many points behind them."""
    k = np.arange(count - 1)
    lower = np.stack([k, k + 1, k + 1 + count], axis=1)
    upper = np.stack([k, k + 1 + count, k + count], axis=1)
    return np.concatenate([lower, upper])


def _add_markings(builder: MeshBuilder, town: Town, street: Street) -> None:
    """Adds the middle line of a street, and on wide ones edge lines and crossings on foot at its ends."""
    length, width = length_of(street.line), street.width_m
    if width < 9.5 or length < 25.0:
        return
    bars = []
    dashes = np.arange(9.0, length - 11.0, 8.0)
    bars.append(_bars(street.line, dashes + 1.5, 3.0, 0.16))
    if width > 13.0:
        for side in (-1.0, 1.0):
            lane = offset_line(street.line, side * (0.5 * width - 2.3))
            at = np.arange(10.0, length_of(lane) - 12.0, 5.0)
            bars.append(_bars(lane, at + 2.5, 5.0, 0.13))
        stripes = np.arange(-0.5 * width + 0.8, 0.5 * width - 0.8, 1.1)
        for end in (4.5, length - 4.5):
            bars += [
                _bars(offset_line(street.line, float(off)), np.array([end]), 3.0, 0.5) for off in stripes
            ]
    quads = np.concatenate(bars)
    points = on_ground(town, quads.reshape(-1, 2), _MARKING_M)
    first = 4 * np.arange(len(quads))[:, None]
    triangles = np.concatenate([first + np.array(fan) for fan in ((0, 1, 2), (0, 2, 3))])
    builder.add(SurfaceClass.MARKING, points, triangles, _PAINT)


def _bars(line: Points, at: Points, length: float, width: float) -> Points:
    """Returns painted rectangles, (N, 4, 2), along a polyline, their middles at distances along it."""
    middle, along = along_line(line, at)
    u, v = 0.5 * length * along, 0.5 * width * left_of(along)
    return np.stack([middle - u - v, middle + u - v, middle + u + v, middle - u + v], axis=1)
