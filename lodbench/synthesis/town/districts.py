"""Which part of town a block belongs to, and what is built there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.town import estates, landmarks
from lodbench.synthesis.town.building import Plan
from lodbench.synthesis.town.closed_blocks import closed_block
from lodbench.synthesis.town.fittings import chance
from lodbench.synthesis.town.houses import OLD_LANES, SUBURB, VILLAS, houses_along_streets
from lodbench.synthesis.town.shapes import area, inset
from lodbench.synthesis.town.streets import Block

Points = NDArray[np.float64]

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


def building_line(block: Block, district: str) -> Points | None:
    """Returns the line behind which a block is built on, (N, 2), or None where it is too small."""
    ring = inset(block.ring, _PAVEMENTS_M[district])
    return ring if ring is not None and area(ring) >= _LEAST_BLOCK_M2 else None


def build_up(number: int, ring: Points, district: str, generator: np.random.Generator) -> list[Plan]:
    """Returns what stands on a block.

    Args:
        number: The block's number, from the middle of town outward.
        ring: Its building line, (N, 2).
        district: Its district.
        generator: Source of chance.
    """
    if district == "old town":
        return _old_town_block(ring, generator)
    if district == "inner town":
        return _inner_town_block(number, ring, generator)
    if district == "estate":
        return estates.estate(ring, generator)
    if district == "works":
        return estates.works(ring, generator)
    return houses_along_streets(ring, district, SUBURB, generator)


def _old_town_block(ring: Points, generator: np.random.Generator) -> list[Plan]:
    """Returns a courtyard building, a closed block, or lanes of houses where neither has room."""
    plans = landmarks.courtyard_house(ring, "old town", generator) if chance(generator, 0.12) else []
    plans = plans or closed_block(ring, "old town", 3, generator)
    return plans or houses_along_streets(ring, "old town", OLD_LANES, generator)


def _inner_town_block(number: int, ring: Points, generator: np.random.Generator) -> list[Plan]:
    """Returns a park, a school, a closed block or villas."""
    if number % _PARK_EVERY == _PARK_FIRST:
        return landmarks.park(ring)
    plans = landmarks.school(ring, "inner town", generator) if chance(generator, 0.16) else []
    if not plans and chance(generator, 0.45):
        plans = closed_block(ring, "inner town", 4, generator)
    return plans or houses_along_streets(ring, "inner town", VILLAS, generator)
