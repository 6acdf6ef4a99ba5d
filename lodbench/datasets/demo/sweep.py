"""Buildings as a roof's cross-section swept along a bent strip: bars, L, U and courtyard shapes.

The strip has an outer and an inner line with the same corners. A point of the cross-section at a
share t lies at ``outer + t (inner - outer)`` of every corner: mitres come out by themselves, roof
faces are planar, and ridges of wings meet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import SurfaceKind
from lodbench.datasets.demo.roofs import Roof
from lodbench.datasets.demo.shapes import edge_directions, left_of, parallel
from lodbench.datasets.demo.solid import SolidBuilder

Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """The plan of a swept building, counter-clockwise around its outer line.

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
    """A swept building while it is built: its faces by place, so that details can cut into them."""

    def __init__(self, strip: Strip, roof: Roof, base_m: float) -> None:
        self.strip, self.roof, self.base_m = strip, roof, base_m
        self.builder = SolidBuilder()
        self.walls: dict[tuple[str, int], int] = {}
        self.slopes: dict[tuple[int, int], int] = {}
        self._low = [self.builder.points(line, base_m) for line in (strip.outer, strip.inner)]
        self._sections = [
            self.builder.points(strip.across(share), base_m + height) for share, height in roof.profile
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

    def _add_sides(self) -> None:
        """Adds the walls along both lines and the roof faces between them."""
        (outer, inner), lines = self._low, self._sections
        for k in range(self.strip.num_segments):
            m = self.strip.next_corner(k)
            wall = self.builder.face
            self.walls["outer", k] = wall(SurfaceKind.WALL, [outer[k], outer[m], lines[0][m], lines[0][k]])
            self.walls["inner", k] = wall(SurfaceKind.WALL, [inner[m], inner[k], lines[-1][k], lines[-1][m]])
            for j in range(len(lines) - 1):
                ring = [lines[j][k], lines[j][m], lines[j + 1][m], lines[j + 1][k]]
                self.slopes[k, j] = self.builder.face(SurfaceKind.ROOF, self._moved_to_hips(ring, k))

    def _moved_to_hips(self, ring: list[int], k: int) -> list[int]:
        """Returns a roof ring with the ends of a ridge drawn in to where the hips meet it."""
        if self.strip.closed or len(self._sections) != 3:
            return ring
        ends = {self._sections[1][0]: self._hip(first=True), self._sections[1][-1]: self._hip(first=False)}
        return [ends.get(point, point) for point in ring]

    def _hip(self, *, first: bool) -> int:
        """Returns the end of the ridge."""
        ridge, (share, height) = self._sections[1], self.roof.profile[1]
        hip = self.roof.hips_m[0 if first else 1]
        if hip == 0.0:
            return ridge[0 if first else -1]
        line = self.strip.across(share)
        start, ahead = (line[0], line[1]) if first else (line[-1], line[-2])
        x, y = start + (ahead - start) / np.linalg.norm(ahead - start) * hip
        return self.builder.point(float(x), float(y), self.base_m + height)

    def _add_end(self, *, first: bool) -> None:
        """Adds the end wall, up to the roof's cross-section or, below a hip, to the eaves."""
        at, k = (0, 0) if first else (-1, self.strip.num_segments - 1)
        (outer, inner), lines = self._low, [line[at] for line in self._sections]
        base = [inner[at], outer[at]] if first else [outer[at], inner[at]]
        upward = lines if first else lines[::-1]
        side = "first" if first else "last"
        if self.roof.hips_m[0 if first else 1] == 0.0:
            self.walls[side, k] = self.builder.face(SurfaceKind.WALL, base + upward)
            return
        self.walls[side, k] = self.builder.face(SurfaceKind.WALL, [*base, upward[0], upward[-1]])
        self.builder.face(SurfaceKind.ROOF, [upward[-1], upward[0], self._hip(first=first)])

    def wall_line(self, side: str, k: int) -> tuple[int, int]:
        """Returns the base points of a wall from left to right as seen from outside."""
        first, second = self.builder.outline(self.walls[side, k])[:2]
        return first, second


def wing_direction(strip: Strip, k: int) -> tuple[Points, Points, float]:
    """Returns a wing's unit direction, the unit direction across it, and the length of its outer side."""
    edge = strip.outer[strip.next_corner(k)] - strip.outer[k]
    along = edge_directions(strip.outer)[k]
    return along, left_of(along), float(np.linalg.norm(edge))
