"""Chance details of buildings: roofs by district, dormers in a row, annexes at the back."""

from __future__ import annotations

import numpy as np

from lodbench.synthesis.town.details import Annex, RoofBox
from lodbench.synthesis.town.extrusion import Body, Strip, wing_direction
from lodbench.synthesis.town.roofs import Roof, flat, gabled, hipped, mansard

STOREY_M = 3.1


def chance(generator: np.random.Generator, probability: float) -> bool:
    """Returns True with a probability."""
    return bool(generator.random() < probability)


def eaves(storeys: int, generator: np.random.Generator) -> float:
    """Returns the height of the eaves over so many storeys, metres."""
    return storeys * STOREY_M + float(generator.uniform(0.3, 1.2))


def town_roof(eave_m: float, depth_m: float, generator: np.random.Generator, modern: float) -> Roof:
    """Returns the roof of a house in a row.

    Args:
        eave_m: Height of the eaves.
        depth_m: Depth of the house.
        generator: Source of chance.
        modern: Share of flat roofs.
    """
    draw = float(generator.random())
    if draw < modern:
        return flat(eave_m + 0.8)
    if draw < modern + 0.16:
        return mansard(eave_m, depth_m)
    return gabled(eave_m, float(generator.uniform(36, 50)), depth_m, float(generator.uniform(0.45, 0.55)))


def house_roof(eave_m: float, strip: Strip, generator: np.random.Generator) -> Roof:
    """Returns the roof of a house that stands alone."""
    depth = float(np.linalg.norm(strip.inner[0] - strip.outer[0]))
    draw, pitch = float(generator.random()), float(generator.uniform(30, 46))
    if draw < 0.12:
        return flat(eave_m + 0.4)
    if draw < 0.62 or strip.num_segments > 1:
        return gabled(eave_m, pitch, depth)
    _, _, length = wing_direction(strip, 0)
    return hipped(eave_m, min(pitch, 36.0), depth, length)


def dormers(strip: Strip, roof: Roof, generator: np.random.Generator) -> list[RoofBox]:
    """Returns dormers in a row on one side of the first wing, as many as fit; none on shallow roofs."""
    if not roof.shape.has_dormers:
        return []
    body = Body(strip, roof, 0.0)
    slope = 0 if chance(generator, 0.6) else len(roof.profile) - 2
    low, high = sorted((roof.profile[slope], roof.profile[slope + 1]), key=lambda point: point[1])
    depth_m = float(np.linalg.norm(strip.inner[0] - strip.outer[0]))
    run, rise = abs(high[0] - low[0]) * depth_m, high[1] - low[1]
    width, front = float(generator.uniform(1.2, 2.2)), float(generator.uniform(0.15, 0.3)) * run
    back = min(front + 1.5 * run / rise, 0.85 * run)
    _, _, length = wing_direction(strip, 0)
    spacing = float(generator.uniform(2.6, 4.2))
    start = float(generator.uniform(1.0, 2.0))
    places = start + spacing * np.arange(int(length / spacing))
    row = [RoofBox(0, slope, place, width, front, back - front) for place in places.tolist()]
    return [box for box in row if back - front > 0.8 and box.fits(body)]


def annex(side: str, length_m: float, eave_m: float, generator: np.random.Generator) -> list[Annex | RoofBox]:
    """Returns one extension of a wall of the first wing, if the wall is long and high enough for it."""
    width = float(generator.uniform(0.3, 0.6)) * length_m
    height = min(float(generator.uniform(2.8, 4.2)), eave_m - 0.8)
    if width < 2.5 or length_m - width < 1.5 or height < 2.2:
        return []
    start = float(generator.uniform(0.5, length_m - width - 0.5))
    return [Annex(side, 0, start, width, float(generator.uniform(2.0, 4.5)), height)]


def lift_houses(strip: Strip, roof: Roof, count: int, generator: np.random.Generator) -> list[RoofBox]:
    """Returns boxes spread along the first wing of a flat roof."""
    _, _, length = wing_direction(strip, 0)
    depth = float(np.linalg.norm(strip.inner[0] - strip.outer[0]))
    body = Body(strip, roof, 0.0)
    row = [
        RoofBox(0, 0, length * (k + 0.5) / count - 2.0, 4.0, 0.3 * depth, 0.35 * depth, rise)
        for k, rise in enumerate(generator.uniform(2.2, 3.4, size=count).tolist())
    ]
    return [box for box in row if box.fits(body)]
