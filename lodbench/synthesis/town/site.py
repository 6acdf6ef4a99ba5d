"""A block while it is built up: what stands on it already, and whether one more plan fits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lodbench.synthesis.town.buildings import Plan
from lodbench.synthesis.town.extrusion import Strip
from lodbench.synthesis.town.fittings import Detail
from lodbench.synthesis.town.roofs import Roof
from lodbench.synthesis.town.shapes import Points, box_of, contains, keeps_apart, left_of


class Site:
    """The land of one block inside its building line, (N, 2), the plans placed on it, and their chances."""

    def __init__(self, ring: Points, district: str, chances: np.random.Generator) -> None:
        self.ring, self.district, self.chances = ring, district, chances
        self.along, _, _ = box_of(ring)  # (2,) unit, along the longer side of the smallest box around it
        self.plans: list[Plan] = []  # what was placed, in order
        self._pieces = np.empty((0, 4, 2))

    def place(
        self,
        strip: Strip,
        roof: Roof,
        function: str = "residential",
        details: Sequence[Detail] = (),
        *,
        gap_m: float = 0.0,
        yard: Points | None = None,
        on_line: bool = False,
    ) -> bool:
        """Places a building inside the building line, a gap from all others; returns whether there was room.

        A gap of 0 lets walls touch. What is laid out along the building line need not be tested against it;
        with a ``yard``, (N, 2), it must lie inside of that part of the block.
        """
        plan = Plan(strip, roof, function, self.district, tuple(details))
        ring, pieces = self.ring if yard is None else yard, plan.pieces
        # Corners and edge middles are enough to test against a nearly convex ring.
        outlines = [np.concatenate([piece, 0.5 * (piece + np.roll(piece, -1, axis=0))]) for piece in pieces]
        if not on_line and not all(contains(ring, outline).all() for outline in outlines):
            return False
        if not all(self._is_free(piece, gap_m) for piece in pieces):
            return False
        self.plans.append(plan)
        self._pieces = np.concatenate([self._pieces, pieces])
        return True

    def _is_free(self, piece: Points, gap_m: float) -> bool:
        """Returns whether a convex piece keeps a gap to all that stands; of most, circles around tell."""
        pieces = np.concatenate([[piece], self._pieces])
        middles = pieces.mean(axis=1)
        radii = np.linalg.norm(pieces - middles[:, None], axis=2).max(axis=1)
        distance = np.linalg.norm(middles - middles[0], axis=1)
        near = np.flatnonzero(distance[1:] < radii[1:] + radii[0] + gap_m)
        return all(keeps_apart(piece, self._pieces[k], gap_m) for k in near)

    def places(self, spacing_m: float) -> list[Points]:
        """Returns places to try, in random order: a jittered grid along its own directions."""
        axes = np.stack([self.along, left_of(self.along)])
        spans = self.ring @ axes.T
        steps = [
            np.arange(low + 1.0, high, spacing_m)
            for low, high in zip(spans.min(axis=0), spans.max(axis=0), strict=True)
        ]
        grid = np.stack([axis.ravel() for axis in np.meshgrid(*steps)], axis=1)
        grid += self.chances.uniform(0.0, 4.0, size=grid.shape)
        return list(self.chances.permutation(grid) @ axes)
