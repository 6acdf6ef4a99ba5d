"""Which part of town a block belongs to, and what is built there."""

from __future__ import annotations

import numpy as np

from lodbench.synthesis.town import landmarks
from lodbench.synthesis.town.closed_blocks import add_closed_block
from lodbench.synthesis.town.fittings import chance
from lodbench.synthesis.town.houses import OLD_LANES, SUBURB, VILLAS, add_houses
from lodbench.synthesis.town.shapes import Points, area, inset
from lodbench.synthesis.town.site import Site
from lodbench.synthesis.town.streets import Block

OLD_TOWN_RADIUS_M = 175.0
_INNER_RADIUS_M = 290.0
_ESTATE_RADIUS_M = 320.0
# Half the angle under which the estate is seen from the middle of town.
_ESTATE_HALF_ANGLE = 0.42
# Width of pavements and front gardens, from the kerb to the building line.
_PAVEMENTS_M = {"old town": 1.5, "inner town": 2.5, "works": 6.0, "estate": 7.0, "garden suburb": 4.0}
_LEAST_BLOCK_M2 = 300.0
# Every so many-th block of the inner town is a park.
_PARK_EVERY, _PARK_FIRST = 17, 5


def district_of(block: Block, to_river: Points, estate_turn: float) -> str:
    """Returns the district of a block: rings around the middle, an estate and works at the edge.

    Args:
        block: The block.
        to_river: (2,) unit direction from the middle of town to the river.
        estate_turn: Where the estate lies, radians from the direction away from the river.
    """
    x, y = block.center
    radius = float(np.hypot(x, y))
    if block.beyond_river:
        return "works" if x * to_river[1] - y * to_river[0] > 60.0 else "garden suburb"
    if radius < OLD_TOWN_RADIUS_M:
        return "old town"
    if radius < _INNER_RADIUS_M:
        return "inner town"
    bearing = np.arctan2(y, x) - np.arctan2(-to_river[1], -to_river[0]) - estate_turn
    off = abs((bearing + np.pi) % (2 * np.pi) - np.pi)
    return "estate" if off < _ESTATE_HALF_ANGLE and radius > _ESTATE_RADIUS_M else "garden suburb"


def site_of(block: Block, district: str, chances: np.random.Generator) -> Site | None:
    """Returns a block behind its building line, or None where that is too small to be built on."""
    ring = inset(block.ring, _PAVEMENTS_M[district])
    return None if ring is None or area(ring) < _LEAST_BLOCK_M2 else Site(ring, district, chances)


def build_up(site: Site, number: int) -> None:
    """Adds what stands on a block; blocks are numbered from the middle of town outward."""
    if site.district == "old town":
        _build_old_town(site)
    elif site.district == "inner town":
        _build_inner_town(site, number)
    elif site.district == "estate":
        landmarks.add_flats(site)
    elif site.district == "works":
        landmarks.add_works(site)
    else:
        add_houses(site, SUBURB)


def _build_old_town(site: Site) -> None:
    """Adds a courtyard building, a closed block, or lanes of houses where neither has room."""
    if chance(site.chances, 0.12):
        landmarks.add_courtyard_house(site)
    if not site.plans:
        add_closed_block(site, storeys=3)
    if not site.plans:
        add_houses(site, OLD_LANES)


def _build_inner_town(site: Site, number: int) -> None:
    """Adds a park, a school, a closed block or villas."""
    if number % _PARK_EVERY == _PARK_FIRST:
        landmarks.add_pavilion(site)
        return
    if chance(site.chances, 0.16):
        landmarks.add_school(site)
    if not site.plans and chance(site.chances, 0.45):
        add_closed_block(site, storeys=4)
    if not site.plans:
        add_houses(site, VILLAS)
