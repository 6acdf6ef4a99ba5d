"""Buildings as a roof's cross-section extruded along a bent strip: bars, L, U and courtyard shapes.

The strip has an outer and an inner line with the same corners. A point of the cross-section at a
share t lies at ``outer + t (inner - outer)`` of every corner: mitres come out by themselves, roof
faces are planar, and ridges of wings meet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import SurfaceKind
from lodbench.synthesis.town.roofs import Roof
from lodbench.synthesis.town.shapes import edge_directions, left_of, parallel
from lodbench.synthesis.town.solid import SolidBuilder

Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """The plan of an extruded building, counter-clockwise around its outer line.

    Attributes:
        outer: (K, 2) local metres; the building lies to its left.
        inner: (K, 2), the other side.
        closed: Whether it runs around a courtyard.
    """

    outer: Points
    inner: Points
    closed: bool = False

    @classmethod
    def bent(cls, outer: Points, depths: list[float], *, closed: bool = False) -> Strip:
        """Returns the strip to the left of a line, each segment with its own depth, ends cut square."""
        return cls(outer, parallel(outer, np.array(depths), closed=closed), closed)

    @classmethod
    def bar(cls, corner: Points, along: Points, length: float, depth: float) -> Strip:
        """Returns a rectangle from its first corner; ``along`` is a unit vector, depth to its left."""
        return cls.bent(np.stack([corner, corner + along * length]), [depth])

    @property
    def num_segments(self) -> int:
        """Number of wings."""
        return len(self.outer) if self.closed else len(self.outer) - 1

    def next_corner(self, k: int) -> int:
        """Returns the corner at the far end of segment k."""
        return (k + 1) % len(self.outer)

    @property
    def rings(self) -> list[Points]:
        """Returns the outline, counter-clockwise, and the courtyard, clockwise, if there is one."""
        if self.closed:
            return [self.outer, self.inner[::-1]]
        return [np.concatenate([self.outer, self.inner[::-1]])]

    @property
    def pieces(self) -> list[Points]:
        """Returns the convex wings whose union is the plan, (4, 2) each, counter-clockwise."""
        ends = [(k, self.next_corner(k)) for k in range(self.num_segments)]
        return [np.stack([self.outer[a], self.outer[b], self.inner[b], self.inner[a]]) for a, b in ends]

    def across(self, share: float) -> Points:
        """Returns the corners of the line at a share of the way from outer to inner, (K, 2)."""
        return np.asarray(self.outer + share * (self.inner - self.outer))


class Body:
    """An extruded building while it is built: its faces by place, so that details can cut into them.

    Args:
        strip: Its plan.
        roof: Its roof.
        base_m: Height it stands on.
        overhang_m: How far a roof without hips stands out over the walls below its eaves.
        per_metre: Precision of its points.

    Attributes:
        walls: Faces by side (``outer``, ``inner``, ``first``, ``last``) and wing.
        slopes: Roof faces by wing and place in the roof's profile.
        dormers: Front faces of what was built into slopes.
    """

    def __init__(
        self, strip: Strip, roof: Roof, base_m: float, overhang_m: float = 0.0, per_metre: int = 1000
    ) -> None:
        self.strip, self.roof, self.base_m = strip, roof, base_m
        self.builder = SolidBuilder(per_metre)
        self.walls: dict[tuple[str, int], int] = {}
        self.slopes: dict[tuple[int, int], int] = {}
        self.dormers: list[int] = []
        self._feet: dict[tuple[str, int], tuple[int, int]] = {}
        self._low = [self.builder.points(line, base_m) for line in (strip.outer, strip.inner)]
        profile, self._num_soffits = _with_overhang(roof, strip, overhang_m)
        self._sections = [
            self.builder.points(strip.across(share), base_m + height) for share, height in profile
        ]
        self.ground = self._add_ground()
        self._add_sides()
        if not strip.closed:
            self._add_end(first=True)
            self._add_end(first=False)

    def _add_ground(self) -> int:
        outer, inner = self._low
        if self.strip.closed:
            return self.builder.face(SurfaceKind.GROUND, outer[::-1], inner)
        return self.builder.face(SurfaceKind.GROUND, inner + outer[::-1])

    def _add_wall(self, side: str, k: int, ring: list[int]) -> None:
        self.walls[side, k] = self.builder.face(SurfaceKind.WALL, ring)
        self._feet[side, k] = ring[0], ring[1]

    def _add_sides(self) -> None:
        """Adds the walls along both lines, and the roof faces and soffits between them."""
        (outer, inner), lines = self._low, self._sections
        before, after = self._num_soffits
        for k in range(self.strip.num_segments):
            m = self.strip.next_corner(k)
            self._add_wall("outer", k, [outer[k], outer[m], lines[0][m], lines[0][k]])
            self._add_wall("inner", k, [inner[m], inner[k], lines[-1][k], lines[-1][m]])
            for j in range(len(lines) - 1):
                ring = [lines[j][k], lines[j][m], lines[j + 1][m], lines[j + 1][k]]
                if before <= j < len(lines) - 1 - after:
                    self.slopes[k, j - before] = self.builder.face(
                        SurfaceKind.ROOF, self._moved_to_hips(ring, j)
                    )
                else:
                    self.builder.face(SurfaceKind.FLOOR, ring)

    def _moved_to_hips(self, ring: list[int], j: int) -> list[int]:
        """Returns a roof ring with the ends of a ridge drawn in to where the hips meet it."""
        if self.strip.closed or len(self._sections) != 3:
            return ring
        moved = []
        for point in ring:
            first = point == self._sections[1][0]
            if not first and point != self._sections[1][-1]:
                moved.append(point)
                continue
            corners = [self._hip(first=first)]
            if self._has_hip(first=first) and self.roof.hip_from > 0:
                cut = self._gable_cuts(first=first)[j]
                corners = [*corners, cut] if first == (j == 0) else [cut, *corners]
            moved += corners
        return moved

    def _has_hip(self, *, first: bool) -> bool:
        return self.roof.hips_m[0 if first else 1] > 0.0

    def _hip(self, *, first: bool) -> int:
        """Returns the end of the ridge."""
        ridge, (share, height) = self._sections[1], self.roof.profile[1]
        if not self._has_hip(first=first):
            return ridge[0 if first else -1]
        line = self.strip.across(share)
        start, ahead = (line[0], line[1]) if first else (line[-1], line[-2])
        x, y = start + (ahead - start) / np.linalg.norm(ahead - start) * self.roof.hips_m[0 if first else 1]
        return self.builder.point(float(x), float(y), self.base_m + height)

    def _gable_cuts(self, *, first: bool) -> tuple[int, int]:
        """Returns where a half hip meets the two sloping edges of its gable, outer side first."""
        shares, at = [share for share, _ in self.roof.profile], 0 if first else -1
        t = self.roof.hip_from
        ways = (shares[0] + t * (shares[1] - shares[0]), shares[2] + t * (shares[1] - shares[2]))
        points = [self.strip.across(way)[at] for way in ways]
        heights = [self.base_m + self.roof.height_at(way) for way in ways]
        outer, inner = (
            self.builder.point(float(x), float(y), z) for (x, y), z in zip(points, heights, strict=True)
        )
        return outer, inner

    def _add_end(self, *, first: bool) -> None:
        """Adds the end wall, up to the roof's cross-section or, below a hip, to where it begins."""
        at, k = (0, 0) if first else (-1, self.strip.num_segments - 1)
        (outer, inner), lines = self._low, [line[at] for line in self._sections]
        base = [inner[at], outer[at]] if first else [outer[at], inner[at]]
        upward = lines if first else lines[::-1]
        side = "first" if first else "last"
        if not self._has_hip(first=first):
            self._add_wall(side, k, base + upward)
            return
        low = [upward[0], upward[-1]]
        if self.roof.hip_from > 0:
            cuts = self._gable_cuts(first=first)
            low = list(cuts if first else cuts[::-1])
            self._add_wall(side, k, [*base, upward[0], *low, upward[-1]])
        else:
            self._add_wall(side, k, [*base, *low])
        self.builder.face(SurfaceKind.ROOF, [low[1], low[0], self._hip(first=first)])

    def wall_line(self, side: str, k: int) -> tuple[int, int]:
        """Returns the base points of a wall from left to right as seen from outside."""
        return self._feet[side, k]

    def wall_top_m(self, side: str) -> float:
        """Returns the height up to which a wall is a rectangle."""
        heights = [self.builder.position(line[0])[2] for line in (self._sections[0], self._sections[-1])]
        return float({"outer": heights[0], "inner": heights[1]}.get(side, min(heights)))


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
    depth = float(np.linalg.norm(strip.inner[0] - strip.outer[0]))
    if strip.num_segments > 1 or strip.closed:
        along = edge_directions(strip.outer)[0]
        depth = abs(float((strip.inner[0] - strip.outer[0]) @ left_of(along)))
    for end, ahead, outward in ((0, 1, -1.0), (-1, -2, 1.0)):
        (share, height), (next_share, next_height) = roof.profile[end], roof.profile[ahead]
        if next_height <= height:
            continue
        foot = height - overhang_m * (next_height - height) / (abs(next_share - share) * depth)
        edge = (share + outward * overhang_m / depth, foot)
        wall = (share, foot)
        profile = [wall, edge, *profile[1:]] if end == 0 else [*profile[:-1], edge, wall]
        soffits[end] = 1
    return profile, (soffits[0], soffits[1])


def wing_direction(strip: Strip, k: int) -> tuple[Points, Points, float]:
    """Returns a wing's unit direction, the unit direction across it, and the length of its outer side."""
    edge = strip.outer[strip.next_corner(k)] - strip.outer[k]
    along = edge_directions(strip.outer)[k]
    return along, left_of(along), float(np.linalg.norm(edge))
