"""Single buildings a town is known by: church, town hall, convent, school, park pavilion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.town.building import Plan
from lodbench.synthesis.town.closed_blocks import COURTYARD_M
from lodbench.synthesis.town.extrusion import Strip
from lodbench.synthesis.town.fittings import chance, dormers, eaves
from lodbench.synthesis.town.roofs import Roof, gabled, hipped, mansard
from lodbench.synthesis.town.shapes import box_of, edge_directions, inset, left_of
from lodbench.synthesis.town.site import Site, places_on

Points = NDArray[np.float64]


def church(ring: Points, generator: np.random.Generator) -> list[Plan]:
    """Returns a church with its tower on the square around it, or nothing on too small a square."""
    along, _, _ = box_of(ring)
    middle = 0.5 * (ring.min(axis=0) + ring.max(axis=0))
    length, width, side = float(generator.uniform(28, 38)), float(generator.uniform(13, 16)), 8.0
    corner = middle - along * (length - side) / 2 - left_of(along) * width / 2
    nave = hipped(float(generator.uniform(11, 14)), 52.0, width, length, (False, True))
    spire = Roof("pavilion", ((0.0, 30.0), (0.5, 48.0), (1.0, 30.0)), (side / 2, side / 2))
    tower_corner = corner - along * side + left_of(along) * (width - side) / 2
    site = Site(ring)
    both = [
        Plan(Strip.bar(corner, along, length, width), nave, "church", "old town"),
        Plan(Strip.bar(tower_corner, along, side, side), spire, "church", "old town"),
    ]
    return both if all(site.place(plan) for plan in both) else []


def town_hall(ring: Points, generator: np.random.Generator) -> list[Plan]:
    """Returns the town hall at one side of the market square, the rest left open."""
    along = edge_directions(ring)
    lengths = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
    k = int(np.argmax(lengths))
    length, depth = float(min(34.0, 0.6 * lengths[k])), 15.0
    corner = ring[k] + along[k] * (lengths[k] - length) / 2 + left_of(along[k]) * 2.0
    strip, roof = Strip.bar(corner, along[k], length, depth), mansard(11.0, depth)
    site = Site(ring)
    site.place(Plan(strip, roof, "public", "old town", tuple(dormers(strip, roof, generator))))
    return site.plans


def courtyard_house(ring: Points, district: str, generator: np.random.Generator) -> list[Plan]:
    """Returns one building around a courtyard (a convent, a court of justice), or nothing without room."""
    depth = float(generator.uniform(11.0, 13.5))
    if len(ring) > 6 or inset(ring, depth + COURTYARD_M / 2) is None:
        return []
    strip = Strip.bent(ring, [depth] * len(ring), closed=True)
    roof = gabled(eaves(3, generator), float(generator.uniform(32, 42)), depth)
    return [Plan(strip, roof, "public", district, tuple(dormers(strip, roof, generator)))]


def school(ring: Points, district: str, generator: np.random.Generator) -> list[Plan]:
    """Returns a school with two or three wings around a yard, or nothing without room."""
    along, length, width = box_of(ring)
    wings, depth = generator.uniform(0.45, 0.6, size=2) * (length, width), 13.0
    if wings.min() < 2 * depth + 4:
        return []
    inward = left_of(along)
    site = Site(ring)
    for corner in places_on(ring, 6.0, generator):
        turn = corner + along * wings[0]
        line = [corner, turn, turn + inward * wings[1]]
        if chance(generator, 0.6):
            line.insert(0, corner + inward * wings[1] * float(generator.uniform(0.7, 1.0)))
        strip = Strip.bent(np.stack(line), [depth] * (len(line) - 1))
        roof = gabled(eaves(3, generator), float(generator.uniform(25, 38)), depth)
        if site.place(Plan(strip, roof, "public", district)):
            break
    return site.plans


def park(ring: Points) -> list[Plan]:
    """Returns a pavilion in the green."""
    site = Site(ring)
    corner = 0.5 * (ring.min(axis=0) + ring.max(axis=0)) - 4.0
    strip = Strip.bar(corner, np.array([1.0, 0.0]), 8.0, 8.0)
    site.place(Plan(strip, hipped(3.2, 25.0, 8.0, 8.0), "public", "inner town"))
    return site.plans
