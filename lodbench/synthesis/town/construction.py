"""Plans become buildings: on their ground, beside their neighbours, at three levels of detail."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lodbench.storage import random_stream
from lodbench.synthesis.town.building import (
    LOD1_HEIGHT_SIGMA_M,
    Age,
    Building,
    Plan,
    base_of,
    coarse_box,
    plain_body,
)
from lodbench.synthesis.town.details import Annex
from lodbench.synthesis.town.extrusion import Body
from lodbench.synthesis.town.fittings import STOREY_M, chance
from lodbench.synthesis.town.installations import balconies, chimneys
from lodbench.synthesis.town.looks import Look
from lodbench.synthesis.town.occupancy import Occupancy
from lodbench.synthesis.town.openings import Neighbourhood, add_openings, has_balconies
from lodbench.synthesis.town.roofs import half_hipped, shed
from lodbench.synthesis.town.solid import Solid
from lodbench.synthesis.town.terrain import Terrain

# How far roofs stand out over walls.
_OVERHANG_M = (0.25, 0.6)
# Shares of buildings that were built, pulled down, and raised by storeys since the coarse map was made.
_NEW, _GONE, _RAISED = 0.05, 0.04, 0.08
# Precision of LoD3 points.
_PER_METRE = 10_000


def construct_all(
    named: Sequence[tuple[str, Plan]], seed: int, look: Look, terrain: Terrain, occupancy: Occupancy
) -> list[Building]:
    """Returns the buildings of all plans.

    Args:
        named: Identifiers and plans; their order is that of ``occupancy``.
        seed: The town's.
        look: The town's.
        terrain: The ground.
        occupancy: Who stands where.
    """
    return [
        _construct(name, plan, Neighbourhood(k, occupancy, terrain, _annex_m(plan)), seed)
        for k, (name, plan) in enumerate((name, restyled(name, plan, seed, look)) for name, plan in named)
    ]


def restyled(name: str, plan: Plan, seed: int, look: Look) -> Plan:
    """Returns a plan whose plain gabled roof may have become another as the town's look has it."""
    strip, roof, draw = plan.strip, plan.roof, float(random_stream(seed, "demo", name, "roof").random())
    if roof.name != "gabled" or strip.num_segments > 1 or strip.closed or plan.details:
        return plan
    depth = float(np.linalg.norm(strip.inner[0] - strip.outer[0]))
    if draw < look.half_hipped and roof.profile[1][0] == 0.5:
        return replace(plan, roof=half_hipped(roof, depth))
    if look.half_hipped <= draw < look.half_hipped + look.shed:
        return replace(plan, roof=shed(roof.eave_m, 14.0, depth))
    return plan


def _annex_m(plan: Plan) -> float:
    return max((detail.height_m for detail in plan.details if isinstance(detail, Annex)), default=0.0)


def _construct(name: str, plan: Plan, place: Neighbourhood, seed: int) -> Building:
    chances = random_stream(seed, "demo", name, "details")
    base_m = base_of(plan, place.terrain)
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
    if (
        draw > _NEW + _GONE + _RAISED
        or plan.roof.eave_m - lower_m < 2.4
        or any(isinstance(detail, Annex) for detail in plan.details)
    ):
        return Age.KNOWN, plan
    return Age.RAISED, replace(plan, roof=plan.roof.lowered(lower_m))


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
