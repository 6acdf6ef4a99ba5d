"""The middle of town: closed blocks of row houses around courtyards, the church, the market."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.demo.building import Plan
from lodbench.datasets.demo.details import Annex, RoofBox
from lodbench.datasets.demo.fittings import annex, chance, dormers, eaves, town_roof
from lodbench.datasets.demo.roofs import Roof, flat, gabled, hipped, mansard
from lodbench.datasets.demo.shapes import area, box_of, corner_angles_deg, edge_directions, inset, left_of
from lodbench.datasets.demo.site import Site
from lodbench.datasets.demo.sweep import Strip

Points = NDArray[np.float64]

# Courtyards are at least this wide between the back walls.
_COURTYARD_M = 9.0
# Sharper corners than this make no rooms.
_LEAST_CORNER_DEG = 47.0


def closed_block(ring: Points, district: str, storeys: int, generator: np.random.Generator) -> list[Plan]:
    """Returns row houses all around a block, or nothing where its shape leaves no courtyard.

    Every corner gets a house with two wings, the sides between are shared out among narrow houses.
    """
    depth = float(generator.uniform(10.5, 13.0))
    if inset(ring, depth + _COURTYARD_M / 2) is None:
        return []
    legs = _corner_legs(ring, depth, generator)
    if legs is None:
        return []
    site = Site(ring)
    along, count = edge_directions(ring), len(ring)
    for k in range(count):
        line = np.stack([ring[k] - along[k - 1] * legs[k, 0], ring[k], ring[k] + along[k] * legs[k, 1]])
        strip = Strip.bent(line, [depth, depth])
        roof = gabled(eaves(storeys + chance(generator, 0.3), generator), generator.uniform(36, 48), depth)
        _furnish(site, Plan(strip, roof, "residential", district), generator, with_annex=False)
    for k in range(count):
        start, end = ring[k] + along[k] * legs[k, 1], ring[(k + 1) % count]
        free = float((end - start) @ along[k]) - legs[(k + 1) % count, 0]
        _add_row(site, start, along[k], free, depth, district, storeys, generator)
    _add_yard_buildings(site, ring, depth, district, generator)
    return site.plans


def _corner_legs(ring: Points, depth: float, generator: np.random.Generator) -> Points | None:
    """Returns how far each corner house reaches back and ahead, (N, 2) metres, or None without room."""
    count, angles = len(ring), corner_angles_deg(ring)
    if angles.min() < _LEAST_CORNER_DEG:
        return None
    lengths = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
    least = np.maximum(depth / np.tan(np.radians(angles) / 2), 0.0) + 2.5
    legs = least[:, None] + generator.uniform(1.5, 5.0, size=(count, 2))
    for k in range(count):
        m = (k + 1) % count
        room = lengths[k] - legs[k, 1] - legs[m, 0]
        if room >= 8.0:
            continue
        # Too little for a house between: the two corner houses share the side.
        spare = lengths[k] - least[k] - least[m]
        if spare < 0:
            return None
        legs[k, 1], legs[m, 0] = least[k] + spare / 2, lengths[k] - least[k] - spare / 2
    return legs


def _add_row(
    site: Site,
    start: Points,
    along: Points,
    length: float,
    depth: float,
    district: str,
    storeys: int,
    generator: np.random.Generator,
) -> None:
    """Shares a stretch of street out among houses that touch, leaving a gap now and then."""
    if length < 4.0:
        return
    shares = generator.uniform(0.7, 1.3, size=max(1, round(length / generator.uniform(11.0, 16.0))))
    edges = np.concatenate([[0.0], np.cumsum(shares / shares.sum())]) * length
    for left, width in zip(edges[:-1], np.diff(edges), strict=True):
        if chance(generator, 0.06):
            continue
        own = depth + float(generator.uniform(-2.0, 1.2))
        high = eaves(max(2, storeys + int(generator.integers(-1, 2))), generator)
        corner = start + along * left
        if district == "old town" and width < own and chance(generator, 0.3):
            strip = Strip.bar(corner + along * width, left_of(along), own, float(width))
            roof = gabled(high, float(generator.uniform(42, 54)), float(width))
        else:
            strip = Strip.bar(corner, along, float(width), own)
            roof = town_roof(high, own, generator, modern=0.05 if district == "old town" else 0.2)
        _furnish(site, Plan(strip, roof, "residential", district), generator, with_annex=True)


def _furnish(site: Site, plan: Plan, generator: np.random.Generator, *, with_annex: bool) -> None:
    """Places a house with dormers and an annex at the back; without the annex where it has no room."""
    details: list[Annex | RoofBox] = []
    if chance(generator, 0.55):
        details += dormers(plan.strip, plan.roof, generator)
    plan = replace(plan, details=tuple(details))
    width = float(np.linalg.norm(plan.strip.outer[1] - plan.strip.outer[0]))
    facing_street = plan.strip.num_segments == 1 and width > 8.0
    if with_annex and facing_street and chance(generator, 0.45):
        extended = details + annex("inner", width, plan.roof.eave_m, generator)
        if site.place(replace(plan, details=tuple(extended)), on_line=True):
            return
    site.place(plan, on_line=True)


def _add_yard_buildings(
    site: Site, ring: Points, depth: float, district: str, generator: np.random.Generator
) -> None:
    """Adds workshops and sheds to a courtyard."""
    yard = inset(ring, depth + 3.0)
    if yard is None:
        return
    along, _, _ = box_of(ring)
    low, high = yard.min(axis=0), yard.max(axis=0)
    for _ in range(int(area(yard) / 260.0) + 1):
        length, width = generator.uniform(5.0, 13.0), generator.uniform(4.0, 7.0)
        corner = generator.uniform(low, high)
        strip = Strip.bar(corner, along, length, width)
        height = float(generator.uniform(2.8, 5.5))
        roof = flat(height) if chance(generator, 0.6) else gabled(height, 28.0, width)
        plan = Plan(strip, roof, "commercial", district)
        if Site(yard).place(plan):
            site.place(plan, 1.2)


def church(ring: Points, generator: np.random.Generator) -> list[Plan]:
    """Returns a church with its tower on the square around it, or nothing on too small a square."""
    along, _, _ = box_of(ring)
    middle = 0.5 * (ring.min(axis=0) + ring.max(axis=0))
    length, width, side = float(generator.uniform(30, 38)), float(generator.uniform(13, 16)), 8.0
    corner = middle - along * (length - side) / 2 - left_of(along) * width / 2
    nave = hipped(float(generator.uniform(11, 14)), 52.0, width, length, (False, True))
    spire = Roof("pavilion", ((0.0, 30.0), (0.5, 48.0), (1.0, 30.0)), (side / 2, side / 2))
    tower_corner = corner - along * side + left_of(along) * (width - side) / 2
    site = Site(ring)
    if site.place(Plan(Strip.bar(corner, along, length, width), nave, "church", "old town")):
        site.place(Plan(Strip.bar(tower_corner, along, side, side), spire, "church", "old town"))
    return site.plans


def town_hall(ring: Points, generator: np.random.Generator) -> list[Plan]:
    """Returns the town hall at one side of the market square, the rest left open."""
    along = edge_directions(ring)
    lengths = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
    k = int(np.argmax(lengths))
    length, depth = float(min(34.0, 0.6 * lengths[k])), 15.0
    corner = ring[k] + along[k] * (lengths[k] - length) / 2 + left_of(along[k]) * 2.0
    strip, roof = Strip.bar(corner, along[k], length, depth), mansard(11.0, depth)
    plan = Plan(strip, roof, "public", "old town", tuple(dormers(strip, roof, generator)))
    site = Site(ring)
    site.place(plan)
    return site.plans


def courtyard_house(ring: Points, district: str, generator: np.random.Generator) -> list[Plan]:
    """Returns one building around a courtyard (a convent, a court of justice), or nothing without room."""
    depth = float(generator.uniform(11.0, 13.5))
    if len(ring) > 6 or inset(ring, depth + _COURTYARD_M / 2) is None:
        return []
    strip = Strip.bent(ring, [depth] * len(ring), closed=True)
    roof = gabled(eaves(3, generator), float(generator.uniform(32, 42)), depth)
    return [Plan(strip, roof, "public", district, tuple(dormers(strip, roof, generator)))]
