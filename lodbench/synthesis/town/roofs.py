"""Roofs as cross-sections: a line of heights from one eave to the other.

A new shape is a function that returns a ``Roof``, a line in ``ROOF_SHAPES`` for what all of them have in
common, and a place that builds it: ``houses`` or ``buildings``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lodbench.citymodel.model import SurfaceKind
from lodbench.synthesis.town.shapes import Points, SolidBuilder, edge_directions, left_of, parallel


class RoofShape(NamedTuple):
    """What all roofs of a shape have in common."""

    code: str  # of bldg:roofType in the LoD2 profile of the German surveying authorities
    has_chimneys: bool  # whether chimneys stand on it
    has_dormers: bool  # whether its slopes are steep and wide enough for dormers


ROOF_SHAPES = {
    "flat": RoofShape("1000", False, False),
    "shed": RoofShape("2100", False, False),
    "gabled": RoofShape("3100", True, True),
    "hipped": RoofShape("3200", True, True),
    "half-hipped": RoofShape("3300", True, False),
    "mansard": RoofShape("3400", True, True),
    "pavilion": RoofShape("3500", False, False),
    "serrated": RoofShape("3800", False, False),
}
_HALF_HIP_FROM = 0.55  # share of the rise below half hips


class Roof(NamedTuple):
    """The cross-section of a roof, and how its ends are closed."""

    name: str  # of its shape, one of ``ROOF_SHAPES``
    # (share of the way across, height above the base in metres) from eave to eave.
    profile: tuple[tuple[float, float], ...]
    # How far the ridge stops short of the first and last end; 0 is a gable.
    hips_m: tuple[float, float] = (0.0, 0.0)
    # At which share of the rise hips begin: 0 at the eaves, above that below them is a gable.
    hip_from: float = 0.0

    @property
    def shape(self) -> RoofShape:
        """What it has in common with its like."""
        return ROOF_SHAPES[self.name]

    @property
    def eave_m(self) -> float:
        """Lowest height of the roof above the base."""
        return min(height for _, height in self.profile)

    def height_at(self, share: float) -> float:
        """Returns the height above the base at a share of the way across, hips left aside."""
        shares, heights = zip(*self.profile, strict=True)
        return float(np.interp(share, shares, heights))

    def lowered(self, by_m: float) -> Roof:
        """Returns the same roof over lower walls."""
        return self._replace(profile=tuple((share, height - by_m) for share, height in self.profile))

    @property
    def ridge_m(self) -> float:
        """Greatest height of the roof above the base."""
        return max(height for _, height in self.profile)


def flat(height_m: float) -> Roof:
    """Returns a flat roof."""
    return Roof("flat", ((0.0, height_m), (1.0, height_m)))


def gabled(eave_m: float, pitch_deg: float, depth_m: float, ridge_at: float = 0.5) -> Roof:
    """Returns a roof whose steeper side has a pitch, over a body of a depth."""
    rise = min(ridge_at, 1 - ridge_at) * depth_m * math.tan(math.radians(pitch_deg))
    return Roof("gabled", ((0.0, eave_m), (ridge_at, eave_m + rise), (1.0, eave_m)))


def hipped(
    eave_m: float, pitch_deg: float, depth_m: float, length_m: float, ends: tuple[bool, bool] = (True, True)
) -> Roof:
    """Returns a roof with equal pitch all round; a pavilion (tent) roof where the ridge is a point."""
    ridge = gabled(eave_m, pitch_deg, depth_m)
    hip = min(depth_m / 2, length_m / 2)
    name = "pavilion" if all(ends) and length_m - 2 * hip < 0.05 else "hipped"
    return Roof(name, ridge.profile, (hip if ends[0] else 0.0, hip if ends[1] else 0.0))


def half_hipped(roof: Roof, depth_m: float) -> Roof:
    """Returns a gabled roof, its ridge in the middle, with both gables cut off near the top."""
    hip = 0.45 * (1 - _HALF_HIP_FROM) * depth_m
    return Roof("half-hipped", roof.profile, (hip, hip), _HALF_HIP_FROM)


def shed(eave_m: float, pitch_deg: float, depth_m: float) -> Roof:
    """Returns a roof of one slope that rises from the outer side."""
    return Roof("shed", ((0.0, eave_m), (1.0, eave_m + depth_m * math.tan(math.radians(pitch_deg)))))


def mansard(eave_m: float, depth_m: float) -> Roof:
    """Returns a roof with a steep lower and a shallow upper part."""
    lower, upper = 1.4, depth_m / 2 - 1.4
    knee, ridge = eave_m + 2.6, eave_m + 2.6 + upper * math.tan(math.radians(22))
    share = lower / depth_m
    return Roof("mansard", ((0.0, eave_m), (share, knee), (0.5, ridge), (1 - share, knee), (1.0, eave_m)))


def serrated(eave_m: float, rise_m: float, count: int) -> Roof:
    """Returns a row of low gables side by side, as over factory halls."""
    profile = [(k / (2 * count), eave_m + (rise_m if k % 2 else 0.0)) for k in range(2 * count + 1)]
    return Roof("serrated", tuple(profile))


class Strip(NamedTuple):
    """The plan of an extruded building, counter-clockwise around its outer line."""

    outer: Points  # (K, 2) local metres; the building lies to its left
    inner: Points  # (K, 2), the other side
    closed: bool = False  # whether it runs around a courtyard

    @classmethod
    def bent(cls, outer: Points, depths: list[float], *, closed: bool = False) -> Strip:
        """Returns the strip to the left of a line, each segment with its own depth, ends cut square."""
        return cls(outer, parallel(outer, np.array(depths), closed=closed), closed)

    @classmethod
    def bar(cls, corner: Points, along: Points, length: float, depth: float) -> Strip:
        """Returns a rectangle from its first corner; ``along`` is a unit vector, depth to its left."""
        return cls.bent(np.stack([corner, corner + along * length]), [depth])

    @property
    def wings(self) -> list[tuple[int, int]]:
        """Returns the corners at both ends of each wing."""
        count = len(self.outer)
        return [(k, (k + 1) % count) for k in range(count if self.closed else count - 1)]

    @property
    def first_wing(self) -> tuple[Points, Points, float, float]:
        """Returns unit directions along its outer side and across it, its length and its depth, metres."""
        along = edge_directions(self.outer)[0]
        across, edge = left_of(along), self.outer[1] - self.outer[0]
        depth = abs(float((self.inner[0] - self.outer[0]) @ across))
        return along, across, float(np.linalg.norm(edge)), depth

    @property
    def start_depth_m(self) -> float:
        """Returns how far its lines are apart at the first corner: on the mitre, if it is closed."""
        return float(np.linalg.norm(self.inner[0] - self.outer[0]))

    @property
    def rings(self) -> list[Points]:
        """Returns the outline, counter-clockwise, and the courtyard, clockwise, if there is one."""
        if self.closed:
            return [self.outer, self.inner[::-1]]
        return [np.concatenate([self.outer, self.inner[::-1]])]

    @property
    def pieces(self) -> list[Points]:
        """Returns the convex wings whose union is the plan, (4, 2) each, counter-clockwise."""
        return [np.stack([*self.outer[[a, b]], *self.inner[[b, a]]]) for a, b in self.wings]

    def across(self, share: float) -> Points:
        """Returns the corners of the line at a share of the way from outer to inner, (K, 2)."""
        return np.asarray(self.outer + share * (self.inner - self.outer))


class Wall(NamedTuple):
    """A wall as viewed from outside."""

    face: int  # its number in the builder
    base_ends: tuple[int, int]  # its lower left and lower right point in the builder
    left: Points  # (2,) its lower left corner
    along: Points  # (2,) unit direction to the right
    length: float  # metres
    top_m: float  # height up to which it is a rectangle


class Body:
    """An extruded building while it is built: its faces by place, so that details can cut into them.

    It stands on ``base_m``; a roof without hips stands out over the walls by ``overhang_m`` below its eaves.
    """

    def __init__(
        self, strip: Strip, roof: Roof, base_m: float, overhang_m: float = 0.0, per_metre: int = 1000
    ) -> None:
        self.strip, self.roof, self.base_m = strip, roof, base_m
        self.builder = SolidBuilder(per_metre)
        # By side (``outer``, ``inner``, ``first``, ``last``) and wing.
        self.walls: dict[tuple[str, int], Wall] = {}
        self.slopes: dict[tuple[int, int], int] = {}  # roof faces by wing and place in the roof's profile
        self.dormers: list[int] = []  # front faces of what was built into slopes
        self._low = outer, inner = [self.builder.points(line, base_m) for line in (strip.outer, strip.inner)]
        profile, self._num_soffits = _with_overhang(roof, strip, overhang_m)
        self._sections = [self.builder.points(strip.across(t), base_m + height) for t, height in profile]
        rings = [outer[::-1], inner] if strip.closed else [inner + outer[::-1]]
        self.ground = self.builder.face(SurfaceKind.GROUND, *rings)
        self._add_sides()
        for end in () if strip.closed else (0, 1):
            self._add_end(end)

    def _add_wall(self, side: str, k: int, ring: list[int]) -> None:
        face = self.builder.face(SurfaceKind.WALL, ring)
        left, right = (self.builder.position(point)[:2] for point in ring[:2])
        length = float(np.linalg.norm(right - left))
        eaves = [self.builder.position(line[0])[2] for line in (self._sections[0], self._sections[-1])]
        top = float({"outer": eaves[0], "inner": eaves[1]}.get(side, min(eaves)))
        self.walls[side, k] = Wall(face, (ring[0], ring[1]), left, (right - left) / length, length, top)

    def _add_sides(self) -> None:
        """Adds the walls along both lines, and the roof faces and soffits between them."""
        (outer, inner), lines = self._low, self._sections
        before, after = self._num_soffits
        for k, m in self.strip.wings:
            self._add_wall("outer", k, [outer[k], outer[m], lines[0][m], lines[0][k]])
            self._add_wall("inner", k, [inner[m], inner[k], lines[-1][k], lines[-1][m]])
            for j in range(len(lines) - 1):
                ring = [lines[j][k], lines[j][m], lines[j + 1][m], lines[j + 1][k]]
                if before <= j < len(lines) - 1 - after:
                    face = self.builder.face(SurfaceKind.ROOF, self._moved_to_hips(ring, j))
                    self.slopes[k, j - before] = face
                else:
                    self.builder.face(SurfaceKind.FLOOR, ring)

    def _moved_to_hips(self, ring: list[int], j: int) -> list[int]:
        """Returns a roof ring with the ends of a ridge drawn in to where the hips meet it."""
        for end, hip_m in enumerate(self.roof.hips_m):
            # From the first end, 0, to the last, -1.
            gable_top = self._sections[1][-end]
            if hip_m > 0.0 and gable_top in ring:
                corners = [self._ridge_end(end)]
                if self.roof.hip_from > 0:
                    cut = self._gable_cuts(end)[j]
                    corners = [*corners, cut] if end == j else [cut, *corners]
                at = ring.index(gable_top)
                ring = [*ring[:at], *corners, *ring[at + 1 :]]
        return ring

    def _ridge_end(self, end: int) -> int:
        """Returns where the ridge meets the hips of the first (0) or last (1) end."""
        share, height = self.roof.profile[1]
        line = self.strip.across(share)[:: -1 if end else 1]
        x, y = line[0] + (line[1] - line[0]) / np.linalg.norm(line[1] - line[0]) * self.roof.hips_m[end]
        return self.builder.point(float(x), float(y), self.base_m + height)

    def _gable_cuts(self, end: int) -> tuple[int, int]:
        """Returns where hips meet the two sloping edges of a gable, outer side first; else its eaves."""
        (start, _), (ridge, _), (stop, _) = self.roof.profile
        t = self.roof.hip_from
        ways = (start + t * (ridge - start), stop + t * (ridge - stop))
        outer, inner = (
            self.builder.points(self.strip.across(way)[[-end]], self.base_m + self.roof.height_at(way))[0]
            for way in ways
        )
        return outer, inner

    def _add_end(self, end: int) -> None:
        """Adds an end wall, up to the roof's cross-section or, below a hip, to where it begins."""
        (outer, inner), upward = self._low, [line[-end] for line in self._sections]
        side, k, base = "first", 0, [inner[0], outer[0]]
        if end:
            side, k, base, upward = "last", self.strip.wings[-1][0], [outer[-1], inner[-1]], upward[::-1]
        if self.roof.hips_m[end] == 0.0:
            self._add_wall(side, k, base + upward)
            return
        left, right = self._gable_cuts(end)[:: -1 if end else 1]
        self._add_wall(side, k, [*base, upward[0], left, right, upward[-1]])
        self.builder.face(SurfaceKind.ROOF, [right, left, self._ridge_end(end)])


def _with_overhang(
    roof: Roof, strip: Strip, overhang_m: float
) -> tuple[list[tuple[float, float]], tuple[int, int]]:
    """Returns a roof's profile with boxed eaves, and how many soffits it has at its start and end.

    The slope runs on beyond the wall, the wall ends where a level soffit from the slope's new foot meets
    it. Roofs with hips, and sides from which the roof does not rise, stay as they are.
    """
    profile, soffits = list(roof.profile), [0, 0]
    if overhang_m == 0.0 or any(roof.hips_m) or roof.name == "serrated":
        return profile, (0, 0)
    *_, depth = strip.first_wing
    for end, ahead, outward in ((0, 1, -1.0), (-1, -2, 1.0)):
        (share, height), (next_share, next_height) = roof.profile[end], roof.profile[ahead]
        if next_height <= height:
            continue
        foot = height - overhang_m * (next_height - height) / (abs(next_share - share) * depth)
        edge, wall = (share + outward * overhang_m / depth, foot), (share, foot)
        profile = [wall, edge, *profile[1:]] if end == 0 else [*profile[:-1], edge, wall]
        soffits[end] = 1
    return profile, (soffits[0], soffits[1])
