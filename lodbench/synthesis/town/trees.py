"""The shapes of trees: trunks, round crowns and cones, no two alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.props import SurfaceClass
from lodbench.synthesis.town.ground import on_ground
from lodbench.synthesis.town.pile import PropPile
from lodbench.synthesis.town.town import Town

Points = NDArray[np.float64]

_TRUNK = (92.0, 76.0, 60.0)
_LEAVES = np.array([(70, 92, 44), (84, 104, 50), (60, 82, 42), (98, 110, 56), (78, 100, 62)], float)
_NEEDLES = np.array([(48, 70, 46), (56, 78, 52), (42, 62, 44)], float)


def add_trees(
    pile: PropPile, town: Town, places: Points, chances: np.random.Generator, *, is_far: bool
) -> None:
    """Adds trees at places, (N, 2); far ones are of fewer triangles and have no trunk."""
    count = len(places)
    foot = on_ground(town, places, 0.0)
    is_broad = chances.random(count) < town.look.broadleaf
    radius = np.where(is_broad, chances.uniform(1.7, 4.3, count), chances.uniform(1.4, 2.8, count))
    radius = np.minimum(radius, _room(town, places)) if not is_far else radius
    height = (
        np.where(is_broad, chances.uniform(2.2, 3.2, count), chances.uniform(3.6, 5.0, count)) * radius + 1.0
    )
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


def _add_trunks(
    pile: PropPile, foot: Points, radius: Points, height: Points, numbers: NDArray[np.int64]
) -> None:
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
    pile.add(
        SurfaceClass.TRUNK, points.reshape(-1, 3), triangles, np.array(_TRUNK), np.repeat(numbers, len(faces))
    )


def _room(town: Town, places: Points) -> Points:
    """Returns how wide a crown may grow beside buildings, (N,) metres: it may touch a wall."""
    room = np.full(len(places), 2.6)
    for gap in (3.2, 4.0, 5.0):
        room[town.occupancy.is_free_around(places, gap)] = gap
    return room


def _drawn(colours: Points, count: int, chances: np.random.Generator) -> Points:
    return np.asarray(
        colours[chances.integers(len(colours), size=count)] * chances.uniform(0.85, 1.15, (count, 1))
    )


def _repeated(faces: NDArray[np.int64], count: int, size: int) -> NDArray[np.int64]:
    """Returns the triangles of so many copies of a shape of ``size`` points."""
    return (faces[None] + size * np.arange(count)[:, None, None]).reshape(-1, 3)


def _ball(halvings: int) -> tuple[Points, NDArray[np.int64]]:
    """Returns an icosahedron, its edges halved some times, on the unit sphere; triangles look outward."""
    g = (1 + 5**0.5) / 2
    # Three golden rectangles, each across the next.
    signs = np.array([(-1, g), (1, g), (-1, -g), (1, -g)])
    zero = np.zeros(4)
    points = np.concatenate(
        [
            np.column_stack([signs[:, 0], signs[:, 1], zero]),
            np.column_stack([zero, signs[:, 0], signs[:, 1]]),
            np.column_stack([signs[:, 1], zero, signs[:, 0]]),
        ]
    ) / np.hypot(1, g)
    text = (
        "0 11 5 0 5 1 0 1 7 0 7 10 0 10 11 1 5 9 5 11 4 11 10 2 10 7 6 7 1 8 "
        "3 9 4 3 4 2 3 2 6 3 6 8 3 8 9 4 9 5 2 4 11 6 2 10 8 6 7 9 8 1"
    )
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
