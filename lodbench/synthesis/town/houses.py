"""Streets of houses with gardens: alone, in pairs and in rows, with garages beside them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodbench.synthesis.town.extrusion import Strip
from lodbench.synthesis.town.fittings import Detail, annex, chance, dormers, eaves, house_roof
from lodbench.synthesis.town.roofs import flat, gabled
from lodbench.synthesis.town.shapes import Points, edge_directions, edge_lengths, left_of
from lodbench.synthesis.town.site import Site


@dataclass(frozen=True, slots=True)
class Style:
    """How a street of houses is built up."""

    grow: float  # size of the houses against small ones
    storeys: tuple[int, int]  # least and greatest number of storeys
    gap_m: tuple[float, float]  # least and greatest distance between houses along the street
    setback_m: float  # greatest depth of the front garden
    rows: float  # share of terraces among what is built
    garages: float  # share of houses with a garage


SUBURB = Style(1.05, (1, 2), (6.0, 14.0), 4.5, 0.2, 0.22)
VILLAS = Style(1.35, (2, 3), (5.0, 11.0), 4.0, 0.15, 0.3)
OLD_LANES = Style(1.15, (2, 3), (0.8, 3.5), 1.2, 0.7, 0.1)


def add_houses(site: Site, style: Style) -> None:
    """Adds houses on every side of a block."""
    for along, start, length in zip(
        edge_directions(site.ring), site.ring, edge_lengths(site.ring).tolist(), strict=True
    ):
        _add_street(site, style, start, along, length)


def _add_street(site: Site, style: Style, start: Points, along: Points, length: float) -> None:
    """Adds houses from one corner of the block to the next; streets like either rows or houses."""
    chances = site.chances
    at = float(chances.uniform(1.0, 5.0))
    rows = style.rows * float(chances.choice([0.2, 2.0]))
    while at < length - 8.0:
        setback = float(chances.uniform(0.2, style.setback_m))
        corner = start + along * at + left_of(along) * setback
        if chance(chances, rows):
            at += _add_terrace(site, style, corner, along, length - at)
        else:
            at += _add_house(site, style, corner, along)
        at += float(chances.uniform(*style.gap_m))


def _add_house(site: Site, style: Style, corner: Points, along: Points) -> float:
    """Adds a house and perhaps its garage; returns the length of street it takes, metres."""
    chances, gap_m = site.chances, min(3.0, style.gap_m[0])
    length, depth = (style.grow * chances.uniform((9.5, 8.0), (14.0, 10.5))).tolist()
    strip = _house_strip(corner, along, length, depth, chances)
    storeys = int(chances.integers(*style.storeys, endpoint=True))
    roof = house_roof(eaves(storeys, chances), strip, chances)
    details: list[Detail] = dormers(strip, roof, chances) if chance(chances, 0.35) else []
    if len(strip.wings) == 1 and chance(chances, 0.4):
        _, _, wall, _ = strip.first_wing
        details += annex(wall, roof.eave_m, chances)
    placed = site.place(strip, roof, details=details, gap_m=gap_m) or site.place(strip, roof, gap_m=gap_m)
    if placed and chance(chances, style.garages):
        _add_garage(site, corner + along * (length + 1.0), along)
    return float(length)


def _house_strip(
    corner: Points, along: Points, length: float, depth: float, generator: np.random.Generator
) -> Strip:
    """Returns the plan of a house: a bar along or across the street, a square, or an L."""
    draw, inward = float(generator.random()), left_of(along)
    if draw < 0.18:
        wing, turn = 0.55 * depth + 1.0, corner + along * length
        return Strip.bent(np.stack([corner, turn, turn + inward * (depth + 2.0)]), [wing, wing])
    if draw < 0.28:
        return Strip.bar(corner, along, depth, depth)
    if draw < 0.5:
        return Strip.bar(corner + along * depth, inward, length, depth)
    return Strip.bar(corner, along, length, depth)


def _add_garage(site: Site, corner: Points, along: Points) -> None:
    """Adds a garage or shed beside or behind a house where there is room."""
    chances = site.chances
    width, depth = chances.uniform((3.0, 5.5), (6.0, 7.5)).tolist()
    height = float(chances.uniform(2.4, 3.0))
    roof = flat(height) if chance(chances, 0.7) else gabled(height, 30.0, depth)
    back = left_of(along) * float(chances.uniform(3.0, 14.0))
    site.place(Strip.bar(corner + back, along, width, depth), roof, "garage", gap_m=0.6)


def _add_terrace(site: Site, style: Style, corner: Points, along: Points, room: float) -> float:
    """Adds a row of like houses, every other one set back a little; returns its length, metres."""
    chances = site.chances
    width, depth = chances.uniform((6.2, 9.5), (8.5, 11.5)).tolist()
    count = min(int(chances.integers(2, 7)), int(room / width))
    eave, pitch = eaves(style.storeys[1], chances), float(chances.uniform(32, 42))
    step, rise = chances.uniform((0.0, -0.4), (1.2, 0.4)).tolist()
    for k in range(count):
        back = left_of(along) * (step if k % 2 else 0.0)
        strip = Strip.bar(corner + along * (k * width) + back, along, width, depth)
        details = annex(width, eave, chances) if chance(chances, 0.4) else []
        # The row's own houses touch; the first keeps its distance from whatever stood there.
        gap_m = min(3.0, style.gap_m[0]) if k == 0 else 0.0
        if not site.place(strip, gabled(eave + k * rise, pitch, depth), details=details, gap_m=gap_m):
            return float(max(k, 1) * width)
    return float(max(count, 1) * width)
