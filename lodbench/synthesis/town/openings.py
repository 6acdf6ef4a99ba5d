"""Windows and doors: what level of detail 3 cuts into walls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.town.extrusion import Body
from lodbench.synthesis.town.fittings import STOREY_M, chance
from lodbench.synthesis.town.occupancy import NOBODY, Occupancy
from lodbench.synthesis.town.shapes import left_of
from lodbench.synthesis.town.terrain import Terrain

Points = NDArray[np.float64]

# Openings keep this far from corners, eaves and the ground.
_MARGIN_M = 0.45
_ABOVE_GROUND_M = 0.35
_STEP_M = 0.12
_DOOR_M = (1.15, 2.15)
_GATE_M = (2.5, 2.1)
# A place this far before a wall tells whether somebody stands against it.
_LOOK_OUT_M = 0.9


@dataclass(frozen=True, slots=True)
class WindowStyle:
    """The windows of one building, metres.

    Attributes:
        width: Of a window.
        height: Of a window.
        sill: Above the floor.
        spacing: From window to window.
        storey: From floor to floor.
    """

    width: float
    height: float
    sill: float
    spacing: float
    storey: float


@dataclass(frozen=True, slots=True)
class Wall:
    """A wall as seen from outside.

    Attributes:
        face: Its number in the builder.
        left: (2,) its lower left corner.
        along: (2,) unit direction to the right.
        length: Metres.
        top: Height up to which it is a rectangle.
    """

    face: int
    left: Points
    along: Points
    length: float
    top: float


@dataclass(frozen=True, slots=True)
class Neighbourhood:
    """What decides where a building can have windows.

    Attributes:
        number: The building's in ``occupancy``.
        occupancy: Who stands where.
        terrain: The ground.
        annex_m: Height up to which its own annexes stand before its walls.
    """

    number: int
    occupancy: Occupancy
    terrain: Terrain
    annex_m: float


def window_style(function: str, generator: np.random.Generator) -> WindowStyle | None:
    """Returns what windows a building of a function has; None for one with a gate only."""
    draw = generator.random(4)
    if function == "garage":
        return None
    if function == "church":
        return WindowStyle(1.3, 5.0, 2.5, 4.5, 100.0)
    if function == "industrial":
        return WindowStyle(2.6 + 2.0 * draw[0], 1.2, 3.0, 6.0 + 1.5 * draw[1], 100.0)
    if function in ("commercial", "public"):
        return WindowStyle(1.4 + 0.7 * draw[0], 1.6 + 0.3 * draw[1], 0.8, 2.9 + draw[2], STOREY_M)
    width = 0.95 + 0.55 * draw[0]
    return WindowStyle(width, 1.25 + 0.35 * draw[1], 0.9, width + 1.3 + 1.2 * draw[2], STOREY_M)


def walls_of(body: Body) -> list[Wall]:
    """Returns the outer walls of a body, longest kind first: sides, then ends."""
    walls = []
    for (side, k), face in body.walls.items():
        left, right = (body.builder.position(p)[:2] for p in body.wall_line(side, k))
        length = float(np.linalg.norm(right - left))
        if length > 0.1:
            walls.append(Wall(face, left, (right - left) / length, length, body.wall_top_m(side)))
    return walls


def add_openings(
    body: Body, function: str, place: Neighbourhood, generator: np.random.Generator
) -> list[Points]:
    """Cuts windows, a door or a gate, and dormer windows into a body.

    Returns:
        (4, 3) corners of each window, lower left first, counter-clockwise seen from outside.
    """
    style = window_style(function, generator)
    walls = walls_of(body)
    is_done = False
    windows: list[Points] = []
    for wall in walls:
        if not is_done:
            size = _GATE_M if style is None else _DOOR_M
            where = _door_place(wall, size, place, body.base_m)
            is_done = where is not None
            if where is not None:
                _cut(body, wall, where, size, is_door=True)
        else:
            where = None
        if style is not None:
            windows += _add_windows(body, wall, style, place, where)
    for front in body.dormers:
        _add_dormer_window(body, front)
    return windows


def _add_windows(
    body: Body, wall: Wall, style: WindowStyle, place: Neighbourhood, door: tuple[float, float] | None
) -> list[Points]:
    """Cuts rows of windows into one wall; returns their corners."""
    count = int((wall.length - 2 * _MARGIN_M - style.width) / style.spacing) + 1
    if wall.length < 2 * _MARGIN_M + style.width:
        return []
    first = 0.5 * (wall.length - (count - 1) * style.spacing)
    middles = np.asarray(first + style.spacing * np.arange(count), dtype=np.float64)
    ground, annexed, walled = _outside(wall, middles, style.width, place)
    cut = []
    for storey in range(max(1, int((wall.top - body.base_m - 0.4) / style.storey))):
        low = body.base_m + 0.3 + storey * style.storey + style.sill
        if low + style.height > wall.top - 0.3:
            continue
        for u, ground_m, is_annexed, is_walled in zip(middles.tolist(), ground, annexed, walled, strict=True):
            is_buried = low < ground_m + _ABOVE_GROUND_M
            is_behind_annex = is_annexed and low < body.base_m + place.annex_m + 0.3
            if not (is_walled or is_buried or is_behind_annex or _meets(door, u, low, style.width)):
                cut.append(_cut(body, wall, (u, low), (style.width, style.height)))
    return cut


def _meets(door: tuple[float, float] | None, u: float, low: float, width: float) -> bool:
    """Returns whether a window at a place on a wall would touch the door in it."""
    if door is None:
        return False
    return abs(u - door[0]) < 0.5 * (width + _DOOR_M[0]) + 0.2 and low < door[1] + _DOOR_M[1] + 0.3


def _outside(
    wall: Wall, middles: Points, width: float, place: Neighbourhood
) -> tuple[list[float], list[bool], list[bool]]:
    """Returns what is before each place on a wall: ground height, an own annex, another building."""
    out = -left_of(wall.along)
    own, other = np.zeros(len(middles), bool), np.zeros(len(middles), bool)
    for side in (-0.5, 0.0, 0.5):
        at = wall.left + (middles + side * (width + 0.6))[:, None] * wall.along + out * _LOOK_OUT_M
        found = place.occupancy.at(at)
        own |= found == place.number + 1
        other |= (found != NOBODY) & (found != place.number + 1)
    ground = place.terrain.height(wall.left + middles[:, None] * wall.along + out * 0.3)
    return ground.tolist(), own.tolist(), other.tolist()


def _door_place(
    wall: Wall, size: tuple[float, float], place: Neighbourhood, base_m: float
) -> tuple[float, float] | None:
    """Returns where along a wall, and at which height, a door has room."""
    if wall.length < size[0] + 2 * _MARGIN_M:
        return None
    for share in (0.5, 0.3, 0.7):
        u = float(
            np.clip(share * wall.length, 0.5 * size[0] + _MARGIN_M, wall.length - 0.5 * size[0] - _MARGIN_M)
        )
        ground, annexed, walled = _outside(wall, np.array([u]), size[0], place)
        low = max(base_m, ground[0]) + _STEP_M
        if not annexed[0] and not walled[0] and low + size[1] < wall.top - 0.15:
            return u, low
    return None


def _cut(
    body: Body, wall: Wall, at: tuple[float, float], size: tuple[float, float], *, is_door: bool = False
) -> Points:
    """Cuts an opening into a wall, its lower middle at a place; returns its (4, 3) corners."""
    (u, low), (width, height) = at, size
    ends = [wall.left + (u + side * width / 2) * wall.along for side in (-1.0, 1.0)]
    corners = [(*ends[0], low), (*ends[1], low), (*ends[1], low + height), (*ends[0], low + height)]
    ring = [body.builder.point(float(x), float(y), float(z)) for x, y, z in corners]
    body.builder.add_opening(wall.face, ring, is_door=is_door)
    return np.array(corners)


def _add_dormer_window(body: Body, front: int) -> None:
    """Cuts a window into the front of a dormer where it is high enough."""
    corners = np.stack([body.builder.position(p) for p in body.builder.outline(front)])
    middle = corners.mean(axis=0)
    inner = middle + 0.66 * (corners - middle)
    if np.ptp(corners[:, 2]) > 0.7 and len(corners) == 4:
        ring = [body.builder.point(float(x), float(y), float(z)) for x, y, z in inner]
        body.builder.add_opening(front, ring)


def has_balconies(eave_m: float, function: str, district: str, generator: np.random.Generator) -> bool:
    """Returns whether a building has balconies: blocks of flats often, town houses seldom."""
    likely = {"estate": 0.8, "inner town": 0.35, "old town": 0.12}.get(district, 0.0)
    return function == "residential" and eave_m > 8.5 and chance(generator, likely)
