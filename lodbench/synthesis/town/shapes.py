"""Plane geometry of the town: rings of corners, (N, 2) metres, counter-clockwise unless said."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from lodbench.citymodel.model import SurfaceKind
from lodbench.errors import DatasetError, nearest_names
from lodbench.params import read_settings, to_params
from lodbench.synthesis.objects import palette
from lodbench.synthesis.photo import LookRanges

Points = NDArray[np.float64]


def area(ring: Points) -> float:
    """Returns the signed area, positive when counter-clockwise."""
    x, y = ring[:, 0], ring[:, 1]
    return 0.5 * float(np.sum(x * _ahead(y) - _ahead(x) * y))


def edge_directions(ring: Points) -> Points:
    """Returns the unit direction of each edge, (N, 2), from a corner to the next."""
    edges = _ahead(ring) - ring
    return np.asarray(edges / np.linalg.norm(edges, axis=1, keepdims=True))


def edge_lengths(ring: Points) -> Points:
    """Returns the length of each edge, (N,), from a corner to the next."""
    return np.asarray(np.linalg.norm(_ahead(ring) - ring, axis=1))


def _ahead(ring: Points) -> Points:
    """Returns for each corner the next; ``np.roll`` takes several times as long for so few."""
    return np.concatenate([ring[1:], ring[:1]])


def left_of(direction: Points) -> Points:
    """Returns directions, (..., 2), turned by 90 degrees to the left."""
    turned = np.empty_like(direction)
    turned[..., 0], turned[..., 1] = -direction[..., 1], direction[..., 0]
    return turned


def cut(ring: Points, point: Points, inward: Points) -> Points:
    """Returns the part of a convex ring on the inward side of a line through a point; may be empty."""
    side = (ring - point) @ inward
    kept: list[Points] = []
    for k in range(len(ring)):
        here, ahead = side[k], side[(k + 1) % len(ring)]
        if here >= 0:
            kept.append(ring[k])
        if here * ahead < 0:
            kept.append(ring[k] + (ring[(k + 1) % len(ring)] - ring[k]) * (here / (here - ahead)))
    return np.array(kept).reshape(-1, 2)


def parallel(line: Points, distances: Points, *, closed: bool) -> Points:
    """Returns a polyline, (K, 2), moved to its left, each segment by its own distance, with mitred corners.

    There are K - 1 distances, or K of a closed ring, whose last corner joins the first.
    """
    along = edge_directions(line)
    left = left_of(along)
    moved = np.empty_like(line)
    for k in range(len(line)):
        if not closed and k == 0:
            moved[k] = line[k] + left[0] * distances[0]
        elif not closed and k == len(line) - 1:
            moved[k] = line[k] + left[k - 1] * distances[k - 1]
        else:
            normals = np.stack([left[k - 1], left[k]])
            moved[k] = line[k] + np.linalg.solve(normals, np.array([distances[k - 1], distances[k]]))
    return moved


def inset(ring: Points, distance: float) -> Points | None:
    """Returns a ring shrunk by a distance with the same corners, or None where an edge would vanish."""
    inner = parallel(ring, np.full(len(ring), distance), closed=True)
    edges = _ahead(inner) - inner
    lengths = np.sum(edges * edge_directions(ring), axis=1)
    return inner if lengths.min() > 1.0 and area(inner) > 0 else None


def corner_angles_deg(ring: Points) -> Points:
    """Returns the inner angle at each corner, (N,), degrees."""
    out = edge_directions(ring)
    into = np.roll(out, 1, axis=0)
    turn = np.arctan2(into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0], np.sum(into * out, axis=1))
    return np.asarray(180.0 - np.degrees(turn))


def contains(ring: Points, points: Points) -> NDArray[np.bool_]:
    """Returns which points, (M, 2), lie inside a ring of any shape."""
    return np.asarray(shapely.contains_xy(shapely.Polygon(ring), points))


def keeps_apart(a: Points, b: Points, gap_m: float) -> bool:
    """Returns whether some edge of two convex rings separates them by at least a gap."""
    for first, second in ((a, b), (b, a)):
        outward = -left_of(edge_directions(first))
        distance = np.einsum("kc,kmc->km", outward, second[None, :, :] - first[:, None, :]).min(axis=1)
        if distance.max() >= gap_m - 1e-9:
            return True
    return False


def box_of(ring: Points) -> tuple[Points, float, float]:
    """Returns the direction, length and width of the smallest box around a ring, along one of its edges."""
    axes = [np.stack([along, left_of(along)]) for along in edge_directions(ring)]
    spans = [np.ptp(ring @ pair.T, axis=0).tolist() for pair in axes]
    # Boxes along parallel edges differ by what floats round: the first of them is taken.
    least = min(range(len(axes)), key=lambda k: round(spans[k][0] * spans[k][1], 6))
    (along, across), (length, width) = axes[least], spans[least]
    return (along, length, width) if length >= width else (across, width, length)


def rectangles(middle: Points, along: Points, length: float, width: float) -> Points:
    """Returns rectangles, (..., 4, 2), counter-clockwise, around middles, (..., 2), along unit directions."""
    u, v = 0.5 * length * along, 0.5 * width * left_of(along)
    return np.stack([middle - u - v, middle + u - v, middle + u + v, middle - u + v], axis=-2)


def offset_line(line: Points, distance: float) -> Points:
    """Returns a polyline, (K, 2), moved to its left."""
    way = np.gradient(line, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return np.asarray(line + distance * left_of(way))


def along_line(line: Points, at: Points) -> tuple[Points, Points]:
    """Returns positions, (N, 2), and unit directions, (N, 2), at distances along a polyline."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    starts = np.concatenate([[0.0], np.cumsum(steps)])
    k = np.clip(np.searchsorted(starts, at, side="right") - 1, 0, len(steps) - 1)
    direction = np.diff(line, axis=0)[k] / steps[k, None]
    return line[k] + (at - starts[k])[:, None] * direction, direction


def length_of(line: Points) -> float:
    """Returns the length of a polyline, metres."""
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


@dataclass(slots=True)
class Face:
    """A planar polygon: rings of point indices, the outline first, then holes.

    Viewed from outside the solid the outline runs counter-clockwise and holes clockwise.
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
        """Cuts a hole into a face; the ring runs clockwise viewed from outside."""
        self._faces[face].rings.append(list(ring))

    def add_opening(self, face: int, corners: Points, *, is_door: bool = False) -> None:
        """Cuts a window or a door, (N, 3) counter-clockwise viewed from outside, into a face."""
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


class TownLook(NamedTuple):
    """What two towns differ in besides chance; ``looks.yaml`` says what each is."""

    name: str
    rings: float
    relief: float
    half_hipped: float
    shed: float
    trees: float
    broadleaf: float
    walls: Points  # colours, (N, 3) RGB from 0 to 255, as the next five
    tiles: Points
    flat_roofs: Points
    grass: Points
    road: Points
    water: Points
    days: LookRanges


@cache
def look_named(name: str) -> TownLook:
    """Returns a look.

    Raises:
        DatasetError: There is none of that name.
    """
    looks = read_settings((files("lodbench.synthesis.town") / "looks.yaml").read_text(encoding="utf-8"))
    if name not in looks:
        raise DatasetError(f"The demo town has no look {name!r}.", nearest_names(name, looks))
    stated = dict(looks[name])
    days = to_params(stated.pop("days"), LookRanges, "days")
    colours = {key: palette(value) for key, value in stated.items() if isinstance(value, str)}
    return TownLook(name=name, days=days, **stated | colours)
