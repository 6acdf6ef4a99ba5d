"""Closed blocks, as in old towns: row houses all around, wall to wall, with a courtyard behind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.town.building import Plan
from lodbench.synthesis.town.details import Annex, RoofBox
from lodbench.synthesis.town.extrusion import Strip
from lodbench.synthesis.town.fittings import annex, chance, dormers, eaves, town_roof
from lodbench.synthesis.town.roofs import flat, gabled
from lodbench.synthesis.town.shapes import area, box_of, corner_angles_deg, edge_directions, inset, left_of
from lodbench.synthesis.town.site import Site

Points = NDArray[np.float64]

# Courtyards are at least this wide between the back walls.
COURTYARD_M = 9.0
# Sharper corners than this make no rooms.
_LEAST_CORNER_DEG = 47.0
# A stretch of street shorter than this goes to the corner houses beside it.
_LEAST_ROW_M = 8.0


def closed_block(ring: Points, district: str, storeys: int, generator: np.random.Generator) -> list[Plan]:
    """Returns row houses all around a block, or nothing where its shape leaves no courtyard.

    Args:
        ring: The building line, (N, 2).
        district: Name of the district.
        storeys: Usual number of storeys.
        generator: Source of chance.
    """
    depth = float(generator.uniform(10.5, 13.0))
    if inset(ring, depth + COURTYARD_M / 2) is None:
        return []
    legs = _corner_legs(ring, depth, generator)
    if legs is None:
        return []
    block = _ClosedBlock(ring, depth, district, storeys, generator)
    block.add_corner_houses(legs)
    block.add_rows(legs)
    block.add_yard_buildings()
    return block.site.plans


def _corner_legs(ring: Points, depth: float, generator: np.random.Generator) -> Points | None:
    """Returns how far each corner house reaches back and ahead, (N, 2) metres, or None without room."""
    count, angles = len(ring), corner_angles_deg(ring)
    if angles.min() < _LEAST_CORNER_DEG:
        return None
    lengths = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
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


class _ClosedBlock:
    """A block while its houses are placed."""

    def __init__(
        self, ring: Points, depth: float, district: str, storeys: int, generator: np.random.Generator
    ) -> None:
        self.site = Site(ring)
        self._ring, self._along = ring, edge_directions(ring)
        self._depth, self._storeys = depth, storeys
        self._district, self._chances = district, generator

    def add_corner_houses(self, legs: Points) -> None:
        """Adds a house with two wings at every corner."""
        for k, corner in enumerate(self._ring):
            line = [corner - self._along[k - 1] * legs[k, 0], corner, corner + self._along[k] * legs[k, 1]]
            strip = Strip.bent(np.stack(line), [self._depth, self._depth])
            eave = eaves(self._storeys + chance(self._chances, 0.3), self._chances)
            self._place(Plan(strip, gabled(eave, self._pitch(36, 48), self._depth), *self._labels))

    def add_rows(self, legs: Points) -> None:
        """Shares the streets between the corner houses out among houses that touch, with rare gaps."""
        lengths = np.linalg.norm(np.roll(self._ring, -1, axis=0) - self._ring, axis=1)
        free = lengths - legs[:, 1] - np.roll(legs[:, 0], -1)
        for k in np.flatnonzero(free >= _LEAST_ROW_M / 2):
            count = max(1, round(free[k] / self._chances.uniform(11.0, 16.0)))
            shares = self._chances.uniform(0.7, 1.3, size=count)
            edges = legs[k, 1] + np.concatenate([[0.0], np.cumsum(shares / shares.sum())]) * free[k]
            for left, width in zip(edges[:-1], np.diff(edges), strict=True):
                if not chance(self._chances, 0.06):
                    self._add_row_house(self._ring[k] + self._along[k] * left, self._along[k], float(width))

    def _add_row_house(self, corner: Points, along: Points, width: float) -> None:
        """Adds one house of a row; some narrow old ones turn their gable to the street."""
        depth = self._depth + float(self._chances.uniform(-2.0, 1.2))
        storeys = max(2, self._storeys + int(self._chances.integers(-1, 2)))
        eave = eaves(storeys, self._chances)
        old = self._district == "old town"
        if old and width < depth and chance(self._chances, 0.3):
            strip = Strip.bar(corner + along * width, left_of(along), depth, width)
            self._place(Plan(strip, gabled(eave, self._pitch(42, 54), width), *self._labels))
            return
        strip = Strip.bar(corner, along, width, depth)
        roof = town_roof(eave, depth, self._chances, modern=0.05 if old else 0.2)
        extension: list[Annex | RoofBox] = []
        if width > 8.0 and chance(self._chances, 0.45):
            extension = annex("inner", width, eave, self._chances)
        self._place(Plan(strip, roof, *self._labels), extension)

    def _place(self, plan: Plan, extension: list[Annex | RoofBox] | None = None) -> None:
        """Places a house, perhaps with dormers; without its extension where that has no room."""
        details: list[Annex | RoofBox] = []
        if chance(self._chances, 0.55):
            details += dormers(plan.strip, plan.roof, self._chances)
        full = replace(plan, details=(*details, *(extension or ())))
        if not self.site.place(full, on_line=True):
            self.site.place(replace(plan, details=tuple(details)), on_line=True)

    def add_yard_buildings(self) -> None:
        """Adds workshops and sheds to the courtyard."""
        yard = inset(self._ring, self._depth + 3.0)
        if yard is None:
            return
        along, _, _ = box_of(self._ring)
        for _ in range(int(area(yard) / 260.0) + 1):
            corner = self._chances.uniform(yard.min(axis=0), yard.max(axis=0))
            length, width = self._chances.uniform((5.0, 4.0), (13.0, 7.0)).tolist()
            height = float(self._chances.uniform(2.8, 5.5))
            roof = flat(height) if chance(self._chances, 0.6) else gabled(height, 28.0, width)
            plan = Plan(Strip.bar(corner, along, length, width), roof, "commercial", self._district)
            if Site(yard).place(plan):
                self.site.place(plan, 1.2)

    @property
    def _labels(self) -> tuple[str, str]:
        return "residential", self._district

    def _pitch(self, low: float, high: float) -> float:
        return float(self._chances.uniform(low, high))
