"""Streets of houses with gardens: alone, in pairs and in rows, with garages beside them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.town.building import Plan
from lodbench.synthesis.town.details import Annex, RoofBox
from lodbench.synthesis.town.extrusion import Strip
from lodbench.synthesis.town.fittings import annex, chance, dormers, eaves, house_roof
from lodbench.synthesis.town.roofs import flat, gabled
from lodbench.synthesis.town.shapes import edge_directions, left_of
from lodbench.synthesis.town.site import Site

Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Style:
    """How a street of houses is built up.

    Attributes:
        grow: Size of the houses against small ones.
        storeys: Least and greatest number of storeys.
        gap_m: Least and greatest distance between houses along the street.
        setback_m: Greatest depth of the front garden.
        rows: Share of terraces among what is built.
        garages: Share of houses with a garage.
    """

    grow: float
    storeys: tuple[int, int]
    gap_m: tuple[float, float]
    setback_m: float
    rows: float
    garages: float


SUBURB = Style(1.05, (1, 2), (6.0, 14.0), 4.5, 0.2, 0.22)
VILLAS = Style(1.35, (2, 3), (5.0, 11.0), 4.0, 0.15, 0.3)
OLD_LANES = Style(1.15, (2, 3), (0.8, 3.5), 1.2, 0.7, 0.1)


def houses_along_streets(
    ring: Points, district: str, style: Style, generator: np.random.Generator
) -> list[Plan]:
    """Returns houses on every side of a block.

    Args:
        ring: The building line, (N, 2).
        district: Name of the district.
        style: How it is built up.
        generator: Source of chance.
    """
    block = _Houses(ring, district, style, generator)
    lengths = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
    for along, start, length in zip(edge_directions(ring), ring, lengths, strict=True):
        block.add_street(start, along, float(length))
    return block.site.plans


class _Houses:
    """A block while its houses are placed."""

    def __init__(self, ring: Points, district: str, style: Style, generator: np.random.Generator) -> None:
        self.site = Site(ring)
        self._district, self._style, self._chances = district, style, generator
        self._gap_m = min(3.0, style.gap_m[0])

    def add_street(self, start: Points, along: Points, length: float) -> None:
        """Adds houses from one corner of the block to the next; streets like either rows or houses."""
        at = float(self._chances.uniform(1.0, 5.0))
        rows = self._style.rows * float(self._chances.choice([0.2, 2.0]))
        while at < length - 8.0:
            setback = float(self._chances.uniform(0.2, self._style.setback_m))
            corner = start + along * at + left_of(along) * setback
            if chance(self._chances, rows):
                at += self._add_terrace(corner, along, length - at)
            else:
                at += self._add_house(corner, along)
            at += float(self._chances.uniform(*self._style.gap_m))

    def _add_house(self, corner: Points, along: Points) -> float:
        """Adds a house and perhaps its garage; returns the length of street it takes."""
        length, depth = (self._style.grow * self._chances.uniform((9.5, 8.0), (14.0, 10.5))).tolist()
        strip = self._house_strip(corner, along, length, depth)
        storeys = int(self._chances.integers(*self._style.storeys, endpoint=True))
        roof = house_roof(eaves(storeys, self._chances), strip, self._chances)
        details: list[Annex | RoofBox] = []
        if chance(self._chances, 0.35):
            details += dormers(strip, roof, self._chances)
        if strip.num_segments == 1 and chance(self._chances, 0.4):
            wall = float(np.linalg.norm(strip.outer[1] - strip.outer[0]))
            details += annex("inner", wall, roof.eave_m, self._chances)
        plain = Plan(strip, roof, "residential", self._district)
        full = replace(plain, details=tuple(details))
        placed = self.site.place(full, self._gap_m) or self.site.place(plain, self._gap_m)
        if placed and chance(self._chances, self._style.garages):
            self._add_garage(corner + along * (length + 1.0), along)
        return float(length)

    def _house_strip(self, corner: Points, along: Points, length: float, depth: float) -> Strip:
        """Returns the plan of a house: a bar along or across the street, a square, or an L."""
        draw, inward = float(self._chances.random()), left_of(along)
        if draw < 0.18:
            wing, turn = 0.55 * depth + 1.0, corner + along * length
            return Strip.bent(np.stack([corner, turn, turn + inward * (depth + 2.0)]), [wing, wing])
        if draw < 0.28:
            return Strip.bar(corner, along, depth, depth)
        if draw < 0.5:
            return Strip.bar(corner + along * depth, inward, length, depth)
        return Strip.bar(corner, along, length, depth)

    def _add_garage(self, corner: Points, along: Points) -> None:
        """Adds a garage or shed beside or behind a house where there is room."""
        width, depth = self._chances.uniform((3.0, 5.5), (6.0, 7.5)).tolist()
        height = float(self._chances.uniform(2.4, 3.0))
        roof = flat(height) if chance(self._chances, 0.7) else gabled(height, 30.0, depth)
        back = left_of(along) * float(self._chances.uniform(3.0, 14.0))
        plan = Plan(Strip.bar(corner + back, along, width, depth), roof, "garage", self._district)
        self.site.place(plan, 0.6)

    def _add_terrace(self, corner: Points, along: Points, room: float) -> float:
        """Adds a row of like houses, every other one set back a little; returns its length."""
        width, depth = self._chances.uniform((6.2, 9.5), (8.5, 11.5)).tolist()
        count = min(int(self._chances.integers(2, 7)), int(room / width))
        eave, pitch = eaves(self._style.storeys[1], self._chances), float(self._chances.uniform(32, 42))
        step, rise = self._chances.uniform((0.0, -0.4), (1.2, 0.4)).tolist()
        for k in range(count):
            back = left_of(along) * (step if k % 2 else 0.0)
            strip = Strip.bar(corner + along * (k * width) + back, along, width, depth)
            details = annex("inner", width, eave, self._chances) if chance(self._chances, 0.4) else []
            roof = gabled(eave + k * rise, pitch, depth)
            plan = Plan(strip, roof, "residential", self._district, tuple(details))
            # The row's own houses touch; the first keeps its distance from whatever stood there.
            if not self.site.place(plan, self._gap_m if k == 0 else 0.0):
                return float(max(k, 1) * width)
        return float(max(count, 1) * width)
