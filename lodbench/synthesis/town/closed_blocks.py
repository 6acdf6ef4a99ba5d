"""Closed blocks, as in old towns: row houses all around, wall to wall, with a courtyard behind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lodbench.synthesis.town.extrusion import Strip
from lodbench.synthesis.town.fittings import Detail, annex, chance, dormers, eaves, town_roof
from lodbench.synthesis.town.roofs import Roof, flat, gabled
from lodbench.synthesis.town.shapes import (
    Points,
    area,
    corner_angles_deg,
    edge_directions,
    edge_lengths,
    inset,
    left_of,
)
from lodbench.synthesis.town.site import Site

# Courtyards are at least this wide between the back walls.
COURTYARD_M = 9.0
# Sharper corners than this make no rooms.
_LEAST_CORNER_DEG = 47.0
# A stretch of street shorter than this goes to the corner houses beside it.
_LEAST_ROW_M = 8.0


def add_closed_block(site: Site, storeys: int) -> None:
    """Adds row houses of some storeys all around, or nothing where the block's shape leaves no courtyard."""
    depth = float(site.chances.uniform(10.5, 13.0))
    if inset(site.ring, depth + COURTYARD_M / 2) is None:
        return
    legs = _corner_legs(site.ring, depth, site.chances)
    if legs is not None:
        block = _ClosedBlock(site, depth, storeys, legs)
        block.add_corner_houses()
        block.add_rows()
        block.add_yard_buildings()


def _corner_legs(ring: Points, depth: float, generator: np.random.Generator) -> Points | None:
    """Returns how far each corner house reaches back and ahead, (N, 2) metres, or None without room."""
    count, angles, lengths = len(ring), corner_angles_deg(ring), edge_lengths(ring)
    if angles.min() < _LEAST_CORNER_DEG:
        return None
    least = np.maximum(depth / np.tan(np.radians(angles) / 2), 0.0) + 2.5
    legs = least[:, None] + generator.uniform(1.5, 5.0, size=(count, 2))
    for k in range(count):
        m = (k + 1) % count
        if lengths[k] - legs[k, 1] - legs[m, 0] >= _LEAST_ROW_M:
            continue
        spare = lengths[k] - least[k] - least[m]
        if spare < 0:
            return None
        legs[k, 1], legs[m, 0] = least[k] + spare / 2, lengths[k] - least[k] - spare / 2
    return legs


@dataclass(frozen=True, slots=True, eq=False)
class _ClosedBlock:
    """A block while its houses are placed."""

    site: Site  # the block
    depth: float  # of its houses, metres
    storeys: int  # usual number of storeys
    legs: Points  # (N, 2) how far each corner house reaches back and ahead, metres

    def add_corner_houses(self) -> None:
        """Adds a house with two wings at every corner."""
        along, chances = edge_directions(self.site.ring), self.site.chances
        for k, corner in enumerate(self.site.ring):
            line = [corner - along[k - 1] * self.legs[k, 0], corner, corner + along[k] * self.legs[k, 1]]
            eave = eaves(self.storeys + chance(chances, 0.3), chances)
            roof = gabled(eave, float(chances.uniform(36, 48)), self.depth)
            self._place(Strip.bent(np.stack(line), [self.depth, self.depth]), roof)

    def add_rows(self) -> None:
        """Shares the streets between the corner houses out among houses that touch, with rare gaps."""
        ring, chances = self.site.ring, self.site.chances
        free = edge_lengths(ring) - self.legs[:, 1] - np.roll(self.legs[:, 0], -1)
        for k in np.flatnonzero(free >= _LEAST_ROW_M / 2):
            along = edge_directions(ring)[k]
            count = max(1, round(free[k] / chances.uniform(11.0, 16.0)))
            shares = chances.uniform(0.7, 1.3, size=count)
            edges = self.legs[k, 1] + np.concatenate([[0.0], np.cumsum(shares / shares.sum())]) * free[k]
            for left, width in zip(edges[:-1], np.diff(edges), strict=True):
                if not chance(chances, 0.06):
                    self._add_row_house(ring[k] + along * left, along, float(width))

    def _add_row_house(self, corner: Points, along: Points, width: float) -> None:
        """Adds one house of a row; some narrow old ones turn their gable to the street."""
        chances, is_old = self.site.chances, self.site.district == "old town"
        depth = self.depth + float(chances.uniform(-2.0, 1.2))
        eave = eaves(max(2, self.storeys + int(chances.integers(-1, 2))), chances)
        if is_old and width < depth and chance(chances, 0.3):
            strip = Strip.bar(corner + along * width, left_of(along), depth, width)
            self._place(strip, gabled(eave, float(chances.uniform(42, 54)), width))
            return
        roof = town_roof(eave, depth, chances, modern=0.05 if is_old else 0.2)
        extension = annex(width, eave, chances) if width > 8.0 and chance(chances, 0.45) else []
        self._place(Strip.bar(corner, along, width, depth), roof, extension)

    def _place(self, strip: Strip, roof: Roof, extension: Sequence[Detail] = ()) -> None:
        """Places a house, perhaps with dormers; without its extension where that has no room."""
        windows = dormers(strip, roof, self.site.chances) if chance(self.site.chances, 0.55) else []
        if not self.site.place(strip, roof, details=[*windows, *extension], on_line=True):
            self.site.place(strip, roof, details=windows, on_line=True)

    def add_yard_buildings(self) -> None:
        """Adds workshops and sheds to the courtyard."""
        site, chances = self.site, self.site.chances
        yard = inset(site.ring, self.depth + 3.0)
        if yard is None:
            return
        for _ in range(int(area(yard) / 260.0) + 1):
            corner = chances.uniform(yard.min(axis=0), yard.max(axis=0))
            length, width = chances.uniform((5.0, 4.0), (13.0, 7.0)).tolist()
            height = float(chances.uniform(2.8, 5.5))
            roof = flat(height) if chance(chances, 0.6) else gabled(height, 28.0, width)
            strip = Strip.bar(corner, site.along, length, width)
            site.place(strip, roof, "commercial", gap_m=1.2, yard=yard)
