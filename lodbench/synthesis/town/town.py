"""The demo town: a made-up European town of some 900 buildings, the same for a seed everywhere.

Order of work: streets cut the land into blocks, each block gets a district and plans, each plan is
built on the terrain beside its neighbours at three levels of detail.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from lodbench.storage import random_stream
from lodbench.synthesis.town import houses
from lodbench.synthesis.town.buildings import Age, Building, Plan, construct_all
from lodbench.synthesis.town.fittings import chance
from lodbench.synthesis.town.houses import OLD_LANES, SUBURB, VILLAS, Site, add_closed_block, add_houses
from lodbench.synthesis.town.shapes import Points, TownLook, area, inset, look_named
from lodbench.synthesis.town.streets import Block, Occupancy, StreetPlan, Terrain, draw_streets

# Raise it whenever a seed gives another town, queries included: results of two versions do not compare.
TOWN_VERSION = "2"
CRS_NAME = "urn:ogc:def:crs,crs::EPSG::25832,crs::EPSG::7837"
# Where the made-up town lies in UTM zone 32: easting, northing and height of its local origin, metres.
ORIGIN_M = np.array([567_000.0, 5_539_000.0, 0.0])

# The church stands on the first of the middle blocks that has room for it; block 0 is the market.
_CHURCH_BLOCKS = range(1, 12)
# No building stands farther out than this.
_REACH_M = 640.0
OLD_TOWN_RADIUS_M = 175.0
_INNER_RADIUS_M = 290.0
_ESTATE_RADIUS_M = 320.0
# Half the angle under which the estate is viewed from the middle of town.
_ESTATE_HALF_ANGLE = 0.42
# Width of pavements and front gardens, from the kerb to the building line.
_PAVEMENTS_M = {"old town": 1.5, "inner town": 2.5, "works": 6.0, "estate": 7.0, "garden suburb": 4.0}
_LEAST_BLOCK_M2 = 300.0
# Every so many-th block of the inner town is a park.
_PARK_EVERY, _PARK_FIRST = 17, 5


class Town(NamedTuple):
    """A town in local metres, x east, y north, its middle at the origin; heights above sea level."""

    seed: int
    look: TownLook
    # Block by block from the middle outward, those pulled down before the photos included.
    buildings: tuple[Building, ...]
    streets: StreetPlan
    districts: tuple[str, ...]  # district of each block of ``streets``
    terrain: Terrain
    occupancy: Occupancy

    @property
    def standing(self) -> tuple[Building, ...]:
        """Returns the buildings that photos show and LoD3 holds."""
        return tuple(building for building in self.buildings if building.age is not Age.GONE)

    @property
    def mapped(self) -> tuple[Building, ...]:
        """Returns the buildings that LoD1 and LoD2 hold."""
        return tuple(building for building in self.buildings if building.age is not Age.NEW)


def grow_town(seed: int, look_name: str = "test") -> Town:
    """Returns the town of a seed and a look, ``test`` or ``train``."""
    look = look_named(look_name)
    streets = draw_streets(random_stream(seed, "demo", "streets"), look.rings)
    ground = random_stream(seed, "demo", "ground")
    terrain = Terrain.draw(ground, streets.river, look.relief)
    blocks = _landmarks(seed, streets)
    estate_turn = float(ground.uniform(-1.2, 1.2))
    districts = tuple(_district_of(block, streets.to_river, estate_turn) for block in streets.blocks)
    for number, (block, district) in enumerate(zip(streets.blocks, districts, strict=True)):
        site = _site_of(block, district, random_stream(seed, "demo", "block", number))
        if number not in blocks and site is not None:
            if district == "inner town" and number % _PARK_EVERY == _PARK_FIRST:
                houses.add_pavilion(site)
            else:
                _BUILD_UP[district](site)
            blocks[number] = site.plans
    named = [
        (f"DEMO_{number:03d}_{k:02d}", plan)
        for number in sorted(blocks)
        for k, plan in enumerate(blocks[number])
    ]
    occupancy = Occupancy([plan.pieces for _, plan in named], _REACH_M)
    buildings = tuple(construct_all(named, seed, look, terrain, occupancy))
    return Town(seed, look, buildings, streets, districts, terrain, occupancy)


def _landmarks(seed: int, streets: StreetPlan) -> dict[int, list[Plan]]:
    """Returns the plans of the market square and of the church's block, by block number."""
    market = _site_of(streets.blocks[0], "old town", random_stream(seed, "demo", "town hall"))
    if market is None:
        return {}
    houses.add_town_hall(market)
    blocks = {0: market.plans}
    for number in _CHURCH_BLOCKS:
        square = _site_of(streets.blocks[number], "old town", random_stream(seed, "demo", "church"))
        if square is not None and houses.add_church(square):
            blocks[number] = square.plans
            break
    return blocks


def _district_of(block: Block, to_river: Points, estate_turn: float) -> str:
    """Returns the district of a block: rings around the middle, an estate and works at the edge.

    ``to_river``, (2,) unit, leads to the river; the estate lies ``estate_turn`` radians from away from it.
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


def _site_of(block: Block, district: str, chances: np.random.Generator) -> Site | None:
    """Returns a block behind its building line, or None where that is too small to be built on."""
    ring = inset(block.ring, _PAVEMENTS_M[district])
    return None if ring is None or area(ring) < _LEAST_BLOCK_M2 else Site(ring, district, chances)


def _build_old_town(site: Site) -> None:
    """Adds a courtyard building, a closed block, or lanes of houses where neither has room."""
    if chance(site.chances, 0.12):
        houses.add_courtyard_house(site)
    if not site.plans:
        add_closed_block(site, storeys=3)
    if not site.plans:
        add_houses(site, OLD_LANES)


def _build_inner_town(site: Site) -> None:
    """Adds a school, a closed block or villas."""
    if chance(site.chances, 0.16):
        houses.add_school(site)
    if not site.plans and chance(site.chances, 0.45):
        add_closed_block(site, storeys=4)
    if not site.plans:
        add_houses(site, VILLAS)


# What adds all that stands on a block of a district.
_BUILD_UP: dict[str, Callable[[Site], None]] = {
    "old town": _build_old_town,
    "inner town": _build_inner_town,
    "estate": houses.add_flats,
    "works": houses.add_works,
    "garden suburb": partial(add_houses, style=SUBURB),
}
