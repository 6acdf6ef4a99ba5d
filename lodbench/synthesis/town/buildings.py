"""Plans become buildings at three levels of detail: on their ground, with windows and doors."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.storage import random_stream
from lodbench.synthesis.town.fittings import STOREY_M, Annex, Detail, RoofBox, balconies, chance, chimneys
from lodbench.synthesis.town.roofs import Body, Roof, Strip, Wall, half_hipped, shed
from lodbench.synthesis.town.shapes import Points, Solid, TownLook, area, left_of, prism
from lodbench.synthesis.town.streets import NOBODY, Occupancy, Terrain

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
        (4, 3) corners of each window, lower left first, counter-clockwise viewed from outside.
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


# LoD1 outlines are generalised: corners snap to this grid, and courtyards below this size are filled.
LOD1_GRID_M = 0.5
LOD1_COURTYARD_M2 = 120.0
# LoD1 boxes end this share of the way from the eaves to the ridge, more or less.
LOD1_HEIGHT_SHARE = 0.5
LOD1_HEIGHT_SIGMA_M = 0.5
# How far roofs stand out over walls.
_OVERHANG_M = (0.25, 0.6)
# Shares of buildings that were built, pulled down, and raised by storeys since the coarse map was made.
_NEW, _GONE, _RAISED = 0.05, 0.04, 0.08
# Precision of LoD3 points.
_PER_METRE = 10_000


class Age(Enum):
    """What happened to a building between the survey of the coarse map and the photos."""

    KNOWN = "known"
    NEW = "new"  # built since: LoD3 only
    GONE = "gone"  # pulled down since: LoD1 and LoD2 only
    RAISED = "raised"  # got storeys since: LoD1 and LoD2 are lower


class Plan(NamedTuple):
    """What is decided of a building before it stands."""

    strip: Strip  # its plan
    roof: Roof  # its roof, heights above the base
    function: str  # ``residential``, ``commercial``, ``public``, ``church``, ``industrial``, ``garage``
    district: str  # where in town it stands
    # Annexes and lift houses, which LoD2 shows, and dormers, which only LoD3 shows.
    details: tuple[Detail, ...] = ()

    @property
    def annexes(self) -> list[Annex]:
        """Returns the details that stand before walls."""
        return [detail for detail in self.details if isinstance(detail, Annex)]

    @property
    def pieces(self) -> list[Points]:
        """Returns its convex pieces, annexes included, (4, 2) each, counter-clockwise."""
        annexes = [annex.plan(Body(self.strip, self.roof, 0.0)) for annex in self.annexes]
        return [*self.strip.pieces, *annexes]


class Building(NamedTuple):
    """A building with its solids, local metres."""

    identifier: str  # unique and stable for a seed
    plan: Plan  # what it was built from
    age: Age  # whether the coarse map still tells the truth about it
    # A box over the generalised outline, from the ground to between eaves and ridge, its height as wrong as
    # measured ones are.
    lod1: Solid
    lod2: Solid  # walls, roof faces, annexes and lift houses
    lod3: Solid  # the same with eaves that stand out, dormers, windows and doors
    installations: tuple[Solid, ...]  # chimneys and balconies of LoD3, each a closed body of its own


def construct_all(
    named: Sequence[tuple[str, Plan]], seed: int, look: TownLook, terrain: Terrain, occupancy: Occupancy
) -> list[Building]:
    """Returns the buildings of identifiers and plans, whose order is that of ``occupancy``."""
    buildings = []
    for number, (name, plan) in enumerate(named):
        annex_m = max((annex.height_m for annex in plan.annexes), default=0.0)
        place = Neighbourhood(number, occupancy, terrain, annex_m)
        buildings.append(_construct(name, restyled(name, plan, seed, look), place, seed))
    return buildings


def restyled(name: str, plan: Plan, seed: int, look: TownLook) -> Plan:
    """Returns a plan whose plain gabled roof may have become another as the town's look has it."""
    strip, roof, draw = plan.strip, plan.roof, float(random_stream(seed, "demo", name, "roof").random())
    if roof.name != "gabled" or len(strip.wings) > 1 or plan.details:
        return plan
    if draw < look.half_hipped and roof.profile[1][0] == 0.5:
        return plan._replace(roof=half_hipped(roof, strip.start_depth_m))
    if look.half_hipped <= draw < look.half_hipped + look.shed:
        return plan._replace(roof=shed(roof.eave_m, 14.0, strip.start_depth_m))
    return plan


def _construct(name: str, plan: Plan, place: Neighbourhood, seed: int) -> Building:
    chances = random_stream(seed, "demo", name, "details")
    # The lowest ground under its outline, so that no side floats.
    base_m = round(float(place.terrain.height(np.concatenate(plan.strip.rings)).min()), 2)
    height_error = float(chances.normal(0.0, LOD1_HEIGHT_SIGMA_M))
    lod3, installations = _fine_body(plan, base_m, place, chances)
    age, mapped = _as_mapped(name, plan, seed)
    box, body = coarse_box(mapped, base_m, height_error), plain_body(mapped, base_m)
    return Building(name, plan, age, box, body, lod3, installations)


def _as_mapped(name: str, plan: Plan, seed: int) -> tuple[Age, Plan]:
    """Returns what became of a building since the coarse map was made, and its plan back then."""
    chances = random_stream(seed, "demo", name, "age")
    draw, storeys = float(chances.random()), int(chances.integers(1, 3))
    if plan.function in ("church", "public"):
        return Age.KNOWN, plan
    if draw < _NEW:
        return Age.NEW, plan
    if draw < _NEW + _GONE:
        return Age.GONE, plan
    lower_m = storeys * STOREY_M
    if draw > _NEW + _GONE + _RAISED or plan.roof.eave_m - lower_m < 2.4 or plan.annexes:
        return Age.KNOWN, plan
    return Age.RAISED, plan._replace(roof=plan.roof.lowered(lower_m))


def _fine_body(
    plan: Plan, base_m: float, place: Neighbourhood, chances: np.random.Generator
) -> tuple[Solid, tuple[Solid, ...]]:
    """Returns the LoD3 solid of a plan, and its chimneys and balconies."""
    body = Body(plan.strip, plan.roof, base_m, float(chances.uniform(*_OVERHANG_M)), _PER_METRE)
    for detail in plan.details:
        detail.add_to(body)
    windows = add_openings(body, plan.function, place, chances)
    extra: list[Solid] = []
    if plan.function in ("residential", "public") or chance(chances, 0.3):
        extra += chimneys(plan.strip, plan.roof, base_m, chances)
    if has_balconies(plan.roof.eave_m, plan.function, plan.district, chances):
        extra += balconies(windows, chances)
    return body.builder.build(), tuple(extra)


def coarse_box(plan: Plan, base_m: float, height_error_m: float) -> Solid:
    """Returns the LoD1 box of a plan, its height off by an error, at least 2 m high."""
    rise = plan.roof.ridge_m - plan.roof.eave_m
    height = max(plan.roof.eave_m + LOD1_HEIGHT_SHARE * rise + height_error_m, 2.0)
    return prism(_generalised(plan.strip.rings), base_m, round(base_m + height, 2))


def plain_body(plan: Plan, base_m: float) -> Solid:
    """Returns the LoD2 solid of a plan."""
    body = Body(plan.strip, plan.roof, base_m)
    for detail in plan.details:
        is_dormer = isinstance(detail, RoofBox) and detail.rise_m == 0.0
        if not is_dormer:
            detail.add_to(body)
    return body.builder.build()


def _generalised(rings: list[Points]) -> list[Points]:
    """Returns plan rings on the LoD1 grid, without small courtyards; unchanged where nothing is left."""
    kept = [rings[0], *[ring for ring in rings[1:] if -area(ring) >= LOD1_COURTYARD_M2]]
    snapped = []
    for ring in kept:
        coarse = np.round(ring / LOD1_GRID_M) * LOD1_GRID_M
        coarse = coarse[(coarse != np.roll(coarse, 1, axis=0)).any(axis=1)]
        sound = len(coarse) >= 3 and area(coarse) * area(ring) > 0
        snapped.append(coarse if sound else ring)
    return snapped
