"""A block while it is built up: what stands on it already, and whether one more plan fits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.town.building import Plan, pieces_of
from lodbench.synthesis.town.shapes import box_of, contains, keeps_apart, left_of

Points = NDArray[np.float64]


class Site:
    """The land of one block and the plans placed on it.

    Attributes:
        ring: Building line, (N, 2): nothing stands outside.
        plans: What was placed, in order.
    """

    def __init__(self, ring: Points) -> None:
        self.ring = ring
        self.plans: list[Plan] = []
        self._pieces: list[Points] = []
        self._middles = np.empty((0, 2))
        self._reach = np.empty(0)

    def place(self, plan: Plan, gap_m: float = 0.0, *, on_line: bool = False) -> bool:
        """Places a plan if it lies inside the building line and keeps a gap to all others.

        Args:
            plan: The plan.
            gap_m: Least distance to what stands; 0 lets walls touch.
            on_line: Whether it is laid out along the building line, so need not be tested against it.

        Returns:
            Whether it was placed.
        """
        pieces = pieces_of(plan)
        if not on_line and not all(contains(self.ring, _outline(piece)).all() for piece in pieces):
            return False
        if any(not self._is_free(piece, gap_m) for piece in pieces):
            return False
        self.plans.append(plan)
        self._pieces += pieces
        middles = np.stack([piece.mean(axis=0) for piece in pieces])
        reach = [float(np.linalg.norm(p - m, axis=1).max()) for p, m in zip(pieces, middles, strict=True)]
        self._middles = np.concatenate([self._middles, middles])
        self._reach = np.concatenate([self._reach, reach])
        return True

    def _is_free(self, piece: Points, gap_m: float) -> bool:
        middle = piece.mean(axis=0)
        reach = float(np.linalg.norm(piece - middle, axis=1).max())
        distance = np.linalg.norm(self._middles - middle, axis=1)
        near = np.flatnonzero(distance < self._reach + reach + gap_m)
        return all(keeps_apart(piece, self._pieces[int(k)], gap_m) for k in near)


def _outline(piece: Points) -> Points:
    """Returns corners and edge middles: enough to test against a nearly convex ring."""
    return np.concatenate([piece, 0.5 * (piece + np.roll(piece, -1, axis=0))])


def places_on(ring: Points, spacing_m: float, generator: np.random.Generator) -> list[Points]:
    """Returns places to try on a block, in random order: a jittered grid along its own directions."""
    along, _, _ = box_of(ring)
    axes = np.stack([along, left_of(along)])
    spans = ring @ axes.T
    steps = [
        np.arange(low + 1.0, high, spacing_m)
        for low, high in zip(spans.min(axis=0), spans.max(axis=0), strict=True)
    ]
    grid = np.stack([axis.ravel() for axis in np.meshgrid(*steps)], axis=1)
    grid += generator.uniform(0.0, 4.0, size=grid.shape)
    return list(generator.permutation(grid) @ axes)
