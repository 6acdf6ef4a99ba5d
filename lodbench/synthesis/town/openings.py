"""Windows and doors: what level of detail 3 cuts into walls."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.town.extrusion import Body, Wall
from lodbench.synthesis.town.fittings import STOREY_M, chance
from lodbench.synthesis.town.shapes import Points, left_of
from lodbench.synthesis.town.terrain import NOBODY, Occupancy, Terrain

# Openings keep this far from corners, eaves and the ground.
_MARGIN_M = 0.45
_ABOVE_GROUND_M = 0.35
_STEP_M = 0.12
_DOOR_M = (1.15, 2.15)
_GATE_M = (2.5, 2.1)
# A place this far before a wall tells whether somebody stands against it.
_LOOK_OUT_M = 0.9


class WindowStyle(NamedTuple):
    """The windows of one building, metres."""

    width: float  # of a window
    height: float  # of a window
    sill: float  # above the floor
    spacing: float  # from window to window
    storey: float  # from floor to floor


class Neighbourhood(NamedTuple):
    """What decides where a building can have windows."""

    number: int  # the building's in ``occupancy``
    occupancy: Occupancy  # who stands where
    terrain: Terrain  # the ground
    annex_m: float  # height up to which its own annexes stand before its walls


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


def add_openings(
    body: Body, function: str, place: Neighbourhood, generator: np.random.Generator
) -> list[Points]:
    """Cuts windows, a door or a gate, and dormer windows into a body.

    Returns:
        (4, 3) corners of each window, lower left first, counter-clockwise seen from outside.
    """
    style = window_style(function, generator)
    size = _GATE_M if style is None else _DOOR_M
    has_door = False
    windows: list[Points] = []
    for wall in body.walls.values():
        door = None if has_door else _door_place(wall, size, place, body.base_m)
        if door is not None:
            has_door = True
            _cut(body, wall, door, size, is_door=True)
        if style is not None:
            windows += _add_windows(body, wall, style, place, door)
    for front in body.dormers:
        corners = body.builder.corners(front)
        middle = corners.mean(axis=0)
        if np.ptp(corners[:, 2]) > 0.7 and len(corners) == 4:
            body.builder.add_opening(front, middle + 0.66 * (corners - middle))
    return windows


def _add_windows(
    body: Body, wall: Wall, style: WindowStyle, place: Neighbourhood, door: tuple[float, float] | None
) -> list[Points]:
    """Cuts rows of windows into one wall, clear of its door; returns their corners."""
    count = int((wall.length - 2 * _MARGIN_M - style.width) / style.spacing) + 1
    if wall.length < 2 * _MARGIN_M + style.width:
        return []
    first = 0.5 * (wall.length - (count - 1) * style.spacing)
    middles = np.asarray(first + style.spacing * np.arange(count), dtype=np.float64)
    ground_m, annexed, walled = _outside(wall, middles, style.width, place)
    cut = []
    for storey in range(max(1, int((wall.top_m - body.base_m - 0.4) / style.storey))):
        low = body.base_m + 0.3 + storey * style.storey + style.sill
        if low + style.height > wall.top_m - 0.3:
            continue
        blocked = walled | (low < ground_m + _ABOVE_GROUND_M)
        if low < body.base_m + place.annex_m + 0.3:
            blocked |= annexed
        if door is not None and low < door[1] + _DOOR_M[1] + 0.3:
            blocked |= np.abs(middles - door[0]) < 0.5 * (style.width + _DOOR_M[0]) + 0.2
        places = middles[~blocked].tolist()
        cut += [_cut(body, wall, (u, low), (style.width, style.height)) for u in places]
    return cut


def _outside(
    wall: Wall, middles: Points, width: float, place: Neighbourhood
) -> tuple[Points, NDArray[np.bool_], NDArray[np.bool_]]:
    """Returns what is before each place on a wall: ground height, an own annex, another building."""
    out = -left_of(wall.along)
    # Before its left end, its middle and its right end.
    along_m = middles + np.array([[-0.5], [0.0], [0.5]]) * (width + 0.6)
    at = wall.left + along_m.reshape(-1, 1) * wall.along + out * _LOOK_OUT_M
    found = place.occupancy.at(at).reshape(along_m.shape)
    is_own = found == place.number + 1
    own, other = is_own.any(axis=0), ((found != NOBODY) & ~is_own).any(axis=0)
    return place.terrain.height(wall.left + middles[:, None] * wall.along + out * 0.3), own, other


def _door_place(
    wall: Wall, size: tuple[float, float], place: Neighbourhood, base_m: float
) -> tuple[float, float] | None:
    """Returns where along a wall, and at which height, a door has room."""
    end = 0.5 * size[0] + _MARGIN_M
    for share in (0.5, 0.3, 0.7) if wall.length >= size[0] + 2 * _MARGIN_M else ():
        u = float(np.clip(share * wall.length, end, wall.length - end))
        (ground_m,), (annexed,), (walled,) = _outside(wall, np.array([u]), size[0], place)
        low = float(max(base_m, ground_m)) + _STEP_M
        if not annexed and not walled and low + size[1] < wall.top_m - 0.15:
            return u, low
    return None


def _cut(
    body: Body, wall: Wall, at: tuple[float, float], size: tuple[float, float], *, is_door: bool = False
) -> Points:
    """Cuts an opening into a wall, its lower middle at a place; returns its (4, 3) corners."""
    (u, low), (width, height) = at, size
    left, right = (wall.left + (u + side * width / 2) * wall.along for side in (-1.0, 1.0))
    corners = np.array([(*left, low), (*right, low), (*right, low + height), (*left, low + height)])
    body.builder.add_opening(wall.face, corners, is_door=is_door)
    return corners


def has_balconies(eave_m: float, function: str, district: str, generator: np.random.Generator) -> bool:
    """Returns whether a building has balconies: blocks of flats often, town houses seldom."""
    likely = {"estate": 0.8, "inner town": 0.35, "old town": 0.12}.get(district, 0.0)
    return function == "residential" and eave_m > 8.5 and chance(generator, likely)
