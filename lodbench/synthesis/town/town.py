"""The demo town: a made-up European town of some 900 buildings, the same for a seed everywhere.

Order of work: streets cut the land into blocks, each block gets a district and plans, each plan is
built on the terrain beside its neighbours at three levels of detail.

Its ground as props: fields, meadows, the river, streets with markings, blocks, bridges, each a plane mesh,
refined so that it can be draped over the hills.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import mapbox_earcut
import numpy as np
import scipy

from lodbench.kernels.looks import SurfaceClass
from lodbench.storage import random_stream
from lodbench.synthesis.objects import MeshBuilder, Triangles, grid_triangles, palette
from lodbench.synthesis.town import houses, shapes
from lodbench.synthesis.town.buildings import Age, Building, Plan, chance, construct_all
from lodbench.synthesis.town.houses import OLD_LANES, SUBURB, VILLAS, Site, add_closed_block, add_houses
from lodbench.synthesis.town.shapes import Points
from lodbench.synthesis.town.streets import Block, Occupancy, Street, StreetPlan, Terrain, draw_streets

# Raise it whenever a seed gives another town, queries included: results of two versions do not compare.
TOWN_VERSION = "2"
CRS_NAME = "urn:ogc:def:crs,crs::EPSG::25832,crs::EPSG::7837"
# Where the made-up town lies in UTM zone 32: easting, northing and height of its local origin, metres.
ORIGIN_M = np.array([567_000.0, 5_539_000.0, 0.0])

# The church stands on the first of the middle blocks that has room for it; block 0 is the market.
_CHURCH_BLOCKS = range(1, 12)
# No building stands farther out than this.
_REACH_M = 640.0
OLD_TOWN_RADIUS_M = 175.0
_INNER_RADIUS_M = 290.0
_ESTATE_RADIUS_M = 320.0
# Half the angle under which the estate is viewed from the middle of town.
_ESTATE_HALF_ANGLE = 0.42
# Width of pavements and front gardens, from the kerb to the building line.
_PAVEMENTS_M = {"old town": 1.5, "inner town": 2.5, "works": 6.0, "estate": 7.0, "garden suburb": 4.0}
_LEAST_BLOCK_M2 = 300.0
# Every so many-th block of the inner town is a park.
_PARK_EVERY, _PARK_FIRST = 17, 5


class Town(NamedTuple):
    """A town in local metres, x east, y north, its middle at the origin; heights above sea level."""

    seed: int
    look: shapes.TownLook
    # Block by block from the middle outward, those pulled down before the photos included.
    buildings: tuple[Building, ...]
    streets: StreetPlan
    districts: tuple[str, ...]  # district of each block of ``streets``
    terrain: Terrain
    occupancy: Occupancy

    @property
    def standing(self) -> tuple[Building, ...]:
        """Returns the buildings that photos show and LoD3 holds."""
        return tuple(building for building in self.buildings if building.age is not Age.GONE)

    @property
    def mapped(self) -> tuple[Building, ...]:
        """Returns the buildings that LoD1 and LoD2 hold."""
        return tuple(building for building in self.buildings if building.age is not Age.NEW)


def grow_town(seed: int, look_name: str = "test") -> Town:
    """Returns the town of a seed and a look, ``test`` or ``train``."""
    look = shapes.look_named(look_name)
    streets = draw_streets(random_stream(seed, "demo", "streets"), look.rings)
    ground = random_stream(seed, "demo", "ground")
    terrain = Terrain.draw(ground, streets.river, look.relief)
    blocks = _landmarks(seed, streets)
    estate_turn = float(ground.uniform(-1.2, 1.2))
    districts = tuple(_district_of(block, streets.to_river, estate_turn) for block in streets.blocks)
    for number, (block, district) in enumerate(zip(streets.blocks, districts, strict=True)):
        site = _site_of(block, district, random_stream(seed, "demo", "block", number))
        if number not in blocks and site is not None:
            if district == "inner town" and number % _PARK_EVERY == _PARK_FIRST:
                houses.add_pavilion(site)
            else:
                _BUILD_UP[district](site)
            blocks[number] = site.plans
    named = [
        (f"DEMO_{number:03d}_{k:02d}", plan)
        for number in sorted(blocks)
        for k, plan in enumerate(blocks[number])
    ]
    occupancy = Occupancy([plan.pieces for _, plan in named], _REACH_M)
    buildings = tuple(construct_all(named, seed, look, terrain, occupancy))
    return Town(seed, look, buildings, streets, districts, terrain, occupancy)


def _landmarks(seed: int, streets: StreetPlan) -> dict[int, list[Plan]]:
    """Returns the plans of the market square and of the church's block, by block number."""
    market = _site_of(streets.blocks[0], "old town", random_stream(seed, "demo", "town hall"))
    if market is None:
        return {}
    houses.add_town_hall(market)
    blocks = {0: market.plans}
    for number in _CHURCH_BLOCKS:
        square = _site_of(streets.blocks[number], "old town", random_stream(seed, "demo", "church"))
        if square is not None and houses.add_church(square):
            blocks[number] = square.plans
            break
    return blocks


def _district_of(block: Block, to_river: Points, estate_turn: float) -> str:
    """Returns the district of a block: rings around the middle, an estate and works at the edge.

    ``to_river``, (2,) unit, leads to the river; the estate lies ``estate_turn`` radians from away from it.
    """
    x, y = block.center
    radius = float(np.hypot(x, y))
    if block.beyond_river:
        return "works" if x * to_river[1] - y * to_river[0] > 60.0 else "garden suburb"
    if radius < OLD_TOWN_RADIUS_M:
        return "old town"
    if radius < _INNER_RADIUS_M:
        return "inner town"
    bearing = np.arctan2(y, x) - np.arctan2(-to_river[1], -to_river[0]) - estate_turn
    off = abs((bearing + np.pi) % (2 * np.pi) - np.pi)
    return "estate" if off < _ESTATE_HALF_ANGLE and radius > _ESTATE_RADIUS_M else "garden suburb"


def _site_of(block: Block, district: str, chances: np.random.Generator) -> Site | None:
    """Returns a block behind its building line, or None where that is too small to be built on."""
    ring = shapes.inset(block.ring, _PAVEMENTS_M[district])
    return None if ring is None or shapes.area(ring) < _LEAST_BLOCK_M2 else Site(ring, district, chances)


def _build_old_town(site: Site) -> None:
    """Adds a courtyard building, a closed block, or lanes of houses where neither has room."""
    if chance(site.chances, 0.12):
        houses.add_courtyard_house(site)
    if not site.plans:
        add_closed_block(site, storeys=3)
    if not site.plans:
        add_houses(site, OLD_LANES)


def _build_inner_town(site: Site) -> None:
    """Adds a school, a closed block or villas."""
    if chance(site.chances, 0.16):
        houses.add_school(site)
    if not site.plans and chance(site.chances, 0.45):
        add_closed_block(site, storeys=4)
    if not site.plans:
        add_houses(site, VILLAS)


# What adds all that stands on a block of a district.
_BUILD_UP: dict[str, Callable[[Site], None]] = {
    "old town": _build_old_town,
    "inner town": _build_inner_town,
    "estate": houses.add_flats,
    "works": houses.add_works,
    "garden suburb": partial(add_houses, style=SUBURB),
}


# Heights of layers above the bare ground, metres. Two meshes of one surface differ by up to 3 cm.
_MARKING_M, _PAVEMENT_M, _YARD_M = 0.05, 0.12, 0.17
# The land reaches this far from the middle of town: farther than a drone at 60 degrees sees detail.
_LAND_M = 4000.0
_WATER_HALF_M = 17.0
# Edges of ground triangles in town and beside the river, and the share of the distance beyond.
_NEAR_M, _BANK_EDGE_M, _FAR_SHARE = 12.0, 6.0, 0.06
_PAVEMENT_WIDTH_M = 2.2
_YARDS = {"old town": SurfaceClass.PAVEMENT, "works": SurfaceClass.GROUND}  # grass elsewhere
_STONE, _EARTH, _PAINT, _PARAPET = (palette(code) for code in ("9e9890", "968a76", "deded8", "aaa49a"))
_FIELDS = palette("7a824c 8a8a56 9a9462 6e7c46 827a56 74844e")
_NUM_FIELDS = 420


def add_ground(builder: MeshBuilder, town: Town) -> None:
    """Adds everything that lies on the ground."""
    _add_land(builder, town)
    _add_river(builder, town)
    for number, (block, district) in enumerate(zip(town.streets.blocks, town.districts, strict=True)):
        chances = random_stream(town.seed, "demo", "yard", number)
        shade = float(chances.uniform(0.94, 1.06))
        _drape(builder, town, SurfaceClass.PAVEMENT, block.ring, _PAVEMENT_M, _STONE * shade)
        yard = shapes.inset(block.ring, _PAVEMENT_WIDTH_M)
        # The market square, the first block, is paved all over.
        if yard is not None and number > 0:
            kind = _YARDS.get(district, SurfaceClass.GRASS)
            lawn = town.look.grass[int(chances.integers(len(town.look.grass)))]
            tint = {SurfaceClass.GRASS: lawn, SurfaceClass.GROUND: _EARTH}.get(kind, _STONE)
            _drape(builder, town, kind, yard, _YARD_M, tint * chances.uniform(0.92, 1.08))
    for street in town.streets.streets:
        _add_markings(builder, town, street)


def _drape(
    builder: MeshBuilder, town: Town, surface: SurfaceClass, ring: Points, above_m: float, tint: Points
) -> None:
    points, triangles = refined(*filled(ring), lambda middles: np.full(len(middles), _NEAR_M))
    builder.add(surface, town.terrain.on_ground(points, above_m), triangles, tint)


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
    one_each = (_NUM_FIELDS, 1)
    parcels = chances.uniform(-_LAND_M, _LAND_M, (_NUM_FIELDS, 2)) * chances.uniform(0.2, 1.0, one_each)
    colours = _FIELDS[chances.integers(len(_FIELDS), size=_NUM_FIELDS)] * chances.uniform(0.9, 1.1, one_each)
    tint = colours[scipy.spatial.cKDTree(parcels).query(middles)[1]]
    surface = np.full(len(middles), SurfaceClass.FIELD, np.uint8)
    # Streets are what blocks leave free of the land: no triangle sticks out of it.
    is_town = np.logical_or(*[shapes.contains(bank, points) for bank in town.streets.banks])[triangles].all(
        axis=1
    )
    for chosen, kind, colour in (
        (river < 36.0, SurfaceClass.GRASS, town.look.grass[0]),
        (river < 18.0, SurfaceClass.GROUND, _EARTH * 0.8),
        (is_town, SurfaceClass.ROAD, town.look.road),
    ):
        surface[chosen], tint[chosen] = kind, colour
    builder.add(surface, town.terrain.on_ground(points), triangles, tint)


def _add_river(builder: MeshBuilder, town: Town) -> None:
    """Adds the water, level, and two bridges."""
    line = town.streets.river
    ribbon = _ribbon(line, _WATER_HALF_M, town.terrain.water_m)
    builder.add(SurfaceClass.WATER, *ribbon, town.look.water)
    half = 0.5 * shapes.length_of(line)
    for at in (half - 150.0, half + 170.0):
        (middle,), (along,) = shapes.along_line(line, np.array([at]))
        across = shapes.left_of(along)
        ends = middle + np.outer([-1.0, -0.5, 0.0, 0.5, 1.0], 33.0 * across)
        heights = town.terrain.water_m + np.array([2.75, 3.3, 3.5, 3.3, 2.75])
        number = builder.new_objects(1)[0]
        builder.add(SurfaceClass.ROAD, *_ribbon(ends, 5.0, heights), town.look.road, number)
        for side in (-5.0, 5.0):
            foot = shapes.offset_line(ends, side)
            wall = _strip(np.column_stack([foot, heights - 1.0]), np.column_stack([foot, heights + 1.0]))
            builder.add(SurfaceClass.PAVEMENT, *wall, _PARAPET, number)


def _ribbon(line: Points, half_m: float, height: float | Points) -> tuple[Points, Triangles]:
    """Returns a level strip along a polyline, points and triangles."""
    z = np.broadcast_to(height, len(line))
    right, left = (np.column_stack([shapes.offset_line(line, side), z]) for side in (-half_m, half_m))
    return _strip(right, left)


def _strip(front: Points, back: Points) -> tuple[Points, Triangles]:
    """Returns the points of two lines, (2K, 3), and the triangles between them."""
    return np.concatenate([front, back]), grid_triangles(2, len(front))


def _add_markings(builder: MeshBuilder, town: Town, street: Street) -> None:
    """Adds the middle line of a street, and on wide ones edge lines and crossings on foot at its ends."""
    length, width = shapes.length_of(street.line), street.width_m
    if width < 9.5 or length < 25.0:
        return
    bars = [_bars(street.line, np.arange(9.0, length - 11.0, 8.0) + 1.5, 3.0, 0.16)]
    if width > 13.0:
        for side in (-1.0, 1.0):
            lane = shapes.offset_line(street.line, side * (0.5 * width - 2.3))
            bars.append(_bars(lane, np.arange(10.0, shapes.length_of(lane) - 12.0, 5.0) + 2.5, 5.0, 0.13))
        stripes = np.arange(-0.5 * width + 0.8, 0.5 * width - 0.8, 1.1).tolist()
        for end in (4.5, length - 4.5):
            bars += [
                _bars(shapes.offset_line(street.line, off), np.array([end]), 3.0, 0.5) for off in stripes
            ]
    quads = np.concatenate(bars)
    points = town.terrain.on_ground(quads.reshape(-1, 2), _MARKING_M)
    first = 4 * np.arange(len(quads))[:, None]
    triangles = np.concatenate([first + np.array(fan) for fan in ((0, 1, 2), (0, 2, 3))])
    builder.add(SurfaceClass.MARKING, points, triangles, _PAINT)


def _bars(line: Points, at: Points, length: float, width: float) -> Points:
    """Returns painted rectangles, (N, 4, 2), along a polyline, their middles at distances along it."""
    return shapes.rectangles(*shapes.along_line(line, at), length, width)


def filled(ring: Points) -> tuple[Points, Triangles]:
    """Returns a ring's corners, (N, 2), and the triangles that fill it, counter-clockwise."""
    corners = np.ascontiguousarray(ring, dtype=np.float64)
    indices = mapbox_earcut.triangulate_float64(corners, np.array([len(corners)], np.uint32))
    triangles = np.asarray(indices, dtype=np.int64).reshape(-1, 3)
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    return corners, np.where((turn < 0)[:, None], triangles[:, ::-1], triangles)


def refined(
    points: Points, triangles: Triangles, longest: Callable[[Points], Points]
) -> tuple[Points, Triangles]:
    """Returns a plane mesh, (P, 2) and (T, 3), whose edges are nowhere longer than wanted, without cracks.

    Edges are halved, both triangles beside them alike, until all are short enough; ``longest`` returns the
    length wanted, (N,), of those with middles (N, 2).
    """
    while True:
        edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        keys, inverse = np.unique(edges[:, 0] * len(points) + edges[:, 1], return_inverse=True)
        first, second = np.divmod(keys, len(points))
        middles = 0.5 * (points[first] + points[second])
        is_long = np.linalg.norm(points[second] - points[first], axis=1) > longest(middles)
        if not is_long.any():
            return points, triangles
        numbers = np.where(is_long, len(points) + np.cumsum(is_long) - 1, -1)
        triangles = _split(triangles, numbers[inverse].reshape(-1, 3))
        points = np.concatenate([points, middles[is_long]])


def _split(triangles: Triangles, middles: Triangles) -> Triangles:
    """Returns triangles split at the middles of their edges 01, 12 and 20, (T, 3), -1 for whole edges."""
    parts = [triangles[(middles < 0).all(axis=1)]]

    def add(chosen: Any, *fans: tuple[Triangles, Triangles, Triangles]) -> None:
        parts.extend(np.stack(fan, axis=1)[chosen] for fan in fans)

    for k in range(3):
        # Turned so that the pattern of split edges is one of three.
        (a, b, c), (ab, bc, ca) = np.roll(triangles, -k, axis=1).T, np.roll(middles, -k, axis=1).T
        add((ab >= 0) & (bc < 0) & (ca < 0), (a, ab, c), (ab, b, c))
        add((ab >= 0) & (bc >= 0) & (ca < 0), (ab, b, bc), (a, ab, bc), (a, bc, c))
    (a, b, c), (ab, bc, ca) = triangles.T, middles.T
    add((middles >= 0).all(axis=1), (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate(parts)
