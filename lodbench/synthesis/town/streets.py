"""The street plan: a disc of land cut into blocks by ever smaller streets, then gently bent.

The first cut is the river. Every further cut is a street; cuts lean towards rings and spokes around
the market square near the middle and are jittered everywhere, and a smooth warp bends the straight
streets, so that no two blocks are alike.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
