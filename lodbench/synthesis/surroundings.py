"""What stands around a city model's buildings: land cover, relief, trees and cars."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.kernels.looks import LAND_COVER, SurfaceClass
from lodbench.storage import random_stream
from lodbench.synthesis import objects
from lodbench.synthesis.land_cover import (
    Ground,
    Land,
    draw_land_cover,
    ground_from_bases,
    ground_from_raster,
    look_down,
)
from lodbench.synthesis.objects import MeshBuilder, Points, Tint, palette, pick

Floats = NDArray[np.float64]

# One place to try in so many metres, the share of them that is used, and how many at most.
_SPACING_M, _SHARE, _MOST = 32.0, 0.4, 1500
# What is painted on the ground lies so far above it: two meshes of one slope differ by less.
_ABOVE_M, _MESH_M = 0.12, 3.0
# What rises by more stands, metres.
_STANDS_M = 0.5
_BOXES = palette("a43c2c 285280 3c6a4c c4b03c cececa 787a7c")
_CANVAS = palette("f0f0ec e4e0d2 466ea0 58784c")
_HEAPS = palette("ceb88c 968064 807e7a 604e3c")
_COURTS = palette("964636 486e4a 3c608c b06e50")
_YARDS = palette("c4c2bc a8a49c d6c8aa 8c8a86")
_WHITE = palette("deded8")
_SHADES = (0.85, 1.1)
# Rings of a heap: share of the radius, height of one of six metres.
_SLOPE = ((1.0, 0.0), (0.6, 1.9), (0.25, 2.9))


class Spot(NamedTuple):
    """Where something is put: its middle (2,), its unit direction (2,), and the ground around it."""

    middle: Floats
    along: Floats
    ground: Ground

    def places(self, local: Floats) -> Floats:
        """Returns places, (..., 2), of what lies so far along and to the left of the middle."""
        across = np.array([-self.along[1], self.along[0]])
        return np.asarray(self.middle + local[..., :1] * self.along + local[..., 1:] * across)


def add_clutter(builder: MeshBuilder, land: Land, chances: np.random.Generator) -> None:
    """Adds clutter to open land between and around buildings, clear of roads and water."""
    places = land.view.jittered(_SPACING_M, chances)
    kind, road_m, built_m = land.at(places)
    free_m = np.minimum(built_m, road_m - land.cover.half_road_m)
    dry = (kind != SurfaceClass.WATER) & (built_m < 90.0)
    chosen = np.flatnonzero(dry & (chances.random(len(places)) < _SHARE))
    kinds = list(CLUTTER.values())
    for k in chances.permutation(chosen)[:_MOST]:
        add, radius_m = kinds[int(chances.integers(len(kinds)))]
        turn = float(chances.uniform(0.0, 2 * np.pi))
        if free_m[k] > radius_m:
            add(builder, Spot(places[k], np.array([np.cos(turn), np.sin(turn)]), land.ground), chances)


def standing_clutter(props: objects.SceneProps, land: Land) -> list[list[float]]:
    """Returns west, south, east and north, the city's coordinates, of containers, tents and heaps of a city.

    Nothing that is painted on the ground; trees and cars neither.
    """
    kinds = props.surface == SurfaceClass.CLUTTER
    kinds |= (props.surface == SurfaceClass.GROUND) & props.tint.any(axis=1)
    order = np.flatnonzero(kinds)[np.argsort(props.objects[kinds], kind="stable")]
    starts = np.unique(props.objects[order], return_index=True)[1]
    boxes = []
    for own in np.split(order, starts[1:]) if len(order) else []:
        points = props.vertices[props.triangles[own].ravel()].astype(np.float64)
        if (points[:, 2] - land.ground.at(points[:, :2])).max() > _STANDS_M:
            boxes.append((np.r_[points[:, :2].min(axis=0), points[:, :2].max(axis=0)]).tolist())
    return [(np.array(each) + np.tile(props.origin[:2], 2)).tolist() for each in boxes]


def _add_prism(builder: MeshBuilder, spot: Spot, local: Floats, ridge: Floats, tint: Floats) -> None:
    """Adds a body over a local rectangle, (4, 2), its top corners at ``ridge``, (4, 3), above the ground."""
    foot = spot.places(local)
    level = spot.ground.at(foot)
    low = np.column_stack([foot, level - 0.2])
    high = np.column_stack([spot.places(ridge[:, :2]), level.mean() + ridge[:, 2]])
    builder.add(SurfaceClass.CLUTTER, np.concatenate([low, high]), objects.BLOCK_FACES, tint)


def _rectangle(length: float, width: float, y: float) -> Floats:
    """Returns a rectangle around a place beside the middle, (4, 2), counter-clockwise."""
    corners = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
    return np.asarray(corners * (length, width) + (0.0, y))


def _containers(builder: MeshBuilder, spot: Spot, chances: np.random.Generator) -> None:
    """Adds a row of freight containers, some of them stacked."""
    length = float(chances.choice([6.06, 12.19]))
    count = int(chances.integers(1, 6))
    for k in range(count):
        ring = _rectangle(length, 2.44, y=2.7 * (k - 0.5 * (count - 1)))
        top = np.column_stack([ring, np.full(4, 2.6 * float(chances.integers(1, 3)))])
        _add_prism(builder, spot, ring, top, pick(_BOXES, chances, *_SHADES))


def _tents(builder: MeshBuilder, spot: Spot, chances: np.random.Generator) -> None:
    """Adds one to three tents with a ridge."""
    length, width = chances.uniform((4.0, 3.0), (12.0, 6.0)).tolist()
    canvas = pick(_CANVAS, chances, *_SHADES)
    for k in range(int(chances.integers(1, 4))):
        ring = _rectangle(length, width, y=(width + 0.6) * (k - 1))
        ridge = ring * (1.0, 0.04) + (0.0, 0.96 * (width + 0.6) * (k - 1))
        eave = np.column_stack([ring, np.full(4, 2.0)])
        _add_prism(builder, spot, ring, eave, canvas)
        _add_prism(builder, spot, ring, np.column_stack([ridge, np.full(4, 2.0 + 0.35 * width)]), canvas)


def _heap(builder: MeshBuilder, spot: Spot, chances: np.random.Generator) -> None:
    """Adds a heap of sand, gravel or earth."""
    radius = float(chances.uniform(2.0, 6.0))
    spin = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    rim = np.stack([np.cos(spin), np.sin(spin)], axis=1) * radius * chances.uniform(0.8, 1.2, (14, 1))
    rings = [np.column_stack([spot.places(rim * share), np.full(14, up)]) for share, up in _SLOPE]
    points = np.concatenate([*rings, [[*spot.middle, radius * 0.55]]])
    points[:, 2] = points[:, 2] * radius / 6.0 + spot.ground.at(points)
    points[:14, 2] -= 0.3
    k = 28 + np.arange(14)
    tip = np.stack([k, np.roll(k, -1), np.full(14, 42)], axis=1)
    triangles = np.concatenate([objects.ring_walls(14, 3), tip])
    builder.add(SurfaceClass.GROUND, points, triangles, pick(_HEAPS, chances, *_SHADES))


def _patch(
    builder: MeshBuilder,
    spot: Spot,
    size: tuple[float, float],
    surface: SurfaceClass,
    tint: Tint,
    at: tuple[float, float] = (0.0, 0.0),
    above_m: float = _ABOVE_M,
) -> None:
    """Adds a rectangle of another surface, draped over the ground."""
    steps = [np.linspace(-0.5, 0.5, max(2, int(side / _MESH_M) + 1)) * side for side in size]
    x, y = np.meshgrid(*steps)
    places = spot.places(np.stack([x.ravel(), y.ravel()], axis=1) + at)
    builder.add(surface, spot.ground.on_ground(places, above_m), objects.grid_triangles(*x.shape), tint)


def _yard(builder: MeshBuilder, spot: Spot, chances: np.random.Generator) -> None:
    """Adds a yard of concrete, gravel or sand."""
    length, width = chances.uniform((12.0, 8.0), (26.0, 18.0)).tolist()
    surface = SurfaceClass.PAVEMENT if chances.random() < 0.6 else SurfaceClass.GROUND
    _patch(builder, spot, (length, width), surface, pick(_YARDS, chances, *_SHADES))


def _court(builder: MeshBuilder, spot: Spot, chances: np.random.Generator) -> None:
    """Adds a sports court with its lines."""
    _patch(builder, spot, (30.0, 16.0), SurfaceClass.PAVEMENT, pick(_COURTS, chances, *_SHADES))
    for y in (-6.0, 6.0):
        _patch(builder, spot, (26.0, 0.2), SurfaceClass.MARKING, _WHITE, (0.0, y), _ABOVE_M + 0.04)
    for x in (-13.0, 0.0, 13.0):
        _patch(builder, spot, (0.2, 12.0), SurfaceClass.MARKING, _WHITE, (x, 0.0), _ABOVE_M + 0.04)


def _track(builder: MeshBuilder, spot: Spot, chances: np.random.Generator) -> None:
    """Adds a straight running track with four lanes."""
    _patch(builder, spot, (50.0, 6.0), SurfaceClass.PAVEMENT, pick(_COURTS[:1], chances, *_SHADES))
    for y in (-2.5, -1.25, 0.0, 1.25, 2.5):
        _patch(builder, spot, (50.0, 0.12), SurfaceClass.MARKING, _WHITE, (0.0, y), _ABOVE_M + 0.04)


def _car_park(builder: MeshBuilder, spot: Spot, chances: np.random.Generator) -> None:
    """Adds two rows of parked cars, most stalls taken, on asphalt or gravel."""
    surface = SurfaceClass.ROAD if chances.random() < 0.7 else SurfaceClass.GROUND
    _patch(builder, spot, (32.0, 17.0), surface, pick(_YARDS[3:], chances, *_SHADES))
    stalls = np.array([(x, y) for y in (-5.5, 5.5) for x in np.arange(-14.0, 14.1, 2.7)])
    taken = stalls[chances.random(len(stalls)) < 0.75]
    places = spot.places(taken)
    ways = np.sign(taken[:, 1:]) * np.array([-spot.along[1], spot.along[0]])
    objects.add_cars(builder, spot.ground.on_ground(places, _ABOVE_M), ways, 0 * places[:, 0], chances)


# What adds it, and how far from buildings and carriageways its middle is.
CLUTTER: dict[str, tuple[Callable[[MeshBuilder, Spot, np.random.Generator], None], float]] = {
    "containers": (_containers, 10.0),
    "tents": (_tents, 12.0),
    "heap": (_heap, 8.0),
    "yard": (_yard, 16.0),
    "court": (_court, 18.0),
    "track": (_track, 26.0),
    "car_park": (_car_park, 19.0),
}


_TREE_SPACING_M, _MAX_TREES = 6.0, 9000
_CAR_SPACING_M, _MAX_CARS = 7.0, 3000
_BROADLEAF = 0.85
_TREE_GAP_M, _CAR_GAP_M = 2.2, 2.0  # from buildings
# Share of places taken by a tree, by what covers the ground.
_TREE_CHANCE = {
    SurfaceClass.GRASS: 0.42,
    SurfaceClass.GROUND: 0.15,
    SurfaceClass.PAVEMENT: 0.12,
    SurfaceClass.FIELD: 0.015,
}


def make_surroundings(scene: Scene, seed: int, terrain: str | None = None) -> tuple[objects.SceneProps, Land]:
    """Returns ground, roads, trees and cars that fit a city, in its frame; the same for a seed everywhere.

    Ground heights are those of a ``terrain`` raster, or of the buildings' bases.

    Raises:
        LodbenchError: The raster cannot be read, or covers no part of the city.
    """
    view = look_down(scene)
    ground = ground_from_raster(view, scene, terrain) if terrain else ground_from_bases(view)
    land = Land(view, ground, draw_land_cover(view, random_stream(seed, "training", "land")))
    builder = MeshBuilder(scene.num_buildings)
    # Black, as what has no colour of its own: the cover decides, place by place.
    builder.add(np.full(1, LAND_COVER), *ground.mesh(), (0, 0, 0))
    _plant_trees(builder, land, random_stream(seed, "training", "trees"))
    _park_cars(builder, land, random_stream(seed, "training", "cars"))
    add_clutter(builder, land, random_stream(seed, "training", "clutter"))
    return builder.build(scene.origin), land


def _plant_trees(builder: MeshBuilder, land: Land, generator: np.random.Generator) -> None:
    """Adds trees in gardens, along streets and in copses; none on a building or a carriageway."""
    places = land.view.jittered(_TREE_SPACING_M, generator)
    cover, road_m, free_m = land.at(places)
    chance = np.zeros(len(places))
    for kind, share in _TREE_CHANCE.items():
        chance[cover == kind] = share
    copse = _patches(places, generator)
    chance = np.where(copse > 0.45, 2.0 * chance + 0.25 * (chance > 0), chance * (0.4 + copse))
    verge_m = land.cover.half_road_m + land.cover.pavement_m
    chance[(road_m > verge_m) & (road_m < verge_m + 2.5)] += 0.18
    chance[(road_m < verge_m + 0.4) | (cover == SurfaceClass.WATER) | (free_m < _TREE_GAP_M)] = 0.0
    kept = np.flatnonzero(generator.random(len(places)) < chance)
    kept = kept[generator.permutation(len(kept))[:_MAX_TREES]]
    # A crown may touch a wall.
    room_m = free_m[kept].astype(np.float64) + 0.4
    objects.add_trees(builder, land.ground.on_ground(places[kept]), generator, _BROADLEAF, room_m)


def _park_cars(builder: MeshBuilder, land: Land, generator: np.random.Generator) -> None:
    """Adds cars on the carriageways, most of them at the kerb."""
    places = land.view.jittered(_CAR_SPACING_M, generator)
    cover, road_m, free_m = land.at(places)
    half_m = land.cover.half_road_m
    chosen = (road_m < half_m) & (free_m > _CAR_GAP_M) & (cover != SurfaceClass.FIELD)
    chosen &= generator.random(len(places)) < 0.45
    places, away = places[chosen][:_MAX_CARS], road_m[chosen][:_MAX_CARS]
    turn = land.cover.road_rad[land.view.cells_of(places)].astype(np.float64)
    # Aside, onto the kerb or a lane: the way there is across the road, away from its middle.
    across = np.stack([-np.sin(turn), np.cos(turn)], axis=1)
    wanted = np.where(generator.random(len(away)) < 0.75, half_m - 1.05, 0.5 * half_m)
    _, aside_m, _ = land.at(places + across * 0.8)
    outward = np.where(aside_m > away, 1.0, -1.0)
    places = places + across * (outward * (wanted - away))[:, None]
    ways = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    rise = land.ground.at(places + 2.0 * ways) - land.ground.at(places - 2.0 * ways)
    objects.add_cars(builder, land.ground.on_ground(places), ways, rise / 4.0, generator)


def _patches(places: Points, generator: np.random.Generator) -> Points:
    """Returns a sum of waves in [-1, 1] at places: trees stand in groups."""
    total = np.zeros(len(places))
    for length_m in (130.0, 61.0, 37.0):
        turn, phase = generator.uniform(0.0, 2 * np.pi, size=2)
        total += np.sin((places @ [np.cos(turn), np.sin(turn)]) * (2 * np.pi / length_m) + phase)
    return total / 3.0
