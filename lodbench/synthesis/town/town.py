"""The demo town: a made-up European town of some 900 buildings, the same for a seed everywhere.

Order of work: streets cut the land into blocks, each block gets a district and plans, each plan is
built on the terrain beside its neighbours at three levels of detail.
"""

from __future__ import annotations

from dataclasses import dataclass

from lodbench.storage import random_stream
from lodbench.synthesis.town.building import Age, Building, Plan, construct_all
from lodbench.synthesis.town.districts import build_up, district_of, site_of
from lodbench.synthesis.town.landmarks import add_church, add_town_hall
from lodbench.synthesis.town.looks import TEST, TownLook
from lodbench.synthesis.town.occupancy import Occupancy, occupancy_of
from lodbench.synthesis.town.streets import StreetPlan, draw_streets
from lodbench.synthesis.town.terrain import Terrain

# Raise it whenever a seed gives another town, queries included: results of two versions do not compare.
TOWN_VERSION = "2"

# The church stands on the first of the middle blocks that has room for it; block 0 is the market.
_CHURCH_BLOCKS = range(1, 12)
# No building stands farther out than this.
_REACH_M = 640.0


@dataclass(frozen=True, slots=True, eq=False)
class Town:
    """A town in local metres, x east, y north, its middle at the origin; heights above sea level.

    Attributes:
        buildings: Block by block from the middle outward, those pulled down before the photos included.
        districts: District of each block of ``streets``.
    """

    seed: int
    look: TownLook
    buildings: tuple[Building, ...]
    streets: StreetPlan
    districts: tuple[str, ...]
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


def grow_town(seed: int, look: TownLook = TEST) -> Town:
    """Returns the town of a seed and a look."""
    streets = draw_streets(random_stream(seed, "demo", "streets"), look.rings)
    ground = random_stream(seed, "demo", "ground")
    terrain = Terrain.draw(ground, streets.river, look.relief)
    blocks = _landmarks(seed, streets)
    estate_turn = float(ground.uniform(-1.2, 1.2))
    districts = tuple(district_of(block, streets.to_river, estate_turn) for block in streets.blocks)
    for number, (block, district) in enumerate(zip(streets.blocks, districts, strict=True)):
        site = site_of(block, district, random_stream(seed, "demo", "block", number))
        if number not in blocks and site is not None:
            build_up(site, number)
            blocks[number] = site.plans
    named = [
        (f"DEMO_{number:03d}_{k:02d}", plan)
        for number in sorted(blocks)
        for k, plan in enumerate(blocks[number])
    ]
    occupancy = occupancy_of([plan.pieces for _, plan in named], _REACH_M)
    buildings = tuple(construct_all(named, seed, look, terrain, occupancy))
    return Town(seed, look, buildings, streets, districts, terrain, occupancy)


def _landmarks(seed: int, streets: StreetPlan) -> dict[int, list[Plan]]:
    """Returns the plans of the market square and of the church's block, by block number."""
    market = site_of(streets.blocks[0], "old town", random_stream(seed, "demo", "town hall"))
    if market is None:
        return {}
    add_town_hall(market)
    blocks = {0: market.plans}
    for number in _CHURCH_BLOCKS:
        square = site_of(streets.blocks[number], "old town", random_stream(seed, "demo", "church"))
        if square is not None and add_church(square):
            blocks[number] = square.plans
            break
    return blocks
