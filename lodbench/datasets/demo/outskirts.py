"""Around the middle: villas and schools, streets of houses with gardens, estates, and works."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.demo.building import Plan
from lodbench.datasets.demo.details import Annex, RoofBox
from lodbench.datasets.demo.fittings import (
    annex,
    chance,
    dormers,
    eaves,
    house_roof,
    lift_houses,
)
from lodbench.datasets.demo.roofs import Roof, flat, gabled, serrated
from lodbench.datasets.demo.shapes import box_of, edge_directions, left_of
from lodbench.datasets.demo.site import Site
from lodbench.datasets.demo.sweep import Strip

Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Style:
    """How a street of houses is built up.

    Attributes:
        grow: Size of the houses against those of a garden suburb.
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
    ring: Points, district: str, generator: np.random.Generator, style: Style
) -> list[Plan]:
    """Returns houses with gardens on every side of a block: alone, in pairs and in rows."""
    site = Site(ring)
    lengths = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
    for along, start, length in zip(edge_directions(ring), ring, lengths, strict=True):
        at = float(generator.uniform(1.0, 5.0))
        rows = style.rows * float(generator.choice([0.2, 2.0]))
        while at < length - 8.0:
            setback = float(generator.uniform(0.2, style.setback_m))
            corner = start + along * at + left_of(along) * setback
            if chance(generator, rows):
                at += _add_terrace(site, corner, along, length - at, district, style, generator)
            else:
                at += _add_house(site, corner, along, district, style, generator)
            at += float(generator.uniform(*style.gap_m))
    return site.plans


def _add_house(
    site: Site, corner: Points, along: Points, district: str, style: Style, generator: np.random.Generator
) -> float:
    """Adds a house and perhaps its garage; returns the length of street it takes."""
    length, depth = style.grow * generator.uniform(9.5, 14.0), style.grow * generator.uniform(8.0, 10.5)
    strip = _house_strip(corner, along, length, depth, generator)
    storeys = int(generator.integers(*style.storeys, endpoint=True))
    roof = house_roof(eaves(storeys, generator), strip, generator)
    details: list[Annex | RoofBox] = []
    if chance(generator, 0.35):
        details += dormers(strip, roof, generator)
    if strip.num_segments == 1 and chance(generator, 0.4):
        wall = float(np.linalg.norm(strip.outer[1] - strip.outer[0]))
        details += annex("inner", wall, roof.eave_m, generator)
    plan = Plan(strip, roof, "residential", district, tuple(details))
    gap = min(3.0, style.gap_m[0])
    placed = site.place(plan, gap) or site.place(replace(plan, details=()), gap)
    if placed and chance(generator, style.garages):
        _add_garage(site, corner + along * (length + 1.0), along, district, generator)
    return float(length)


def _house_strip(
    corner: Points, along: Points, length: float, depth: float, generator: np.random.Generator
) -> Strip:
    """Returns the plan of a house: a bar along or across the street, a square, or an L."""
    draw = float(generator.random())
    inward = left_of(along)
    if draw < 0.18:
        wing = 0.55 * depth + 1.0
        line = np.stack([corner, corner + along * length, corner + along * length + inward * (depth + 2.0)])
        return Strip.bent(line, [wing, wing])
    if draw < 0.28:
        return Strip.bar(corner, along, depth, depth)
    if draw < 0.5:
        return Strip.bar(corner + along * depth, inward, length, depth)
    return Strip.bar(corner, along, length, depth)


def _add_garage(
    site: Site, corner: Points, along: Points, district: str, generator: np.random.Generator
) -> None:
    """Adds a garage or shed beside or behind a house where there is room."""
    width, depth = float(generator.uniform(3.0, 6.0)), float(generator.uniform(5.5, 7.5))
    roof = flat(float(generator.uniform(2.5, 3.0))) if chance(generator, 0.7) else gabled(2.5, 30.0, depth)
    back = left_of(along) * float(generator.uniform(3.0, 14.0))
    site.place(Plan(Strip.bar(corner + back, along, width, depth), roof, "garage", district), 0.6)


def _add_terrace(
    site: Site,
    corner: Points,
    along: Points,
    room: float,
    district: str,
    style: Style,
    generator: np.random.Generator,
) -> float:
    """Adds a row of like houses, each a little back or ahead of the last; returns its length."""
    width, depth = float(generator.uniform(6.2, 8.5)), float(generator.uniform(9.5, 11.5))
    count = min(int(generator.integers(2, 7)), int(room / width))
    eave, pitch = eaves(style.storeys[1], generator), float(generator.uniform(32, 42))
    step, slope_m = float(generator.uniform(0.0, 1.2)), float(generator.uniform(-0.4, 0.4))
    for k in range(count):
        back = left_of(along) * (step if k % 2 else 0.0)
        strip = Strip.bar(corner + along * (k * width) + back, along, width, depth)
        roof = gabled(eave + k * slope_m, pitch, depth)
        details = annex("inner", width, eave, generator) if chance(generator, 0.4) else []
        plan = Plan(strip, roof, "residential", district, tuple(details))
        # The row's own houses touch; the first keeps its distance from whatever stood there.
        if not site.place(plan, min(3.0, style.gap_m[0]) if k == 0 else 0.0):
            return float(max(k, 1) * width)
    return max(count, 1) * width


def estate(ring: Points, generator: np.random.Generator) -> list[Plan]:
    """Returns slabs and towers of flats on open ground, all turned the same way."""
    along, _, _ = box_of(ring)
    site = Site(ring)
    for corner in _spread(ring, 20.0, generator):
        if chance(generator, 0.3):
            strip = Strip.bar(corner, along, *generator.uniform(18.0, 24.0, size=2).tolist())
            storeys = int(generator.integers(9, 16))
        else:
            strip = Strip.bar(
                corner, along, float(generator.uniform(38, 64)), float(generator.uniform(11, 13))
            )
            storeys = int(generator.integers(4, 8))
        roof = flat(eaves(storeys, generator))
        details = tuple(lift_houses(strip, roof, 1 if storeys > 8 else 2, generator))
        site.place(Plan(strip, roof, "residential", "estate", details), 13.0)
    return site.plans


def works(ring: Points, generator: np.random.Generator) -> list[Plan]:
    """Returns halls and an office or two."""
    along, _, _ = box_of(ring)
    site = Site(ring)
    for k, corner in enumerate(_spread(ring, 16.0, generator)):
        large = k % 4 != 3
        length, depth = (
            generator.uniform((26, 18), (70, 38)) if large else generator.uniform((14, 9), (24, 14))
        )
        strip = Strip.bar(corner, along, float(length), float(depth))
        roof = _hall_roof(float(depth), generator) if large else flat(eaves(3, generator))
        function = "industrial" if large else "commercial"
        details = tuple(lift_houses(strip, roof, 1, generator)) if roof.name == "flat" else ()
        site.place(Plan(strip, roof, function, "works", details), 7.0)
    return site.plans


def _hall_roof(depth: float, generator: np.random.Generator) -> Roof:
    """Returns a flat, low gabled or serrated roof."""
    eave, draw = float(generator.uniform(6.0, 11.0)), float(generator.random())
    if draw < 0.45:
        return flat(eave)
    return gabled(eave, 12.0, depth) if draw < 0.75 else serrated(eave, 2.2, max(2, round(depth / 8)))


def school(ring: Points, district: str, generator: np.random.Generator) -> list[Plan]:
    """Returns a school with two or three wings around a yard, or nothing without room."""
    along, length, width = box_of(ring)
    wings, depth = [float(generator.uniform(0.45, 0.6) * s) for s in (length, width)], 13.0
    inward = left_of(along)
    site = Site(ring)
    for corner in _spread(ring, 6.0, generator):
        a = corner + along * wings[0]
        line = [corner, a, a + inward * wings[1]]
        if chance(generator, 0.6):
            line.insert(0, corner + inward * wings[1] * float(generator.uniform(0.7, 1.0)))
        strip = Strip.bent(np.stack(line), [depth] * (len(line) - 1))
        roof = gabled(eaves(3, generator), float(generator.uniform(25, 38)), depth)
        if min(wings) > 2 * depth + 4 and site.place(Plan(strip, roof, "public", district)):
            break
    return site.plans


def _spread(ring: Points, spacing: float, generator: np.random.Generator) -> list[Points]:
    """Returns places to try, in random order: a jittered grid along the block's own directions."""
    along, _, _ = box_of(ring)
    axes = np.stack([along, left_of(along)])
    low, high = (ring @ axes.T).min(axis=0), (ring @ axes.T).max(axis=0)
    steps = [np.arange(a + 1.0, b, spacing) for a, b in zip(low, high, strict=True)]
    grid = np.stack([axis.ravel() for axis in np.meshgrid(*steps)], axis=1)
    grid += generator.uniform(0.0, 4.0, size=grid.shape)
    return list(generator.permutation(grid) @ axes)
