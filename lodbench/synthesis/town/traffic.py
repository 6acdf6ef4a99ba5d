"""Cars: parked along the kerbs and on their way."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.storage import random_stream
from lodbench.synthesis.props import SurfaceClass
from lodbench.synthesis.town.ground import on_ground
from lodbench.synthesis.town.pile import PropPile, along_line, length_of, offset_line
from lodbench.synthesis.town.shapes import left_of
from lodbench.synthesis.town.town import Town

Points = NDArray[np.float64]

_PAINTS = np.array(
    [
        (232, 232, 232),
        (60, 62, 66),
        (150, 152, 156),
        (34, 36, 40),
        (150, 40, 36),
        (46, 70, 118),
        (196, 190, 178),
    ],
    float,
)
_GLASS = (52.0, 60.0, 68.0)


def add_cars(pile: PropPile, town: Town) -> None:
    """Adds cars to all streets wide enough for them."""
    chances = random_stream(town.seed, "demo", "cars")
    places: list[Points] = []
    ways: list[Points] = []
    for street in town.streets.streets:
        width = street.width_m
        kerb = 0.5 * width - 1.2
        for side in (-1.0, 1.0):
            # Right-hand traffic: to the right of the line cars go along it.
            if width > 9.5:
                parked = np.cumsum(chances.uniform(5.6, 7.6, 200)) + 7.0
                parked = parked[(parked < length_of(street.line) - 9.0) & (chances.random(200) < 0.4)]
                _park(offset_line(street.line, side * kerb), parked, -side, places, ways)
            if width > 12.0:
                moving = np.cumsum(chances.uniform(25.0, 120.0, 40)) + 4.0
                moving = moving[moving < length_of(street.line) - 6.0]
                _park(offset_line(street.line, side * 0.2 * width), moving, -side, places, ways)
    _add(pile, town, np.concatenate(places), np.concatenate(ways), chances)


def _park(line: Points, at: Points, sign: float, places: list[Points], ways: list[Points]) -> None:
    middle, along = along_line(line, at)
    places.append(middle)
    ways.append(sign * along)


def _add(pile: PropPile, town: Town, places: Points, ways: Points, chances: np.random.Generator) -> None:
    """Adds cars at places, (N, 2), that point along unit ways, (N, 2)."""
    count = len(places)
    size = np.stack(
        [
            chances.uniform(3.8, 4.9, count),
            chances.uniform(1.7, 1.9, count),
            chances.uniform(1.4, 1.75, count),
        ],
        1,
    )
    foot = on_ground(town, places, 0.0)
    shape, faces, is_glass = _shape()
    local = shape[None] * size[:, None, :]
    points = np.empty_like(local)
    points[:, :, :2] = (
        foot[:, None, :2] + local[:, :, :1] * ways[:, None, :] + local[:, :, 1:2] * left_of(ways)[:, None, :]
    )
    # A car stands on the slope of its street.
    ahead = town.terrain.height(places + 2.0 * ways) - town.terrain.height(places - 2.0 * ways)
    points[:, :, 2] = foot[:, None, 2] + local[:, :, 2] + local[:, :, 0] * (ahead / 4.0)[:, None]
    paint = _PAINTS[chances.integers(len(_PAINTS), size=count)] * chances.uniform(0.85, 1.1, (count, 1))
    tint = np.where(is_glass[None, :, None], np.array(_GLASS), paint[:, None, :])
    surface = np.where(is_glass, SurfaceClass.CAR_GLASS, SurfaceClass.CAR_BODY).astype(np.uint8)
    pile.add(
        np.tile(surface, count),
        points.reshape(-1, 3),
        (faces[None] + len(shape) * np.arange(count)[:, None, None]).reshape(-1, 3),
        tint.reshape(-1, 3),
        np.repeat(pile.new_objects(count), len(faces)),
    )


def _shape() -> tuple[Points, NDArray[np.int64], NDArray[np.bool_]]:
    """Returns a car of unit size, its triangles, and which are glass: a hull, and a cabin with a roof."""
    layers = [
        (-0.5, 0.5, 0.5, 0.14),
        (-0.5, 0.5, 0.5, 0.55),
        (-0.42, 0.24, 0.46, 0.60),
        (-0.30, 0.10, 0.38, 1.0),
    ]
    points = np.array(
        [
            corner
            for back, front, half, z in layers
            for corner in ((back, -half, z), (front, -half, z), (front, half, z), (back, half, z))
        ]
    )
    faces, glass = [], []
    for layer in range(3):
        for k in range(4):
            a, b = 4 * layer + k, 4 * layer + (k + 1) % 4
            faces += [(a, b, b + 4), (a, b + 4, a + 4)]
            glass += [layer == 2] * 2
    faces += [(12, 13, 14), (12, 14, 15)]
    return points, np.array(faces, np.int64), np.array([*glass, False, False])
