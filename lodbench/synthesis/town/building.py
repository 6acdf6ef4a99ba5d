"""Plans become buildings: on their ground, beside their neighbours, at three levels of detail."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np

from lodbench.storage import random_stream
from lodbench.synthesis.town.extrusion import Body, Strip
from lodbench.synthesis.town.fittings import STOREY_M, Annex, Detail, RoofBox, balconies, chance, chimneys
from lodbench.synthesis.town.looks import TownLook
from lodbench.synthesis.town.openings import Neighbourhood, add_openings, has_balconies
from lodbench.synthesis.town.roofs import Roof, half_hipped, shed
from lodbench.synthesis.town.shapes import Points, area
from lodbench.synthesis.town.solid import Solid, prism
from lodbench.synthesis.town.terrain import Occupancy, Terrain

# LoD1 outlines are generalised: corners snap to this grid, and courtyards below this size are filled.
LOD1_GRID_M = 0.5
LOD1_COURTYARD_M2 = 120.0
# LoD1 boxes end this share of the way from the eaves to the ridge, more or less.
LOD1_HEIGHT_SHARE = 0.5
LOD1_HEIGHT_SIGMA_M = 0.5
# How far roofs stand out over walls.
_OVERHANG_M = (0.25, 0.6)
# Shares of buildings that were built, pulled down, and raised by storeys since the coarse map was made.
_NEW, _GONE, _RAISED = 0.05, 0.04, 0.08
# Precision of LoD3 points.
_PER_METRE = 10_000


class Age(Enum):
    """What happened to a building between the survey of the coarse map and the photos."""

    KNOWN = "known"
    NEW = "new"  # built since: LoD3 only
    GONE = "gone"  # pulled down since: LoD1 and LoD2 only
    RAISED = "raised"  # got storeys since: LoD1 and LoD2 are lower


class Plan(NamedTuple):
    """What is decided of a building before it stands."""

    strip: Strip  # its plan
    roof: Roof  # its roof, heights above the base
    function: str  # ``residential``, ``commercial``, ``public``, ``church``, ``industrial``, ``garage``
    district: str  # where in town it stands
    # Annexes and lift houses, which LoD2 shows, and dormers, which only LoD3 shows.
    details: tuple[Detail, ...] = ()

    @property
    def annexes(self) -> list[Annex]:
        """Returns the details that stand before walls."""
        return [detail for detail in self.details if isinstance(detail, Annex)]

    @property
    def pieces(self) -> list[Points]:
        """Returns its convex pieces, annexes included, (4, 2) each, counter-clockwise."""
        annexes = [annex.plan(Body(self.strip, self.roof, 0.0)) for annex in self.annexes]
        return [*self.strip.pieces, *annexes]


class Building(NamedTuple):
    """A building with its solids, local metres."""

    identifier: str  # unique and stable for a seed
    plan: Plan  # what it was built from
    age: Age  # whether the coarse map still tells the truth about it
    # A box over the generalised outline, from the ground to between eaves and ridge, its height as wrong as
    # measured ones are.
    lod1: Solid
    lod2: Solid  # walls, roof faces, annexes and lift houses
    lod3: Solid  # the same with eaves that stand out, dormers, windows and doors
    installations: tuple[Solid, ...]  # chimneys and balconies of LoD3, each a closed body of its own


def construct_all(
    named: Sequence[tuple[str, Plan]], seed: int, look: TownLook, terrain: Terrain, occupancy: Occupancy
) -> list[Building]:
    """Returns the buildings of identifiers and plans, whose order is that of ``occupancy``."""
    buildings = []
    for number, (name, plan) in enumerate(named):
        annex_m = max((annex.height_m for annex in plan.annexes), default=0.0)
        place = Neighbourhood(number, occupancy, terrain, annex_m)
        buildings.append(_construct(name, restyled(name, plan, seed, look), place, seed))
    return buildings


def restyled(name: str, plan: Plan, seed: int, look: TownLook) -> Plan:
    """Returns a plan whose plain gabled roof may have become another as the town's look has it."""
    strip, roof, draw = plan.strip, plan.roof, float(random_stream(seed, "demo", name, "roof").random())
    if roof.name != "gabled" or len(strip.wings) > 1 or plan.details:
        return plan
    if draw < look.half_hipped and roof.profile[1][0] == 0.5:
        return plan._replace(roof=half_hipped(roof, strip.start_depth_m))
    if look.half_hipped <= draw < look.half_hipped + look.shed:
        return plan._replace(roof=shed(roof.eave_m, 14.0, strip.start_depth_m))
    return plan


def _construct(name: str, plan: Plan, place: Neighbourhood, seed: int) -> Building:
    chances = random_stream(seed, "demo", name, "details")
    # The lowest ground under its outline, so that no side floats.
    base_m = round(float(place.terrain.height(np.concatenate(plan.strip.rings)).min()), 2)
    height_error = float(chances.normal(0.0, LOD1_HEIGHT_SIGMA_M))
    lod3, installations = _fine_body(plan, base_m, place, chances)
    age, mapped = _as_mapped(name, plan, seed)
    box, body = coarse_box(mapped, base_m, height_error), plain_body(mapped, base_m)
    return Building(name, plan, age, box, body, lod3, installations)


def _as_mapped(name: str, plan: Plan, seed: int) -> tuple[Age, Plan]:
    """Returns what became of a building since the coarse map was made, and its plan back then."""
    chances = random_stream(seed, "demo", name, "age")
    draw, storeys = float(chances.random()), int(chances.integers(1, 3))
    if plan.function in ("church", "public"):
        return Age.KNOWN, plan
    if draw < _NEW:
        return Age.NEW, plan
    if draw < _NEW + _GONE:
        return Age.GONE, plan
    lower_m = storeys * STOREY_M
    if draw > _NEW + _GONE + _RAISED or plan.roof.eave_m - lower_m < 2.4 or plan.annexes:
        return Age.KNOWN, plan
    return Age.RAISED, plan._replace(roof=plan.roof.lowered(lower_m))


def _fine_body(
    plan: Plan, base_m: float, place: Neighbourhood, chances: np.random.Generator
) -> tuple[Solid, tuple[Solid, ...]]:
    """Returns the LoD3 solid of a plan, and its chimneys and balconies."""
    body = Body(plan.strip, plan.roof, base_m, float(chances.uniform(*_OVERHANG_M)), _PER_METRE)
    for detail in plan.details:
        detail.add_to(body)
    windows = add_openings(body, plan.function, place, chances)
    extra: list[Solid] = []
    if plan.function in ("residential", "public") or chance(chances, 0.3):
        extra += chimneys(plan.strip, plan.roof, base_m, chances)
    if has_balconies(plan.roof.eave_m, plan.function, plan.district, chances):
        extra += balconies(windows, chances)
    return body.builder.build(), tuple(extra)


def coarse_box(plan: Plan, base_m: float, height_error_m: float) -> Solid:
    """Returns the LoD1 box of a plan, its height off by an error, at least 2 m high."""
    rise = plan.roof.ridge_m - plan.roof.eave_m
    height = max(plan.roof.eave_m + LOD1_HEIGHT_SHARE * rise + height_error_m, 2.0)
    return prism(_generalised(plan.strip.rings), base_m, round(base_m + height, 2))


def plain_body(plan: Plan, base_m: float) -> Solid:
    """Returns the LoD2 solid of a plan."""
    body = Body(plan.strip, plan.roof, base_m)
    for detail in plan.details:
        is_dormer = isinstance(detail, RoofBox) and detail.rise_m == 0.0
        if not is_dormer:
            detail.add_to(body)
    return body.builder.build()


def _generalised(rings: list[Points]) -> list[Points]:
    """Returns plan rings on the LoD1 grid, without small courtyards; unchanged where nothing is left."""
    kept = [rings[0], *[ring for ring in rings[1:] if -area(ring) >= LOD1_COURTYARD_M2]]
    snapped = []
    for ring in kept:
        coarse = np.round(ring / LOD1_GRID_M) * LOD1_GRID_M
        coarse = coarse[(coarse != np.roll(coarse, 1, axis=0)).any(axis=1)]
        sound = len(coarse) >= 3 and area(coarse) * area(ring) > 0
        snapped.append(coarse if sound else ring)
    return snapped
