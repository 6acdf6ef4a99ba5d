"""Closed solids as planar faces over shared points: every edge belongs to two faces, once each way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lodbench.citymodel.model import SurfaceKind
from lodbench.synthesis.town.shapes import Points


@dataclass(slots=True)
class Face:
    """A planar polygon: rings of point indices, the outline first, then holes.

    Seen from outside the solid the outline runs counter-clockwise and holes clockwise.
    """

    kind: SurfaceKind  # what it is part of
    rings: list[list[int]]
    host: int | None = None  # of an opening, the number of the face whose hole it fills
    is_door: bool = False  # whether an opening is a door, not a window


class Solid(NamedTuple):
    """A body bounded by faces."""

    points: Points  # (P, 3) float64 local metres, rounded to millimetres or tenths of them
    faces: tuple[Face, ...]  # its faces, normals outward

    @property
    def height_m(self) -> float:
        """Returns the height from its lowest to its highest point."""
        return float(np.ptp(self.points[:, 2]))

    def faces_with_openings(self) -> list[tuple[int, list[int]]]:
        """Returns the numbers of all faces that are no openings, each with those of its own."""
        openings: dict[int, list[int]] = {k: [] for k, face in enumerate(self.faces) if face.host is None}
        for k, face in enumerate(self.faces):
            if face.host is not None:
                openings[face.host].append(k)
        return list(openings.items())


@dataclass(slots=True)
class SolidBuilder:
    """Collects points and faces; equal points, to the millimetre, are one."""

    # Steps that coordinates are rounded to. Walls with many windows need finer ones: where the edges of
    # windows line up their triangles are slivers, whose area a millimetre changes.
    per_metre: int = 1000
    _index: dict[tuple[int, int, int], int] = field(default_factory=dict)
    _points: list[tuple[int, int, int]] = field(default_factory=list)
    _faces: list[Face] = field(default_factory=list)

    def point(self, x: float, y: float, z: float) -> int:
        """Returns the index of a point in local metres."""
        n = self.per_metre
        key = (round(x * n), round(y * n), round(z * n))
        number = self._index.setdefault(key, len(self._points))
        if number == len(self._points):
            self._points.append(key)
        return number

    def points(self, plan: Points, height: float) -> list[int]:
        """Returns the indices of plan positions, (N, 2), at one height."""
        return [self.point(x, y, height) for x, y in plan.tolist()]

    def position(self, index: int) -> Points:
        """Returns a point, (3,) local metres."""
        return np.array(self._points[index]) / self.per_metre

    def face(self, kind: SurfaceKind, outline: Sequence[int], *holes: Sequence[int]) -> int:
        """Adds a face, leaving out corners that fell together, and returns its number."""
        rings = [
            [point for k, point in enumerate(ring) if point != ring[k - 1]] for ring in (outline, *holes)
        ]
        self._faces.append(Face(kind, rings))
        return len(self._faces) - 1

    def walls(
        self, low: Sequence[int], high: Sequence[int], kind: SurfaceKind = SurfaceKind.WALL
    ) -> list[int]:
        """Adds faces between two lines of points, one above the other; returns their numbers."""
        edges = zip(pairwise(low), pairwise(high), strict=True)
        return [self.face(kind, [a, b, d, c]) for (a, b), (c, d) in edges if (a, b) != (c, d)]

    def corners(self, face: int) -> Points:
        """Returns the outline of a face, (N, 3) local metres."""
        return np.array([self._points[point] for point in self._faces[face].rings[0]]) / self.per_metre

    def add_hole(self, face: int, ring: Sequence[int]) -> None:
        """Cuts a hole into a face; the ring runs clockwise seen from outside."""
        self._faces[face].rings.append(list(ring))

    def add_opening(self, face: int, corners: Points, *, is_door: bool = False) -> None:
        """Cuts a window or a door, (N, 3) counter-clockwise seen from outside, into a face."""
        ring = [self.point(*corner) for corner in corners.tolist()]
        self.add_hole(face, ring[::-1])
        self._faces.append(Face(SurfaceKind.OPENING, [ring], face, is_door))

    def detour(self, face: int, start: int, end: int, way: Sequence[int]) -> None:
        """Leads the edge from ``start`` to ``end`` of a face's rings over other points."""
        for ring in self._faces[face].rings:
            for k, point in enumerate(ring):
                if point == start and ring[(k + 1) % len(ring)] == end:
                    ring[k + 1 : k + 1] = list(way)
                    return
        raise ValueError(f"face {face} has no edge from {start} to {end}")

    def build(self) -> Solid:
        """Returns the solid."""
        return Solid(np.array(self._points, dtype=np.float64) / self.per_metre, tuple(self._faces))


def prism(rings: Sequence[Points], base_m: float, top_m: float, kind: SurfaceKind | None = None) -> Solid:
    """Returns a flat-roofed block, all its faces of one kind; without one, ground, walls and roof.

    Of the plan's rings, (N, 2), the outline runs counter-clockwise, then holes clockwise.
    """
    builder = SolidBuilder()
    low = [builder.points(ring, base_m) for ring in rings]
    high = [builder.points(ring, top_m) for ring in rings]
    builder.face(kind or SurfaceKind.GROUND, *[ring[::-1] for ring in low])
    builder.face(kind or SurfaceKind.ROOF, *high)
    for bottom, top in zip(low, high, strict=True):
        builder.walls([*bottom, bottom[0]], [*top, top[0]], kind or SurfaceKind.WALL)
    return builder.build()
