"""The street plan: a disc of land cut into blocks by ever smaller streets, then gently bent.

The first cut is the river. Every further cut is a street; cuts lean towards rings and spokes around
the market square near the middle and are jittered everywhere, and a smooth warp bends the straight
streets, so that no two blocks are alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.town.shapes import Points, area, box_of, cut, edge_directions, left_of

TOWN_RADIUS_M = 505.0
_RIVER_WIDTH_M = 44.0
_RIVER_AT_M = 225.0
# The river runs on this far to either side of town.
_RIVER_REACH_M = 2400.0
# Street widths by the generation of the cut: avenues, streets, lanes.
_STREET_WIDTHS_M = (22.0, 17.0, 14.0, 12.0, 10.5)
# Distances from the middle of town, metres, and the usual area of blocks there.
_BLOCK_M2 = (0.0, 180.0, 320.0, 520.0), (6200.0, 8600.0, 10500.0, 14000.0)
# Edges longer than this may bend when they are warped.
_BEND_EVERY_M = 60.0
# A corner nearer to a straight line than this is no corner.
_BEND_LEAST_M = 0.9


class Block(NamedTuple):
    """Land between streets."""

    ring: Points  # its edge along the kerbs, (N, 2) local metres, counter-clockwise, nearly convex
    beyond_river: bool  # whether it lies on the far bank

    @property
    def center(self) -> Points:
        """Returns the mean of its corners, (2,)."""
        return np.asarray(self.ring.mean(axis=0))


class Street(NamedTuple):
    """A street between two crossings, or to the edge of town."""

    line: Points  # (K, 2) its middle, local metres
    width_m: float  # from kerb to kerb


class StreetPlan(NamedTuple):
    """The blocks of a town, the streets between them, and its river."""

    blocks: tuple[Block, ...]  # all blocks; the first is the market square
    to_river: Points  # (2,) unit direction from the middle of town to the river
    # The built-up land on either side of the river, (N, 2) rings: blocks and streets.
    banks: tuple[Points, Points]
    streets: tuple[Street, ...]  # all streets, wide ones first
    river: Points  # (K, 2) the middle line of the river, far beyond the town at both ends


def draw_streets(generator: np.random.Generator, rings: float) -> StreetPlan:
    """Returns a street plan whose streets lean, from 0 to 1, towards rings and spokes around the middle."""
    angles = np.sort(np.linspace(0, 2 * np.pi, 14, endpoint=False) + generator.uniform(-0.1, 0.1, 14))
    radii = TOWN_RADIUS_M * generator.uniform(0.9, 1.08, 14)
    land = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)
    turn = generator.uniform(0, 2 * np.pi)
    to_river = np.array([np.cos(turn), np.sin(turn)])
    bend = _Warp.draw(generator)
    blocks, banks, cuts = [], [], []
    for sign in (-1.0, 1.0):
        bank = cut(land, to_river * (_RIVER_AT_M + sign * _RIVER_WIDTH_M / 2), sign * to_river)
        banks.append(bend.line(bank, closed=True))
        divider = _Divider(generator, rings)
        for ring in divider.divide(bank, 0):
            bent = _without_flat_corners(bend.line(ring, closed=True))
            blocks.append(Block(bent, beyond_river=sign > 0))
        cuts += divider.streets
    blocks.sort(key=lambda block: float(np.hypot(*block.center)))
    streets = [Street(bend.line(street.line, closed=False), street.width_m) for street in cuts]
    streets.sort(key=lambda street: -street.width_m)
    river = to_river * _RIVER_AT_M + np.outer([-_RIVER_REACH_M, _RIVER_REACH_M], left_of(to_river))
    middle = bend.line(river, closed=False)
    return StreetPlan(tuple(blocks), to_river, (banks[0], banks[1]), tuple(streets), middle)


class _Divider:
    """Cuts land into blocks, and remembers the streets it cut them with."""

    def __init__(self, generator: np.random.Generator, rings: float) -> None:
        self._generator, self._rings = generator, rings
        self.streets: list[Street] = []

    def divide(self, ring: Points, generation: int) -> list[Points]:
        """Returns the blocks that land falls into, each cut by a street narrower than the last."""
        along, length, _ = box_of(ring)
        middle = ring.mean(axis=0)
        # Blocks are small and dense in the old town.
        usual = float(np.interp(np.hypot(*middle), *_BLOCK_M2))
        if area(ring) < usual * self._generator.uniform(0.75, 1.3):
            return [ring]
        through = middle + along * length * self._generator.uniform(-0.09, 0.09)
        across = self._street_normal(along, through)
        width = _STREET_WIDTHS_M[min(generation, len(_STREET_WIDTHS_M) - 1)]
        width *= self._generator.uniform(0.85, 1.2)
        halves = [cut(ring, through + side * across * width / 2, side * across) for side in (-1.0, 1.0)]
        reach = (ring - through) @ left_of(across)
        whole = through + np.outer([reach.min() - 1.0, reach.max() + 1.0], left_of(across))
        self.streets.append(Street(_clipped(whole, ring), float(width)))
        return [block for half in halves if len(half) >= 3 for block in self.divide(half, generation + 1)]

    def _street_normal(self, along: Points, through: Points) -> Points:
        """Returns the normal of a street that cuts land across its length, (2,) unit.

        Near the middle of town it is turned towards the nearest ring or spoke.
        """
        radius = float(np.hypot(*through))
        angle = float(np.arctan2(along[1], along[0]))
        spoke = float(np.arctan2(through[1], through[0]))
        quarter = np.pi / 2
        off = (spoke - angle + quarter / 2) % quarter - quarter / 2
        pull = self._rings * float(np.interp(radius, [20.0, 60.0, 300.0, 420.0], [0.0, 0.8, 0.5, 0.0]))
        turned = angle + pull * off + self._generator.normal(0.0, 0.09)
        return np.array([np.cos(turned), np.sin(turned)])


def _clipped(line: Points, ring: Points) -> Points:
    """Returns the part of a straight line, (2, 2), inside a convex ring."""
    way = line[1] - line[0]
    first, last = 0.0, 1.0
    for corner, inward in zip(ring, left_of(edge_directions(ring)), strict=True):
        rate, off = float(way @ inward), float((line[0] - corner) @ inward)
        if abs(rate) > 1e-12:
            first, last = (max(first, -off / rate), last) if rate > 0 else (first, min(last, -off / rate))
    return np.stack([line[0] + first * way, line[0] + last * way])


class _Warp(NamedTuple):
    """A smooth displacement of the plan: waves much longer than a block."""

    # (N, 5) rows of wave vector x, y (radians per metre), phase (radians), displacement x, y (m).
    waves: Points

    @classmethod
    def draw(cls, generator: np.random.Generator) -> _Warp:
        waves = []
        for wavelength, amplitude in ((620.0, 20.0), (480.0, 13.0), (340.0, 6.0)):
            turn, push, phase = generator.uniform(0, 2 * np.pi, 3)
            along, aside = (np.array([np.cos(angle), np.sin(angle)]) for angle in (turn, push))
            waves.append([*(2 * np.pi / wavelength * along), phase, *(amplitude * aside)])
        return cls(np.array(waves))

    def line(self, line: Points, *, closed: bool) -> Points:
        """Returns a displaced polyline with corners every so often, so that it follows the bend."""
        ahead = np.roll(line, -1, axis=0) if closed else line[1:]
        fine = []
        for start, end in zip(line if closed else line[:-1], ahead, strict=True):
            parts = max(1, round(float(np.hypot(*(end - start))) / _BEND_EVERY_M))
            fine += [start + (end - start) * (k / parts) for k in range(parts)]
        points = np.array(fine if closed else [*fine, line[-1]])
        phase = points @ self.waves[:, :2].T + self.waves[:, 2]
        return np.asarray(points + np.sin(phase) @ self.waves[:, 3:])


def _without_flat_corners(ring: Points) -> Points:
    """Returns a ring without corners that hardly stick out, and without edges shorter than 12 m."""
    while len(ring) > 3:
        before, after = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
        chord = after - before
        left = left_of(chord / np.linalg.norm(chord, axis=1, keepdims=True))
        stick = np.abs(np.sum((ring - before) * left, axis=1))
        stick[np.linalg.norm(after - ring, axis=1) < 12.0] *= 0.05
        least = int(np.argmin(stick))
        if stick[least] >= _BEND_LEAST_M:
            break
        ring = np.delete(ring, least, axis=0)
    return ring


# Hills: wavelength and amplitude in metres of waves much longer than a block.
_WAVES_M = ((900.0, 6.0), (620.0, 4.2), (380.0, 1.8), (240.0, 0.6))
# Across the valley: the bed of the river, its banks, and where the hills have their full height again.
_BED_M, _BANK_M, _VALLEY_M = 13.0, 19.0, 190.0
_BANK_HEIGHT_M = 2.6
_WATER_DEPTH_M = 1.6


@dataclass(frozen=True, eq=False)
class Terrain:
    """Ground heights: a slope up from the river and a few long waves, sunk into a valley along it."""

    base_m: float  # height at the river before the waves, metres above sea level
    rise: float  # metres of rise per metre away from the river
    waves: Points  # (N, 4) rows of wave vector x, y (radians per metre), phase (radians), amplitude (m)
    river: Points  # (K, 2) its middle line, local metres
    water_m: float  # height of the water

    @classmethod
    def draw(cls, generator: np.random.Generator, river: Points, relief: float) -> Terrain:
        """Returns hills that rise by some 30 m from a river to the edge of town."""
        waves = []
        for wavelength, amplitude in _WAVES_M:
            turn, phase = generator.uniform(0, 2 * np.pi, 2)
            number = 2 * np.pi / wavelength
            waves.append([number * np.cos(turn), number * np.sin(turn), phase, relief * amplitude])
        rise = relief * float(generator.uniform(0.02, 0.03))
        dry = cls(float(generator.uniform(180.0, 260.0)), rise, np.array(waves), river, -np.inf)
        lowest = float(dry._hills(river, np.zeros(len(river))).min())
        return replace(dry, water_m=round(lowest - _BANK_HEIGHT_M - 1.0, 2))

    def height(self, points: Points) -> Points:
        """Returns the ground height, (N,) metres, at local positions, (N, 2); the river's is its bed's."""
        distance = self.river_distance(points)
        bank = self.water_m + _BANK_HEIGHT_M
        share = np.clip((distance - _BANK_M) / (_VALLEY_M - _BANK_M), 0.0, 1.0)
        share = share * share * (3.0 - 2.0 * share)
        hills = bank + share * np.maximum(self._hills(points, distance) - bank, 0.5)
        depth = np.clip((_BANK_M - distance) / (_BANK_M - _BED_M), 0.0, 1.0)
        return np.asarray(hills - depth * (_BANK_HEIGHT_M + _WATER_DEPTH_M))

    def on_ground(self, points: Points, above_m: float = 0.0) -> Points:
        """Returns positions, (N, 2), with the height of the ground and a little more, (N, 3)."""
        return np.column_stack([points, self.height(points) + above_m])

    def river_distance(self, points: Points) -> Points:
        """Returns the distance, (N,) metres, of positions, (N, 2), from the middle of the river.

        Measured across the river where they lie, which is exact beside it and near enough elsewhere: the
        river bends gently and never turns back.
        """
        axes, s, off, bend = self._course
        at, side = (points @ axes).T
        lateral = np.abs(side - np.interp(at, s, off))
        return np.asarray(lateral / np.hypot(1.0, np.interp(at, s, bend)))

    @cached_property
    def _course(self) -> tuple[Points, Points, Points, Points]:
        """The axes (2, 2) along and across the river, where on them it runs, and how steeply it bends."""
        along = self.river[-1] - self.river[0]
        along = along / np.linalg.norm(along)
        axes = np.stack([along, left_of(along)], axis=1)
        s, off = (self.river @ axes).T
        return axes, s, off, np.gradient(off, s)

    def _hills(self, points: Points, distance: Points) -> Points:
        """Returns the heights as if there were no valley."""
        phase = points @ self.waves[:, :2].T + self.waves[:, 2]
        # The slope ends beyond the town: nobody lives on a mountain.
        far = 600.0 * np.tanh(distance / 600.0)
        return np.asarray(self.base_m + self.rise * far + np.sin(phase) @ self.waves[:, 3])


NOBODY = 0
_CELL_M = 0.5
# Sub-cell precision of the fill, as a power of two.
_SHIFT = 4


class Occupancy:
    """A grid over a square around the town's middle; cells hold 1 + the number of whoever is there.

    Of each number from 0 the convex pieces of plan, (N, 2) metres, are given; the square reaches half its
    side.
    """

    def __init__(self, pieces: Sequence[Sequence[Points]], reach_m: float) -> None:
        self._reach_m = reach_m
        count = 2 * round(reach_m / _CELL_M)
        self._cells = np.zeros((count, count), np.int32)
        for number, rings in enumerate(pieces):
            for ring in rings:
                # Pixel centres have whole numbers in OpenCV.
                corners = (ring + reach_m) / _CELL_M - 0.5
                fixed = np.round(corners * (1 << _SHIFT)).astype(np.int32)
                cv2.fillConvexPoly(self._cells, fixed, number + 1, lineType=cv2.LINE_8, shift=_SHIFT)

    def at(self, points: Points) -> NDArray[np.int32]:
        """Returns (N,) who is at places, (N, 2) metres: 1 + a number, or `NOBODY`."""
        cells = np.floor((points + self._reach_m) / _CELL_M).astype(np.int64)
        inside = ((cells >= 0) & (cells < len(self._cells))).all(axis=1)
        occupants = np.full(len(points), NOBODY, np.int32)
        occupants[inside] = self._cells[cells[inside, 1], cells[inside, 0]]
        return occupants

    def is_free_near(self, points: Points, gap_m: float) -> NDArray[np.bool_]:
        """Returns (N,) whether nobody is within about a distance of places, (N, 2) metres."""
        ring = np.linspace(0, 2 * np.pi, 8, endpoint=False)
        free = self.at(points) == NOBODY
        for x, y in gap_m * np.stack([np.cos(ring), np.sin(ring)], axis=1):
            free &= self.at(points + np.array([x, y])) == NOBODY
        return np.asarray(free)
