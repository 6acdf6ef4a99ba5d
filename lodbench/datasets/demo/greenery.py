"""Trees and hedges of the town: where they grow, and their shapes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.demo.ground import on_ground
from lodbench.datasets.demo.pile import PropPile, along_line, length_of, offset_line
from lodbench.datasets.demo.shapes import area, contains, edge_directions, inset, left_of
from lodbench.datasets.demo.town import Town
from lodbench.rendering.props import SurfaceClass
from lodbench.storage import random_stream

Points = NDArray[np.float64]

# One tree for so many square metres of open land, by district; parks have more.
_LAND_PER_TREE_M2 = {"old town": 420.0, "inner town": 190.0, "garden suburb": 170.0, "estate": 210.0, "works": 520.0}
_PARK_M2 = 75.0
_TRUNK = (92.0, 76.0, 60.0)
_LEAVES = np.array([(70, 92, 44), (84, 104, 50), (60, 82, 42), (98, 110, 56), (78, 100, 62)], float)
_NEEDLES = np.array([(48, 70, 46), (56, 78, 52), (42, 62, 44)], float)
_HEDGE = np.array((66.0, 88.0, 46.0))
_NUM_WOODS = 14


def add_greenery(pile: PropPile, town: Town) -> None:
    """Adds trees in streets, yards and parks, along the river and in woods around, and hedges."""
    chances = random_stream(town.seed, "demo", "trees")
    places = np.concatenate(
        [_along_streets(town, chances), _in_yards(town, chances), _along_river(town, chances)]
    )
    places = places[town.occupancy.is_free_around(places, 2.4)]
    _add_trees(pile, town, places, chances, is_far=False)
    _add_trees(pile, town, _in_woods(town, chances), chances, is_far=True)
    _add_hedges(pile, town, chances)


def _along_streets(town: Town, chances: np.random.Generator) -> Points:
    """Returns places of trees on the pavements of wider streets."""
    places = []
    for street in town.streets.streets:
        likely = 0.75 if street.width_m > 15 else 0.35
        for side in (-1.0, 1.0):
            if street.width_m < 10.5 or chances.random() > likely * town.look.trees:
                continue
            line = offset_line(street.line, side * (0.5 * street.width_m + 1.1))
            spacing = float(chances.uniform(8.0, 14.0))
            at = np.arange(9.0, length_of(line) - 9.0, spacing)
            at = at[chances.random(len(at)) < 0.85]
            places.append(along_line(line, at + chances.normal(0.0, 0.6, len(at)))[0])
    return np.concatenate(places)


def _in_yards(town: Town, chances: np.random.Generator) -> Points:
    """Returns places of trees in gardens, courtyards and parks."""
    places = []
    for number, (block, district) in enumerate(zip(town.streets.blocks, town.districts, strict=True)):
        yard = inset(block.ring, 3.5)
        if number == 0 or yard is None:
            continue
        low, high = yard.min(axis=0), yard.max(axis=0)
        taken = town.occupancy.at(_grid(low, high))
        is_park = len(np.unique(taken)) <= 2 and district == "inner town"
        per_tree = _PARK_M2 if is_park else _LAND_PER_TREE_M2[district]
        count = round(float(np.prod(high - low)) / per_tree * town.look.trees)
        drawn = chances.uniform(low, high, (count, 2))
        places.append(drawn[contains(yard, drawn)])
    return np.concatenate(places)


def _grid(low: Points, high: Points) -> Points:
    x, y = np.meshgrid(np.arange(low[0], high[0], 4.0), np.arange(low[1], high[1], 4.0))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _along_river(town: Town, chances: np.random.Generator) -> Points:
    """Returns places of trees on both banks, in loose rows."""
    line = town.streets.river
    half = 0.5 * length_of(line)
    places = []
    for side in (-1.0, 1.0):
        at = np.cumsum(chances.uniform(5.0, 26.0, 160)) + half - 1200.0
        bank, _ = along_line(offset_line(line, side * 21.0), at)
        places.append(bank + chances.normal(0.0, 1.0, bank.shape))
    return np.concatenate(places)


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


def _add_trees(
    pile: PropPile, town: Town, places: Points, chances: np.random.Generator, *, is_far: bool
) -> None:
    """Adds trees at places, (N, 2); far ones are of fewer triangles and have no trunk."""
    count = len(places)
    foot = on_ground(town, places, 0.0)
    is_broad = chances.random(count) < town.look.broadleaf
    radius = np.where(is_broad, chances.uniform(1.7, 4.3, count), chances.uniform(1.4, 2.8, count))
    radius = np.minimum(radius, _room(town, places)) if not is_far else radius
    height = np.where(is_broad, chances.uniform(2.2, 3.2, count), chances.uniform(3.6, 5.0, count)) * radius + 1.0
    numbers = pile.new_objects(count)
    ball, faces = _ball(0 if is_far else 1)
    crown = ball[None] * (1.0 + chances.normal(0.0, 0.13, (count, len(ball), 1)))
    # A conifer is a cone: the higher, the narrower.
    taper = np.where(is_broad[:, None], 1.0, np.clip(0.62 - 0.6 * ball[None, :, 2], 0.04, 1.0))
    trunk_m = np.where(is_broad, 0.28, 0.1) * height
    half = 0.5 * (height - trunk_m)
    points = crown * np.stack([radius, radius, half], axis=1)[:, None, :]
    points[:, :, :2] *= taper[:, :, None]
    points += foot[:, None, :] + np.stack([0 * half, 0 * half, trunk_m + half], axis=1)[:, None, :]
    leaf = np.where(is_broad[:, None], _drawn(_LEAVES, count, chances), _drawn(_NEEDLES, count, chances))
    shade = chances.normal(1.0, 0.07, (count, len(faces), 1))
    pile.add(
        SurfaceClass.FOLIAGE,
        points.reshape(-1, 3),
        _repeated(faces, count, len(ball)),
        (leaf[:, None, :] * shade).reshape(-1, 3),
        np.repeat(numbers, len(faces)),
    )
    if not is_far:
        _add_trunks(pile, foot, 0.06 * radius + 0.07, trunk_m + 0.4 * half, numbers)


def _add_trunks(pile: PropPile, foot: Points, radius: Points, height: Points, numbers: NDArray[np.int64]) -> None:
    spin = np.arange(5) * 2 * np.pi / 5
    post = np.concatenate(
        [np.stack([np.cos(spin), np.sin(spin), np.full(5, z)], axis=1) for z in (-0.3, 1.0)]
    )
    k = np.arange(5)
    ahead = (k + 1) % 5
    faces = np.concatenate([np.stack([k, ahead, ahead + 5], 1), np.stack([k, ahead + 5, k + 5], 1)])
    points = post[None] * np.stack([radius, radius, height], axis=1)[:, None, :] + foot[:, None, :]
    count = len(foot)
    triangles = _repeated(faces, count, len(post))
    pile.add(SurfaceClass.TRUNK, points.reshape(-1, 3), triangles, np.array(_TRUNK), np.repeat(numbers, len(faces)))


def _room(town: Town, places: Points) -> Points:
    """Returns how wide a crown may grow beside buildings, (N,) metres: it may touch a wall."""
    room = np.full(len(places), 2.6)
    for gap in (3.2, 4.0, 5.0):
        room[town.occupancy.is_free_around(places, gap)] = gap
    return room


def _drawn(colours: Points, count: int, chances: np.random.Generator) -> Points:
    return np.asarray(colours[chances.integers(len(colours), size=count)] * chances.uniform(0.85, 1.15, (count, 1)))


def _repeated(faces: NDArray[np.int64], count: int, size: int) -> NDArray[np.int64]:
    """Returns the triangles of so many copies of a shape of ``size`` points."""
    return (faces[None] + size * np.arange(count)[:, None, None]).reshape(-1, 3)


def _ball(halvings: int) -> tuple[Points, NDArray[np.int64]]:
    """Returns an icosahedron, its edges halved some times, on the unit sphere; triangles look outward."""
    g = (1 + 5**0.5) / 2
    points = np.array(
        [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g)]
        + [(0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]
    ) / np.hypot(1, g)  # fmt: skip
    text = "0 11 5 0 5 1 0 1 7 0 7 10 0 10 11 1 5 9 5 11 4 11 10 2 10 7 6 7 1 8 3 9 4 3 4 2 3 2 6 3 6 8 3 8 9 4 9 5 2 4 11 6 2 10 8 6 7 9 8 1"
    faces = np.array(text.split(), np.int64).reshape(-1, 3)
    for _ in range(halvings):
        index: dict[tuple[int, int], int] = {}
        grown, parts = list(points), []
        for a, b, c in faces.tolist():
            middles = []
            for pair in ((a, b), (b, c), (c, a)):
                key = (min(pair), max(pair))
                if key not in index:
                    index[key] = len(grown)
                    middle = points[pair[0]] + points[pair[1]]
                    grown.append(middle / np.linalg.norm(middle))
                middles.append(index[key])
            ab, bc, ca = middles
            parts += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        points, faces = np.array(grown), np.array(parts, np.int64)
    return points, faces


def _add_hedges(pile: PropPile, town: Town, chances: np.random.Generator) -> None:
    """Adds hedges along the front gardens of the suburbs, with gaps for gates."""
    for block, district in zip(town.streets.blocks, town.districts, strict=True):
        ring = inset(block.ring, 2.9)
        if district not in ("garden suburb", "inner town") or ring is None or area(ring) < 900.0:
            continue
        for start, along, ahead in zip(ring, edge_directions(ring), np.roll(ring, -1, axis=0), strict=True):
            length, at = float(np.linalg.norm(ahead - start)), 1.0
            while at < length - 4.0:
                run = min(float(chances.uniform(4.0, 15.0)), length - at - 1.0)
                if chances.random() < 0.6:
                    _add_hedge(pile, town, start + along * at, along * run, chances)
                at += run + float(chances.uniform(2.0, 4.5))


def _add_hedge(
    pile: PropPile, town: Town, start: Points, way: Points, chances: np.random.Generator
) -> None:
    side = left_of(way / np.linalg.norm(way)) * 0.3
    ring = np.stack([start - side, start + way - side, start + way + side, start + side])
    if (town.occupancy.at(ring) > 0).any():
        return
    low = on_ground(town, ring, 0.0)
    high = low + (0.0, 0.0, float(chances.uniform(0.9, 1.7)))
    k = np.arange(4)
    ahead = (k + 1) % 4
    faces = np.concatenate(
        [np.stack([k, ahead, ahead + 4], 1), np.stack([k, ahead + 4, k + 4], 1), [[4, 5, 6], [4, 6, 7]]]
    )
    pile.add(SurfaceClass.FENCE, np.concatenate([low, high]), faces, _HEDGE * float(chances.uniform(0.8, 1.2)))
