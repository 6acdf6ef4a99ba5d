"""What buildings have besides walls and a roof: annexes, dormers, lift houses, chimneys, balconies.

Annexes and boxes on roofs cut into one face of a body and close the gap again, so the solid stays closed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lodbench.citymodel.model import SurfaceKind
from lodbench.synthesis.town.roofs import Body, Roof, Strip, flat, gabled, hipped, mansard
from lodbench.synthesis.town.shapes import Points, Solid, edge_directions, left_of, prism, rectangles

STOREY_M = 3.1
_SUNK_M = 0.6  # how deep a chimney reaches into the roof
# Openings keep this far from the edges of the face they cut.
_MARGIN_M = 0.4


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
        end, out = start + wall.along * self.length_m, -left_of(wall.along) * self.depth_m
        return np.stack([end, start, start + out, end + out])

    def add_to(self, body: Body) -> None:
        """Adds the annex to a body."""
        builder, wall, ring = body.builder, body.walls[self.side, self.wing], self.plan(body)
        low, high = (builder.points(ring, body.base_m + up) for up in (0.0, self.height_m))
        left, right = wall.feet
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
        left = left_of(edge_directions(face[:, :2]))
        distance = np.einsum("kc,kmc->km", left, self._plan(face)[None] - face[:, None, :2])
        return bool(distance.min() >= _MARGIN_M)

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
        return np.asarray(origin + u[:, None] * along + v[:, None] * left_of(along))


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
        return flat(eave_m + 0.8)
    if draw < modern + 0.16:
        return mansard(eave_m, depth_m)
    return gabled(eave_m, float(generator.uniform(36, 50)), depth_m, float(generator.uniform(0.45, 0.55)))


def house_roof(eave_m: float, strip: Strip, generator: np.random.Generator) -> Roof:
    """Returns the roof of a house that stands alone."""
    draw, pitch, depth = float(generator.random()), float(generator.uniform(30, 46)), strip.start_depth_m
    if draw < 0.12:
        return flat(eave_m + 0.4)
    if draw < 0.62 or len(strip.wings) > 1:
        return gabled(eave_m, pitch, depth)
    _, _, length, _ = strip.first_wing
    return hipped(eave_m, min(pitch, 36.0), depth, length)


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
            ring = rectangles(strip.outer[0] + along * at + across * share * depth, along, breadth, width)
            low = base_m + roof.height_at(share) - _SUNK_M
            stacks.append(prism([ring], low, base_m + top, SurfaceKind.INSTALLATION))
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
            middle = 0.5 * (left + right) - left_of(along) * (0.5 * depth - 0.04)
            ring, floor = rectangles(middle, along, width + 1.0, depth), low - 0.9
            slabs.append(prism([ring], floor - 0.15, floor + 0.95, SurfaceKind.INSTALLATION))
    return slabs
