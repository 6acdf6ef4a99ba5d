"""Plans become buildings at three levels of detail: on their ground, with windows and doors.

What they have besides walls and a roof stands first: annexes, dormers, lift houses, chimneys, balconies.
Annexes and boxes on roofs cut into one face of a body and close the gap again, so the solid stays closed.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import SurfaceKind
from lodbench.storage import random_stream
from lodbench.synthesis.town import roofs, shapes
from lodbench.synthesis.town.roofs import Body, Roof, Strip, Wall
from lodbench.synthesis.town.shapes import Points, Solid
from lodbench.synthesis.town.streets import NOBODY, Occupancy, Terrain

STOREY_M = 3.1
_SUNK_M = 0.6  # how deep a chimney reaches into the roof
# Openings keep this far from the edges of the face they cut.
_OPENING_MARGIN_M = 0.4


class Annex(NamedTuple):
    """A flat-roofed extension before a wall, lower than its eaves."""

    side: str  # ``outer``, ``inner``, ``first`` or ``last``
    wing: int  # the wing the wall belongs to
    start_m: float  # distance of its left edge from the wall's left end, viewed from outside
    length_m: float  # its length along the wall
    depth_m: float  # how far it stands out
    height_m: float  # height above the base

    def plan(self, body: Body) -> Points:
        """Returns its plan, (4, 2), counter-clockwise, the wall's edge first, from right to left."""
        wall = body.walls[self.side, self.wing]
        start = wall.left + wall.along * self.start_m
        end, out = start + wall.along * self.length_m, -shapes.left_of(wall.along) * self.depth_m
        return np.stack([end, start, start + out, end + out])

    def add_to(self, body: Body) -> None:
        """Adds the annex to a body."""
        builder, wall, ring = body.builder, body.walls[self.side, self.wing], self.plan(body)
        low, high = (builder.points(ring, body.base_m + up) for up in (0.0, self.height_m))
        left, right = wall.base_ends
        builder.detour(wall.face, left, right, [low[1], high[1], high[0], low[0]])
        builder.detour(body.ground, right, left, [low[0], low[3], low[2], low[1]])
        builder.face(SurfaceKind.ROOF, high)
        builder.walls([*low[1:], low[0]], [*high[1:], high[0]])


class RoofBox(NamedTuple):
    """A box that rises out of a roof face: a dormer on a slope, a lift house on a flat roof."""

    wing: int  # the wing of the roof face
    slope: int  # which face across the profile, counted from the outer side
    start_m: float  # distance from the left end of the face's lower edge
    width_m: float  # size along the lower edge
    up_m: float  # plan distance of its front from the lower edge
    depth_m: float  # plan size away from the lower edge
    # Height over the roof at its back: 0 for a dormer, whose roof runs level into the slope.
    rise_m: float = 0.0

    def fits(self, body: Body) -> bool:
        """Returns whether it lies within its roof face, a margin from every edge."""
        face = self._corners(body)
        left = shapes.left_of(shapes.edge_directions(face[:, :2]))
        distance = np.einsum("kc,kmc->km", left, self._plan(face)[None] - face[:, None, :2])
        return bool(distance.min() >= _OPENING_MARGIN_M)

    def add_to(self, body: Body) -> None:
        """Adds the box to a body."""
        builder, face = body.builder, self._corners(body)
        plan = self._plan(face)
        foot = [builder.point(x, y, z) for (x, y), z in zip(plan, _heights(face, plan), strict=True)]
        roof_m = float(_heights(face, plan[2:3])[0]) + self.rise_m
        # Without a rise the roof's back edge lies in the slope, and its points are the hole's.
        top = [builder.point(x, y, roof_m) for x, y in plan[:2]]
        top += foot[2:] if self.rise_m == 0 else [builder.point(x, y, roof_m) for x, y in plan[2:]]
        builder.add_hole(body.slopes[self.wing, self.slope], foot[::-1])
        builder.face(SurfaceKind.ROOF, top)
        front, *_ = builder.walls([*foot, foot[0]], [*top, top[0]])
        body.dormers.append(front)

    def _corners(self, body: Body) -> Points:
        """Returns the corners of the roof face, (N, 3), the lower edge first."""
        corners = body.builder.corners(body.slopes[self.wing, self.slope])
        pairs = corners[:, 2] + np.roll(corners[:, 2], -1)
        return np.roll(corners, -int(np.argmin(np.round(pairs, 3))), axis=0)

    def _plan(self, face: Points) -> Points:
        """Returns the plan, (4, 2), counter-clockwise from the front left corner."""
        origin, along = face[0, :2], face[1, :2] - face[0, :2]
        along = along / np.linalg.norm(along)
        u = np.array([0.0, self.width_m, self.width_m, 0.0]) + self.start_m
        v = np.array([0.0, 0.0, self.depth_m, self.depth_m]) + self.up_m
        return np.asarray(origin + u[:, None] * along + v[:, None] * shapes.left_of(along))


def _heights(face: Points, plan: Points) -> Points:
    """Returns heights, (N,), of the plane of a face, (M, 3), at plan positions, (N, 2)."""
    normal = np.cross(face[1] - face[0], face[2] - face[0])
    return np.asarray(face[0, 2] - (plan - face[0, :2]) @ normal[:2] / normal[2])


Detail = Annex | RoofBox


def chance(generator: np.random.Generator, probability: float) -> bool:
    """Returns True with a probability."""
    return bool(generator.random() < probability)


def eaves(storeys: int, generator: np.random.Generator) -> float:
    """Returns the height of the eaves over so many storeys, metres."""
    return storeys * STOREY_M + float(generator.uniform(0.3, 1.2))


def town_roof(eave_m: float, depth_m: float, generator: np.random.Generator, modern: float) -> Roof:
    """Returns the roof of a house in a row, on a share of ``modern`` ones flat."""
    draw = float(generator.random())
    if draw < modern:
        return roofs.flat(eave_m + 0.8)
    if draw < modern + 0.16:
        return roofs.mansard(eave_m, depth_m)
    return roofs.gabled(
        eave_m, float(generator.uniform(36, 50)), depth_m, float(generator.uniform(0.45, 0.55))
    )


def house_roof(eave_m: float, strip: Strip, generator: np.random.Generator) -> Roof:
    """Returns the roof of a house that stands alone."""
    draw, pitch, depth = float(generator.random()), float(generator.uniform(30, 46)), strip.start_depth_m
    if draw < 0.12:
        return roofs.flat(eave_m + 0.4)
    if draw < 0.62 or len(strip.wings) > 1:
        return roofs.gabled(eave_m, pitch, depth)
    _, _, length, _ = strip.first_wing
    return roofs.hipped(eave_m, min(pitch, 36.0), depth, length)


def dormers(strip: Strip, roof: Roof, generator: np.random.Generator) -> list[Detail]:
    """Returns dormers in a row on one side of the first wing, as many as fit; none on shallow roofs."""
    if not roof.shape.has_dormers:
        return []
    slope = 0 if chance(generator, 0.6) else len(roof.profile) - 2
    low, high = sorted((roof.profile[slope], roof.profile[slope + 1]), key=lambda point: point[1])
    run, rise = abs(high[0] - low[0]) * strip.start_depth_m, high[1] - low[1]
    width, front = float(generator.uniform(1.2, 2.2)), float(generator.uniform(0.15, 0.3)) * run
    depth = min(front + 1.5 * run / rise, 0.85 * run) - front
    _, _, length, _ = strip.first_wing
    spacing, start = float(generator.uniform(2.6, 4.2)), float(generator.uniform(1.0, 2.0))
    places = (start + spacing * np.arange(int(length / spacing))).tolist()
    body = Body(strip, roof, 0.0)
    row = [RoofBox(0, slope, place, width, front, depth) for place in places]
    return [box for box in row if depth > 0.8 and box.fits(body)]


def annex(length_m: float, eave_m: float, generator: np.random.Generator) -> list[Detail]:
    """Returns an extension of the first wing's inner wall, if that is long and high enough for it."""
    width = float(generator.uniform(0.3, 0.6)) * length_m
    height = min(float(generator.uniform(2.8, 4.2)), eave_m - 0.8)
    if width < 2.5 or length_m - width < 1.5 or height < 2.2:
        return []
    start = float(generator.uniform(0.5, length_m - width - 0.5))
    return [Annex("inner", 0, start, width, float(generator.uniform(2.0, 4.5)), height)]


def lift_houses(strip: Strip, roof: Roof, count: int, generator: np.random.Generator) -> list[Detail]:
    """Returns boxes spread along the first wing of a flat roof."""
    _, _, length, depth = strip.first_wing
    body = Body(strip, roof, 0.0)
    row = [
        RoofBox(0, 0, length * (k + 0.5) / count - 2.0, 4.0, 0.3 * depth, 0.35 * depth, rise)
        for k, rise in enumerate(generator.uniform(2.2, 3.4, size=count).tolist())
    ]
    return [box for box in row if box.fits(body)]


def chimneys(strip: Strip, roof: Roof, base_m: float, generator: np.random.Generator) -> list[Solid]:
    """Returns chimneys near the ridge of the first wing, if the roof is of a shape that has them."""
    if not roof.shape.has_chimneys:
        return []
    along, across, length, depth = strip.first_wing
    room, stacks = max(roof.hips_m) + 1.0, []
    for _ in range(1 + chance(generator, 0.35)):
        share = float(np.clip(0.5 + generator.choice([-1.0, 1.0]) * generator.uniform(0.04, 0.16), 0.2, 0.8))
        at = float(generator.uniform(room, max(length - room, room + 0.1)))
        width, breadth = generator.uniform((0.5, 0.5), (0.9, 1.3)).tolist()
        top = roof.ridge_m + float(generator.uniform(0.5, 1.1))
        if at + 0.5 * breadth <= length - 0.3:
            ring = shapes.rectangles(
                strip.outer[0] + along * at + across * share * depth, along, breadth, width
            )
            low = base_m + roof.height_at(share) - _SUNK_M
            stacks.append(shapes.prism([ring], low, base_m + top, SurfaceKind.INSTALLATION))
    return stacks


def balconies(windows: list[Points], generator: np.random.Generator) -> list[Solid]:
    """Returns balconies before every other column of windows above the ground floor.

    Of each window the corners are given, (4, 3), lower left first.
    """
    if not windows:
        return []
    lowest = min(window[0, 2] for window in windows)
    phase, depth = int(generator.integers(2)), float(generator.uniform(1.1, 1.6))
    columns: dict[tuple[float, float], int] = {}
    slabs = []
    for (left, right), low in ((window[:2, :2], float(window[0, 2])) for window in windows):
        column = columns.setdefault((round(left[0], 2), round(left[1], 2)), len(columns))
        if column % 2 == phase and low >= lowest + 1.0:
            width = float(np.linalg.norm(right - left))
            along = (right - left) / width
            middle = 0.5 * (left + right) - shapes.left_of(along) * (0.5 * depth - 0.04)
            ring, floor = shapes.rectangles(middle, along, width + 1.0, depth), low - 0.9
            slabs.append(shapes.prism([ring], floor - 0.15, floor + 0.95, SurfaceKind.INSTALLATION))
    return slabs


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
    out = -shapes.left_of(wall.along)
    # Before its left end, its middle and its right end.
    along_m = middles + np.array([[-0.5], [0.0], [0.5]]) * (width + 0.6)
    at = wall.left + along_m.reshape(-1, 1) * wall.along + out * _LOOK_OUT_M
    occupants = place.occupancy.at(at).reshape(along_m.shape)
    is_own = occupants == place.number + 1
    own, other = is_own.any(axis=0), ((occupants != NOBODY) & ~is_own).any(axis=0)
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
    named: Sequence[tuple[str, Plan]],
    seed: int,
    look: shapes.TownLook,
    terrain: Terrain,
    occupancy: Occupancy,
) -> list[Building]:
    """Returns the buildings of identifiers and plans, whose order is that of ``occupancy``."""
    buildings = []
    for number, (name, plan) in enumerate(named):
        annex_m = max((annex.height_m for annex in plan.annexes), default=0.0)
        place = Neighbourhood(number, occupancy, terrain, annex_m)
        buildings.append(_construct(name, restyled(name, plan, seed, look), place, seed))
    return buildings


def restyled(name: str, plan: Plan, seed: int, look: shapes.TownLook) -> Plan:
    """Returns a plan whose plain gabled roof may have become another as the town's look has it."""
    strip, roof, draw = plan.strip, plan.roof, float(random_stream(seed, "demo", name, "roof").random())
    if roof.name != "gabled" or len(strip.wings) > 1 or plan.details:
        return plan
    if draw < look.half_hipped and roof.profile[1][0] == 0.5:
        return plan._replace(roof=roofs.half_hipped(roof, strip.start_depth_m))
    if look.half_hipped <= draw < look.half_hipped + look.shed:
        return plan._replace(roof=roofs.shed(roof.eave_m, 14.0, strip.start_depth_m))
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
    return shapes.prism(_generalised(plan.strip.rings), base_m, round(base_m + height, 2))


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
    kept = [rings[0], *[ring for ring in rings[1:] if -shapes.area(ring) >= LOD1_COURTYARD_M2]]
    snapped = []
    for ring in kept:
        coarse = np.round(ring / LOD1_GRID_M) * LOD1_GRID_M
        coarse = coarse[(coarse != np.roll(coarse, 1, axis=0)).any(axis=1)]
        sound = len(coarse) >= 3 and shapes.area(coarse) * shapes.area(ring) > 0
        snapped.append(coarse if sound else ring)
    return snapped
