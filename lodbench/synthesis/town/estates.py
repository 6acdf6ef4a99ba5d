"""Large buildings on open ground: slabs and towers of flats, and works with their halls."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.town.building import Plan
from lodbench.synthesis.town.extrusion import Strip
from lodbench.synthesis.town.fittings import chance, eaves, lift_houses
from lodbench.synthesis.town.roofs import Roof, flat, gabled, serrated
from lodbench.synthesis.town.shapes import box_of
from lodbench.synthesis.town.site import Site, places_on

Points = NDArray[np.float64]


def estate(ring: Points, generator: np.random.Generator) -> list[Plan]:
    """Returns slabs and towers of flats on a block, all turned the same way."""
    along, _, _ = box_of(ring)
    site = Site(ring)
    for corner in places_on(ring, 20.0, generator):
        tower = chance(generator, 0.3)
        sizes = ((18.0, 18.0), (24.0, 24.0)) if tower else ((38.0, 11.0), (64.0, 13.0))
        length, depth = generator.uniform(*sizes).tolist()
        storeys = int(generator.integers(9, 16) if tower else generator.integers(4, 8))
        strip, roof = Strip.bar(corner, along, length, depth), flat(eaves(storeys, generator))
        details = tuple(lift_houses(strip, roof, 1 if tower else 2, generator))
        site.place(Plan(strip, roof, "residential", "estate", details), 13.0)
    return site.plans


def works(ring: Points, generator: np.random.Generator) -> list[Plan]:
    """Returns halls on a block, and an office or two."""
    along, _, _ = box_of(ring)
    site = Site(ring)
    for k, corner in enumerate(places_on(ring, 16.0, generator)):
        office = k % 4 == 3
        sizes = ((14.0, 9.0), (24.0, 14.0)) if office else ((26.0, 18.0), (70.0, 38.0))
        length, depth = generator.uniform(*sizes).tolist()
        strip = Strip.bar(corner, along, length, depth)
        roof = flat(eaves(3, generator)) if office else _hall_roof(depth, generator)
        details = tuple(lift_houses(strip, roof, 1, generator)) if roof.name == "flat" else ()
        function = "commercial" if office else "industrial"
        site.place(Plan(strip, roof, function, "works", details), 7.0)
    return site.plans


def _hall_roof(depth: float, generator: np.random.Generator) -> Roof:
    """Returns a flat, low gabled or serrated roof."""
    eave, draw = float(generator.uniform(6.0, 11.0)), float(generator.random())
    if draw < 0.45:
        return flat(eave)
    return gabled(eave, 12.0, depth) if draw < 0.75 else serrated(eave, 2.2, max(2, round(depth / 8)))
