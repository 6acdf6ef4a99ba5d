"""Where trees, hedges and cars of the town stand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import Polygons, SurfaceKind, starts_of
from lodbench.citymodel.triangulate import triangulate
from lodbench.findings import Findings
from lodbench.kernels.looks import SurfaceClass
from lodbench.storage import random_stream
from lodbench.synthesis.objects import (
    BLOCK_FACES,
    MeshBuilder,
    SceneProps,
    add_cars,
    add_trees,
    palette,
    pick,
)
from lodbench.synthesis.town import shapes
from lodbench.synthesis.town.buildings import Building
from lodbench.synthesis.town.shapes import Points
from lodbench.synthesis.town.town import ORIGIN_M, Town, add_ground

# One tree for so many square metres of open land, by district; parks have more.
_LAND_PER_TREE_M2 = {"old town": 420.0, "inner town": 190.0, "garden suburb": 170.0}
_LAND_PER_TREE_M2 |= {"estate": 210.0, "works": 520.0}
_PARK_M2 = 75.0
_HEDGE = palette("42582e")
_NUM_WOODS = 14


def add_greenery(builder: MeshBuilder, town: Town) -> None:
    """Adds trees in streets, yards and parks, along the river and in woods around, and hedges."""
    chances = random_stream(town.seed, "demo", "trees")
    kinds = (_along_streets, _in_yards, _along_river)
    places = np.concatenate([part for kind in kinds for part in kind(town, chances)])
    places = places[town.occupancy.is_free_near(places, 2.4)]
    # How wide a crown may grow: it may touch a wall.
    room_m = np.full(len(places), 2.6)
    for gap in (3.2, 4.0, 5.0):
        room_m[town.occupancy.is_free_near(places, gap)] = gap
    add_trees(builder, town.terrain.on_ground(places), chances, town.look.broadleaf, room_m)
    woods = town.terrain.on_ground(_in_woods(town, chances))
    add_trees(builder, woods, chances, town.look.broadleaf, is_far=True)
    _add_hedges(builder, town, chances)


def _along_streets(town: Town, chances: np.random.Generator) -> Iterator[Points]:
    """Yields places of trees on the pavements of wider streets."""
    for street in town.streets.streets:
        likely = 0.75 if street.width_m > 15 else 0.35
        for side in (-1.0, 1.0):
            if street.width_m < 10.5 or chances.random() > likely * town.look.trees:
                continue
            line = shapes.offset_line(street.line, side * (0.5 * street.width_m + 1.1))
            spacing = float(chances.uniform(8.0, 14.0))
            at = np.arange(9.0, shapes.length_of(line) - 9.0, spacing)
            at = at[chances.random(len(at)) < 0.85]
            yield shapes.along_line(line, at + chances.normal(0.0, 0.6, len(at)))[0]


def _in_yards(town: Town, chances: np.random.Generator) -> Iterator[Points]:
    """Yields places of trees in gardens, courtyards and parks."""
    for number, (block, district) in enumerate(zip(town.streets.blocks, town.districts, strict=True)):
        yard = shapes.inset(block.ring, 3.5)
        if number == 0 or yard is None:
            continue
        low, high = yard.min(axis=0), yard.max(axis=0)
        grid = np.mgrid[low[0] : high[0] : 4.0, low[1] : high[1] : 4.0].reshape(2, -1).T
        taken = town.occupancy.at(grid)
        is_park = len(np.unique(taken)) <= 2 and district == "inner town"
        per_tree = _PARK_M2 if is_park else _LAND_PER_TREE_M2[district]
        count = round(float(np.prod(high - low)) / per_tree * town.look.trees)
        drawn = chances.uniform(low, high, (count, 2))
        yield drawn[shapes.contains(yard, drawn)]


def _along_river(town: Town, chances: np.random.Generator) -> Iterator[Points]:
    """Yields places of trees on both banks, in loose rows."""
    line = town.streets.river
    half = 0.5 * shapes.length_of(line)
    for side in (-1.0, 1.0):
        at = np.cumsum(chances.uniform(5.0, 26.0, 160)) + half - 1200.0
        bank, _ = shapes.along_line(shapes.offset_line(line, side * 21.0), at)
        yield bank + chances.normal(0.0, 1.0, bank.shape)


def _in_woods(town: Town, chances: np.random.Generator) -> Points:
    """Returns places of trees in woods around the town."""
    places = []
    for _ in range(_NUM_WOODS):
        turn, away = chances.uniform(0.0, 2 * np.pi), chances.uniform(680.0, 1500.0)
        middle = away * np.array([np.cos(turn), np.sin(turn)])
        radius = chances.uniform(50.0, 130.0) * np.array([1.0, chances.uniform(0.5, 1.0)])
        count = round(float(np.pi * radius[0] * radius[1]) / 55.0)
        ray, spin = np.sqrt(chances.random(count)), chances.uniform(0.0, 2 * np.pi, count)
        places.append(middle + np.stack([np.cos(spin), np.sin(spin)], axis=1) * ray[:, None] * radius)
    drawn = np.concatenate(places)
    return drawn[town.terrain.river_distance(drawn) > 30.0]


def _add_hedges(builder: MeshBuilder, town: Town, chances: np.random.Generator) -> None:
    """Adds hedges along the front gardens of the suburbs, with gaps for gates."""
    for block, district in zip(town.streets.blocks, town.districts, strict=True):
        ring = shapes.inset(block.ring, 2.9)
        if district not in ("garden suburb", "inner town") or ring is None or shapes.area(ring) < 900.0:
            continue
        for start, along, length in zip(
            ring, shapes.edge_directions(ring), shapes.edge_lengths(ring), strict=True
        ):
            at = 1.0
            while at < length - 4.0:
                run = min(float(chances.uniform(4.0, 15.0)), length - at - 1.0)
                if chances.random() < 0.6:
                    _add_hedge(builder, town, start + along * at, along * run, chances)
                at += run + float(chances.uniform(2.0, 4.5))


def _add_hedge(
    builder: MeshBuilder, town: Town, start: Points, way: Points, chances: np.random.Generator
) -> None:
    side = shapes.left_of(way / np.linalg.norm(way)) * 0.3
    ring = np.stack([start - side, start + way - side, start + way + side, start + side])
    if (town.occupancy.at(ring) > 0).any():
        return
    low = town.terrain.on_ground(ring)
    high = low + np.array([0.0, 0.0, chances.uniform(0.9, 1.7)])
    tint = pick(_HEDGE, chances, 0.8, 1.2)
    builder.add(SurfaceClass.FENCE, np.concatenate([low, high]), BLOCK_FACES, tint)


def add_traffic(builder: MeshBuilder, town: Town) -> None:
    """Adds cars to all streets wide enough for them."""
    chances = random_stream(town.seed, "demo", "cars")
    middles, directions = (np.concatenate(part) for part in zip(*_on_streets(town, chances), strict=True))
    # A car stands on the slope of its street.
    rise = town.terrain.height(middles + 2.0 * directions) - town.terrain.height(middles - 2.0 * directions)
    add_cars(builder, town.terrain.on_ground(middles), directions, rise / 4.0, chances)


def _on_streets(town: Town, chances: np.random.Generator) -> Iterator[tuple[Points, Points]]:
    """Yields places of parked and of moving cars, (N, 2), and where they point to."""
    for street in town.streets.streets:
        width, length = street.width_m, shapes.length_of(street.line)
        for side in (-1.0, 1.0):
            # Right-hand traffic: to the right of the line cars go along it.
            if width > 9.5:
                parked = np.cumsum(chances.uniform(5.6, 7.6, 200)) + 7.0
                parked = parked[(parked < length - 9.0) & (chances.random(200) < 0.4)]
                places, along = shapes.along_line(
                    shapes.offset_line(street.line, side * (0.5 * width - 1.2)), parked
                )
                yield places, -side * along
            if width > 12.0:
                moving = np.cumsum(chances.uniform(25.0, 120.0, 40)) + 4.0
                lane = shapes.offset_line(street.line, side * 0.2 * width)
                places, along = shapes.along_line(lane, moving[moving < length - 6.0])
                yield places, -side * along


# A body, and the class of all its surfaces where they have one.
Body = tuple[shapes.Solid, SurfaceClass | None]

_FLAT_COSINE = 0.985  # roofs that lean less are flat: ten degrees
_CLASSES = {
    SurfaceKind.WALL: SurfaceClass.WALL,
    SurfaceKind.ROOF: SurfaceClass.ROOF_TILE,
    SurfaceKind.GROUND: SurfaceClass.FLOOR,
    SurfaceKind.FLOOR: SurfaceClass.FLOOR,
}
_OPENINGS = {False: SurfaceClass.WINDOW, True: SurfaceClass.DOOR}
# What is alike on all buildings: its colour, and how much darker and brighter it may be.
_FITTINGS = {
    SurfaceClass.WINDOW: (palette("3a444e"), 0.8, 1.25),
    SurfaceClass.DOOR: (palette("604634"), 0.7, 1.4),
    SurfaceClass.FRAME: (palette("c4c4c0"), 0.8, 1.1),
    SurfaceClass.CHIMNEY: (palette("8e5c4c"), 0.8, 1.2),
}
_SOFFIT = palette("cec8bc")[0]


def demo_props(town: Town) -> SceneProps:
    """Returns what a photo of the town shows, in the frame of ``ORIGIN_M``."""
    builder = MeshBuilder(len(town.standing))
    # Each building is in colours of its own, with windows, doors, chimneys and balconies.
    colours = np.stack([building_colours(town, building.identifier) for building in town.standing])
    bodies = [fine_bodies(building) for building in town.standing]
    add_buildings(builder, bodies, colours, np.arange(len(bodies)))
    add_ground(builder, town)
    add_greenery(builder, town)
    add_traffic(builder, town)
    return builder.build(ORIGIN_M)


def add_buildings(
    builder: MeshBuilder, buildings: Sequence[Sequence[Body]], colours: Points, objects: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Adds the surfaces of buildings, each of one or more bodies; returns the polygon of each triangle, (T,).

    Colours are (B, 8, 3) RGB by surface class from ``WALL`` on, objects (B,) the buildings' numbers.
    """
    faces = [
        (number, solid.points, face, part or _CLASSES.get(face.kind, _OPENINGS[face.is_door]))
        for number, bodies in enumerate(buildings)
        for solid, part in bodies
        for face in solid.faces
    ]
    rings = [points[list(ring)] for _, points, face, _ in faces for ring in face.rings]
    polygons = Polygons(
        points=np.concatenate(rings),
        ring_starts=starts_of(np.array([len(ring) for ring in rings])),
        polygon_starts=starts_of(np.array([len(face.rings) for _, _, face, _ in faces])),
        building=np.array([number for number, *_ in faces], np.int32),
        lod=np.zeros(len(faces), np.int16),
        kind=np.array([kind for *_, kind in faces], np.uint8),
    )
    result = triangulate(polygons, tuple(map(str, objects)), Findings())
    surface, owner = polygons.kind[result.polygon], polygons.building[result.polygon]
    a, b, c = polygons.points[result.triangles].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    is_level = np.abs(normal[:, 2]) > _FLAT_COSINE * np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    surface[is_level & (surface == SurfaceClass.ROOF_TILE)] = SurfaceClass.ROOF_FLAT
    tint = colours[owner, surface - SurfaceClass.WALL]
    builder.add(surface, polygons.points, result.triangles, tint, objects[owner])
    return result.polygon


def fine_bodies(building: Building) -> list[Body]:
    """Returns the bodies of a building at LoD3, and the class of all surfaces of those that have one."""
    eave = building.lod2.points[:, 2].min() + building.plan.roof.eave_m
    extra = [
        (solid, SurfaceClass.CHIMNEY if solid.points[:, 2].max() > eave + 0.3 else SurfaceClass.FRAME)
        for solid in building.installations
    ]
    return [(building.lod3, None), *extra]


def building_colours(town: Town, name: str) -> Points:
    """Returns the colours of a building, (8, 3) RGB by surface class from ``WALL`` on."""
    chances, look = random_stream(town.seed, "demo", name, "colour"), town.look
    palettes = (look.walls, look.tiles, look.flat_roofs)
    wall, tile, flat = (pick(colours, chances, 0.92, 1.06) for colours in palettes)
    chances.uniform()
    fittings = [pick(colours, chances, low, high) for colours, low, high in _FITTINGS.values()]
    return np.stack([wall, flat, tile, *fittings, _SOFFIT])
