"""What stands alone: church, town hall, convent, school, pavilion; slabs and towers of flats; works."""

from __future__ import annotations

import numpy as np

from lodbench.synthesis.town.extrusion import Strip
from lodbench.synthesis.town.fittings import chance, dormers, eaves, lift_houses
from lodbench.synthesis.town.houses import COURTYARD_M
from lodbench.synthesis.town.roofs import Roof, flat, gabled, hipped, mansard, serrated
from lodbench.synthesis.town.shapes import box_of, edge_directions, edge_lengths, inset, left_of
from lodbench.synthesis.town.site import Site


def add_church(site: Site) -> bool:
    """Adds a church with its tower; returns whether the square had room for both."""
    chances, along = site.chances, site.along
    middle = 0.5 * (site.ring.min(axis=0) + site.ring.max(axis=0))
    length, width, side = float(chances.uniform(28, 38)), float(chances.uniform(13, 16)), 8.0
    corner = middle - along * (length - side) / 2 - left_of(along) * width / 2
    nave = hipped(float(chances.uniform(11, 14)), 52.0, width, length, (False, True))
    spire = Roof("pavilion", ((0.0, 30.0), (0.5, 48.0), (1.0, 30.0)), (side / 2, side / 2))
    tower = Strip.bar(corner - along * side + left_of(along) * (width - side) / 2, along, side, side)
    return site.place(Strip.bar(corner, along, length, width), nave, "church") and site.place(
        tower, spire, "church"
    )


def add_town_hall(site: Site) -> None:
    """Adds the town hall at one side of the market square, the rest left open."""
    lengths = edge_lengths(site.ring)
    k = int(np.argmax(lengths))
    along, length, depth = edge_directions(site.ring)[k], float(min(34.0, 0.6 * lengths[k])), 15.0
    corner = site.ring[k] + along * (lengths[k] - length) / 2 + left_of(along) * 2.0
    strip, roof = Strip.bar(corner, along, length, depth), mansard(11.0, depth)
    site.place(strip, roof, "public", dormers(strip, roof, site.chances))


def add_courtyard_house(site: Site) -> None:
    """Adds one building around a courtyard (a convent, a court of justice), or nothing without room."""
    depth = float(site.chances.uniform(11.0, 13.5))
    if len(site.ring) > 6 or inset(site.ring, depth + COURTYARD_M / 2) is None:
        return
    strip = Strip.bent(site.ring, [depth] * len(site.ring), closed=True)
    roof = gabled(eaves(3, site.chances), float(site.chances.uniform(32, 42)), depth)
    site.place(strip, roof, "public", dormers(strip, roof, site.chances), on_line=True)


def add_school(site: Site) -> None:
    """Adds a school with two or three wings around a yard, or nothing without room."""
    chances = site.chances
    along, *size = box_of(site.ring)
    wings, depth = chances.uniform(0.45, 0.6, size=2) * size, 13.0
    if wings.min() < 2 * depth + 4:
        return
    inward = left_of(along)
    for corner in site.places(6.0):
        turn = corner + along * wings[0]
        line = [corner, turn, turn + inward * wings[1]]
        if chance(chances, 0.6):
            line.insert(0, corner + inward * wings[1] * float(chances.uniform(0.7, 1.0)))
        strip = Strip.bent(np.stack(line), [depth] * (len(line) - 1))
        if site.place(strip, gabled(eaves(3, chances), float(chances.uniform(25, 38)), depth), "public"):
            return


def add_pavilion(site: Site) -> None:
    """Adds a pavilion in the green."""
    corner = 0.5 * (site.ring.min(axis=0) + site.ring.max(axis=0)) - 4.0
    strip = Strip.bar(corner, np.array([1.0, 0.0]), 8.0, 8.0)
    site.place(strip, hipped(3.2, 25.0, 8.0, 8.0), "public")


def add_flats(site: Site) -> None:
    """Adds slabs and towers of flats, all turned the same way."""
    chances = site.chances
    for corner in site.places(20.0):
        tower = chance(chances, 0.3)
        sizes = ((18.0, 18.0), (24.0, 24.0)) if tower else ((38.0, 11.0), (64.0, 13.0))
        length, depth = chances.uniform(*sizes).tolist()
        storeys = int(chances.integers(9, 16) if tower else chances.integers(4, 8))
        strip, roof = Strip.bar(corner, site.along, length, depth), flat(eaves(storeys, chances))
        details = lift_houses(strip, roof, 1 if tower else 2, chances)
        site.place(strip, roof, details=details, gap_m=13.0)


def add_works(site: Site) -> None:
    """Adds halls, and an office or two."""
    chances = site.chances
    for k, corner in enumerate(site.places(16.0)):
        office = k % 4 == 3
        sizes = ((14.0, 9.0), (24.0, 14.0)) if office else ((26.0, 18.0), (70.0, 38.0))
        length, depth = chances.uniform(*sizes).tolist()
        strip = Strip.bar(corner, site.along, length, depth)
        roof = flat(eaves(3, chances)) if office else _hall_roof(depth, chances)
        details = lift_houses(strip, roof, 1, chances) if roof.name == "flat" else []
        site.place(strip, roof, "commercial" if office else "industrial", details, gap_m=7.0)


def _hall_roof(depth: float, generator: np.random.Generator) -> Roof:
    """Returns a flat, low gabled or serrated roof."""
    eave, draw = float(generator.uniform(6.0, 11.0)), float(generator.random())
    if draw < 0.45:
        return flat(eave)
    return gabled(eave, 12.0, depth) if draw < 0.75 else serrated(eave, 2.2, max(2, round(depth / 8)))
