"""Trees and parked cars for a city that has none: where they stand, and their shapes."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.photo import Land
from lodbench.synthesis.props import SurfaceClass
from lodbench.synthesis.surroundings.land import Plan
from lodbench.synthesis.surroundings.terrain_mesh import Ground

Floats = NDArray[np.float64]

_TREE_SPACING_M, _MAX_TREES = 6.0, 9000
_CAR_SPACING_M, _MAX_CARS = 7.0, 3000
# Share of places taken by a tree, by what covers the ground.
_TREE_CHANCE = {SurfaceClass.GRASS: 0.42, SurfaceClass.GROUND: 0.15, SurfaceClass.PAVEMENT: 0.12}
_LEAF_TINTS = [
    (44, 62, 30),
    (52, 70, 34),
    (60, 72, 36),
    (40, 54, 32),
    (66, 76, 40),
    (50, 60, 26),
    (84, 78, 40),
]
_TRUNK_TINT = (74, 62, 50)


class Shapes(NamedTuple):
    """Triangles of many objects: corners (T, 3, 3), ``SurfaceClass`` (T,), object (T,), tint (T, 3)."""

    corners: Floats
    surface: NDArray[np.uint8]
    number: NDArray[np.int32]
    tint: NDArray[np.uint8]


def plant_trees(plan: Plan, land: Land, ground: Ground, generator: np.random.Generator) -> Shapes:
    """Returns trees in gardens, along streets and in copses; none on a building or a carriageway."""
    places = _jittered(plan, _TREE_SPACING_M, generator)
    row, column, _ = plan.cells_of(places)
    away = np.sqrt(land.road_m2[row, column])
    chance = np.zeros(len(places))
    for kind, share in _TREE_CHANCE.items():
        chance[land.classes[row, column] == kind] = share
    copse = _patches(places, generator)
    chance[land.classes[row, column] == SurfaceClass.FIELD] = 0.015
    chance = np.where(
        copse > 0.45, np.maximum(2.0 * chance, 0.0) + 0.25 * (chance > 0), chance * (0.4 + copse)
    )
    verge = land.half_road_m + land.pavement_m
    chance[(away > verge) & (away < verge + 2.5)] += 0.18
    chance[away < verge + 0.4] = 0.0
    chance[land.classes[row, column] == SurfaceClass.WATER] = 0.0
    chance[_near_building(plan, row, column, 2.2)] = 0.0
    kept = places[generator.random(len(places)) < chance]
    kept = kept[generator.permutation(len(kept))[:_MAX_TREES]]
    feet = np.column_stack([kept, ground.at(kept)])
    return _trees(feet, generator)


def park_cars(plan: Plan, land: Land, ground: Ground, generator: np.random.Generator) -> Shapes:
    """Returns cars on the carriageways, most of them at the kerb."""
    places = _jittered(plan, _CAR_SPACING_M, generator)
    row, column, _ = plan.cells_of(places)
    away, turn = np.sqrt(land.road_m2[row, column]), land.road_rad[row, column].astype(np.float64)
    on_road = (away < land.half_road_m) & ~_near_building(plan, row, column, 2.0)
    chosen = on_road & (generator.random(len(places)) < 0.45)
    chosen &= land.classes[row, column] != SurfaceClass.FIELD
    places, away, turn = places[chosen][:_MAX_CARS], away[chosen][:_MAX_CARS], turn[chosen][:_MAX_CARS]
    # Aside, onto the kerb or a lane: the way there is across the road, away from its middle.
    across = np.stack([-np.sin(turn), np.cos(turn)], axis=1)
    wanted = np.where(generator.random(len(away)) < 0.75, land.half_road_m - 1.05, 0.5 * land.half_road_m)
    there, _, _ = plan.cells_of(places + across * 0.8)
    _, there_column, _ = plan.cells_of(places + across * 0.8)
    outward = np.where(np.sqrt(land.road_m2[there, there_column]) > away, 1.0, -1.0)
    places = places + across * (outward * (wanted - away))[:, None]
    feet = np.column_stack([places, ground.at(places)])
    return _cars(feet, turn, generator)


def _jittered(plan: Plan, spacing_m: float, generator: np.random.Generator) -> Floats:
    """Returns places all over a plan, about a spacing apart, (N, 2)."""
    rows, columns = plan.tops_m.shape
    x = np.arange(plan.west + 0.5 * spacing_m, plan.west + columns * plan.cell_m, spacing_m)
    y = np.arange(plan.south + 0.5 * spacing_m, plan.south + rows * plan.cell_m, spacing_m)
    grid = np.stack([axis.ravel() for axis in np.meshgrid(x, y)], axis=1)
    return np.asarray(grid + generator.uniform(-0.45, 0.45, size=grid.shape) * spacing_m)


def _patches(places: Floats, generator: np.random.Generator) -> Floats:
    """Returns a sum of waves in [-1, 1] at places: trees stand in groups."""
    total = np.zeros(len(places))
    for length_m in (130.0, 61.0, 37.0):
        turn, phase = generator.uniform(0.0, 2 * np.pi, size=2)
        total += np.sin((places @ [np.cos(turn), np.sin(turn)]) * (2 * np.pi / length_m) + phase)
    return total / 3.0


def _near_building(
    plan: Plan, row: NDArray[np.int64], column: NDArray[np.int64], reach_m: float
) -> NDArray[np.bool_]:
    import cv2

    side = 2 * int(reach_m / plan.cell_m) + 1
    wide = cv2.dilate(plan.is_built.astype(np.uint8), np.ones((side, side), np.uint8))
    return np.asarray(wide[row, column] > 0)


def _trees(feet: Floats, generator: np.random.Generator) -> Shapes:
    count = len(feet)
    directions, faces = _sphere()
    height = generator.uniform(4.0, 13.0, size=count) * generator.uniform(0.7, 1.2, size=count)
    radius = height * generator.uniform(0.22, 0.4, size=count)
    is_conifer = generator.random(count) < 0.15
    bumps = generator.uniform(0.72, 1.15, size=(count, len(directions)))
    crown = directions[None] * (bumps * radius[:, None])[:, :, None]
    tall = np.where(is_conifer, 0.48 * height / radius, 0.36 * height / radius)
    crown[:, :, 2] *= tall[:, None]
    # A conifer is narrow at the top.
    up = directions[:, 2]
    crown[:, :, :2] *= np.where(is_conifer[:, None], np.clip(0.75 - 0.6 * up, 0.1, 1.2)[None], 1.0)[
        :, :, None
    ]
    crown[:, :, 2] += np.where(is_conifer, 0.52, 0.62)[:, None] * height[:, None]
    leaves = (feet[:, None] + crown)[:, faces].reshape(-1, 3, 3)
    trunks = _boxes(feet, np.stack([0.04 * height, 0.04 * height, 0.45 * height], axis=1), np.zeros(count))
    tints = np.array(_LEAF_TINTS, dtype=np.uint8)[generator.integers(len(_LEAF_TINTS), size=count)]
    per_crown, per_trunk = len(faces), len(trunks) // max(count, 1)
    return Shapes(
        np.concatenate([leaves, trunks]),
        np.repeat([SurfaceClass.FOLIAGE, SurfaceClass.TRUNK], [len(leaves), len(trunks)]).astype(np.uint8),
        np.concatenate([np.repeat(np.arange(count), per) for per in (per_crown, per_trunk)]).astype(np.int32),
        np.concatenate([np.repeat(tints, per_crown, axis=0), np.full((len(trunks), 3), _TRUNK_TINT)]).astype(
            np.uint8
        ),
    )


def _cars(feet: Floats, turn: Floats, generator: np.random.Generator) -> Shapes:
    """Returns a body and a smaller, glazed cabin for each car."""
    count = len(feet)
    length = generator.uniform(3.7, 4.8, size=count)
    width = generator.uniform(1.7, 1.9, size=count)
    lift = np.zeros((count, 3))
    lift[:, 2] = 0.3
    body = _boxes(feet + lift, np.stack([length, width, np.full(count, 0.65)], axis=1), turn)
    lift[:, 2] = 0.95
    cabin = _boxes(
        feet + lift, np.stack([0.52 * length, 0.86 * width, np.full(count, 0.5)], axis=1), turn, 0.8
    )
    per = len(body) // max(count, 1)
    corners = np.concatenate([body, cabin])
    surface = np.repeat([SurfaceClass.CAR_BODY, SurfaceClass.CAR_GLASS], [len(body), len(cabin)])
    # The cabin's top, the last two of its triangles, is painted.
    surface[len(body) :].reshape(-1, per or 1)[:, -2:] = SurfaceClass.CAR_BODY
    number = np.tile(np.repeat(np.arange(count), per), 2).astype(np.int32)
    return Shapes(corners, surface.astype(np.uint8), number, np.zeros((len(corners), 3), dtype=np.uint8))


def _boxes(feet: Floats, sizes: Floats, turn: Floats, taper: float = 1.0) -> Floats:
    """Returns (12 N, 3, 3) corners of boxes without floors: walls, then tops; (10 N, 3, 3) in fact.

    Args:
        feet: (N, 3) middle of each floor.
        sizes: (N, 3) along, across, up.
        turn: (N,) direction of along, radians from east.
        taper: Size of the top against the floor.
    """
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], dtype=np.float64) * 0.5
    c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
    rings = []
    for scale, up in ((1.0, 0.0), (taper, 1.0)):
        along, across = signs[None, :, 0] * sizes[:, :1] * scale, signs[None, :, 1] * sizes[:, 1:2] * scale
        ring = np.stack(
            [along * c - across * s, along * s + across * c, up * sizes[:, 2:] + 0 * along], axis=2
        )
        rings.append(ring + feet[:, None])
    points = np.concatenate(rings, axis=1)
    walls = [(i, (i + 1) % 4, 4 + (i + 1) % 4, 4 + i) for i in range(4)]
    faces = [t for a, b, d, e in [*walls, (4, 5, 6, 7)] for t in ((a, b, d), (a, d, e))]
    return np.asarray(points[:, np.array(faces)].reshape(-1, 3, 3))


def _sphere() -> tuple[Floats, NDArray[np.int64]]:
    """Returns the 42 points and 80 triangles of an icosahedron cut once."""
    golden = (1 + 5**0.5) / 2
    ring = np.array([(0.0, a, b * golden) for a in (-1, 1) for b in (-1, 1)]) / np.hypot(1, golden)
    corners = np.concatenate([np.roll(ring, k, axis=1) for k in range(3)])
    gaps = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    near = (gaps > 0.1) & (gaps < 1.1)
    faces = [face for face in combinations(range(12), 3) if all(near[a, b] for a, b in combinations(face, 2))]
    vertices = list(corners)
    number: dict[tuple[int, int], int] = {}
    for face in faces:
        for edge in combinations(face, 2):
            if edge not in number:
                number[edge] = len(vertices)
                middle = vertices[edge[0]] + vertices[edge[1]]
                vertices.append(middle / np.linalg.norm(middle))
    cut = []
    for a, b, c in faces:
        ab, bc, ac = number[a, b], number[b, c], number[a, c]
        cut += [(a, ab, ac), (b, bc, ab), (c, ac, bc), (ab, bc, ac)]
    return np.array(vertices), np.array(cut)
