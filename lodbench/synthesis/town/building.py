"""One building of the town, at three levels of detail."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.town.details import Annex, RoofBox
from lodbench.synthesis.town.extrusion import Body, Strip
from lodbench.synthesis.town.roofs import Roof
from lodbench.synthesis.town.shapes import area
from lodbench.synthesis.town.solid import Solid, prism
from lodbench.synthesis.town.terrain import Terrain

Points = NDArray[np.float64]

# LoD1 outlines are generalised: corners snap to this grid, and courtyards below this size are filled.
LOD1_GRID_M = 0.5
LOD1_COURTYARD_M2 = 120.0
# LoD1 boxes end this share of the way from the eaves to the ridge, more or less.
LOD1_HEIGHT_SHARE = 0.5
LOD1_HEIGHT_SIGMA_M = 0.5


class Age(Enum):
    """What happened to a building between the survey of the coarse map and the photos."""

    KNOWN = "known"
    NEW = "new"  # built since: LoD3 only
    GONE = "gone"  # pulled down since: LoD1 and LoD2 only
    RAISED = "raised"  # got storeys since: LoD1 and LoD2 are lower


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What is decided of a building before it stands.

    Attributes:
        strip: Its plan.
        roof: Its roof, heights above the base.
        function: ``residential``, ``commercial``, ``public``, ``church``, ``industrial``, ``garage``.
        district: Where in town it stands.
        details: Annexes and lift houses, which LoD2 shows, and dormers, which only LoD3 shows.
    """

    strip: Strip
    roof: Roof
    function: str
    district: str
    details: tuple[Annex | RoofBox, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Building:
    """A building with its solids, local metres.

    Attributes:
        identifier: Unique and stable for a seed.
        plan: What it was built from.
        age: Whether the coarse map still tells the truth about it.
        lod1: A box over the generalised outline, from the ground to between eaves and ridge, its
            height as wrong as measured ones are.
        lod2: Walls, roof faces, annexes and lift houses.
        lod3: The same with eaves that stand out, dormers, windows and doors.
        installations: Chimneys and balconies of LoD3, each a closed body of its own.
    """

    identifier: str
    plan: Plan
    age: Age
    lod1: Solid
    lod2: Solid
    lod3: Solid
    installations: tuple[Solid, ...]


def pieces_of(plan: Plan) -> list[Points]:
    """Returns the convex pieces of a plan with its annexes, (4, 2) each, counter-clockwise."""
    annexes = [detail for detail in plan.details if isinstance(detail, Annex)]
    body = Body(plan.strip, plan.roof, 0.0) if annexes else None
    return [*plan.strip.pieces, *[annex.plan(body) for annex in annexes if body is not None]]


def base_of(plan: Plan, terrain: Terrain) -> float:
    """Returns the height a building stands on: the lowest ground under its outline, so no side floats."""
    return round(float(terrain.height(np.concatenate(plan.strip.rings)).min()), 2)


def coarse_box(plan: Plan, base_m: float, height_error_m: float) -> Solid:
    """Returns the LoD1 box of a plan, its height off by an error, at least 2 m high."""
    rise = plan.roof.ridge_m - plan.roof.eave_m
    height = max(plan.roof.eave_m + LOD1_HEIGHT_SHARE * rise + height_error_m, 2.0)
    return prism(_generalised(plan.strip.rings), base_m, round(base_m + height, 2))


def plain_body(plan: Plan, base_m: float) -> Solid:
    """Returns the LoD2 solid of a plan."""
    body = Body(plan.strip, plan.roof, base_m)
    for detail in plan.details:
        if not (isinstance(detail, RoofBox) and detail.is_dormer):
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
