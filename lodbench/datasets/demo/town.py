"""The demo town: a made-up European town of some 700 buildings, the same for a seed everywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.demo import old_town, outskirts
from lodbench.datasets.demo.building import Building, Plan, erect
from lodbench.datasets.demo.fittings import chance
from lodbench.datasets.demo.roofs import hipped
from lodbench.datasets.demo.shapes import area, inset
from lodbench.datasets.demo.site import Site
from lodbench.datasets.demo.streets import Block, StreetPlan, draw_streets
from lodbench.datasets.demo.sweep import Strip
from lodbench.datasets.demo.terrain import Terrain
from lodbench.storage import random_stream

Points = NDArray[np.float64]

# Raise it whenever a seed gives another town, queries included: results of two versions do not compare.
TOWN_VERSION = "1"

OLD_TOWN_RADIUS_M = 175.0
_INNER_RADIUS_M = 290.0


@dataclass(frozen=True, slots=True, eq=False)
class Town:
    """A town in local metres, x east, y north, its middle at the origin; heights above sea level.

    Attributes:
        seed: What it grew from.
        buildings: Its buildings, block by block from the middle outward.
        streets: Its street plan.
        terrain: Its ground.
    """

    seed: int
    buildings: tuple[Building, ...]
    streets: StreetPlan
    terrain: Terrain


def grow_town(seed: int) -> Town:
    """Returns the town of a seed."""
    streets = draw_streets(random_stream(seed, "demo", "streets"))
    generator = random_stream(seed, "demo", "ground")
    terrain = Terrain.draw(generator, -streets.to_river)
    turn = float(generator.uniform(-1.2, 1.2))
    buildings: list[Building] = []
    for number, block in enumerate(streets.blocks):
        chances = random_stream(seed, "demo", "block", number)
        district = _district(block, streets.to_river, turn)
        for k, plan in enumerate(_build_up(number, block, district, chances)):
            buildings.append(erect(f"DEMO_{number:03d}_{k:02d}", plan, terrain))
    return Town(seed, tuple(buildings), streets, terrain)


def _district(block: Block, to_river: Points, turn: float) -> str:
    """Returns the district of a block: rings around the middle, an estate and works at the edge."""
    x, y = block.center
    radius = float(np.hypot(x, y))
    if block.beyond_river:
        side = x * to_river[1] - y * to_river[0]
        return "works" if side > 60.0 else "garden suburb"
    if radius < OLD_TOWN_RADIUS_M:
        return "old town"
    if radius < _INNER_RADIUS_M:
        return "inner town"
    bearing = np.arctan2(y, x) - np.arctan2(-to_river[1], -to_river[0]) - turn
    off = abs((bearing + np.pi) % (2 * np.pi) - np.pi)
    return "estate" if off < 0.42 and radius > 320.0 else "garden suburb"


def _build_up(number: int, block: Block, district: str, generator: np.random.Generator) -> list[Plan]:
    """Returns what stands on a block."""
    pavement = {"old town": 1.5, "inner town": 2.5, "works": 6.0, "estate": 7.0}.get(district, 4.0)
    ring = inset(block.ring, pavement)
    if ring is None or area(ring) < 300.0:
        return []
    if number == 0:
        return old_town.town_hall(ring, generator)
    if number == 3:
        return old_town.church(ring, generator)
    if district == "old town":
        return _old_town_block(ring, generator)
    if district == "inner town":
        return _inner_block(number, ring, generator)
    if district == "estate":
        return outskirts.estate(ring, generator)
    if district == "works":
        return outskirts.works(ring, generator)
    return outskirts.houses_along_streets(ring, district, generator, outskirts.SUBURB)


def _old_town_block(ring: Points, generator: np.random.Generator) -> list[Plan]:
    """Returns a closed block, a courtyard building, or looser houses where neither has room."""
    plans = old_town.courtyard_house(ring, "old town", generator) if chance(generator, 0.12) else []
    plans = plans or old_town.closed_block(ring, "old town", 3, generator)
    return plans or outskirts.houses_along_streets(ring, "old town", generator, outskirts.OLD_LANES)


def _inner_block(number: int, ring: Points, generator: np.random.Generator) -> list[Plan]:
    """Returns a park, a school, a closed block or villas."""
    if number % 17 == 5:
        return _park(ring)
    if chance(generator, 0.16):
        plans = outskirts.school(ring, "inner town", generator)
        if plans:
            return plans
    if chance(generator, 0.45):
        plans = old_town.closed_block(ring, "inner town", 4, generator)
        if plans:
            return plans
    return outskirts.houses_along_streets(ring, "inner town", generator, outskirts.VILLAS)


def _park(ring: Points) -> list[Plan]:
    """Returns a pavilion in the green."""
    site = Site(ring)
    corner = 0.5 * (ring.min(axis=0) + ring.max(axis=0)) - 4.0
    strip = Strip.bar(corner, np.array([1.0, 0.0]), 8.0, 8.0)
    site.place(Plan(strip, hipped(3.2, 25.0, 8.0, 8.0), "public", "inner town"))
    return site.plans
