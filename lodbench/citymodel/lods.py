"""Levels of detail: which one is meant, and which polygons it takes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import LOD_SUBSTITUTED
from lodbench.citymodel.model import CityModel, Polygons, SurfaceKind, outer_parts
from lodbench.citymodel.raw import take_segments
from lodbench.errors import CityModelError
from lodbench.findings import Findings

# Instead of one level for all: of each building the level with most detail, or with least.
FINEST, COARSEST = "finest", "coarsest"


def polygons_at(
    model: CityModel, wanted: str | None, findings: Findings, stands_in: bool = True
) -> tuple[str, NDArray[np.bool_]]:
    """Returns the name of what is meshed, and (P,) which of the model's P polygons belong to it.

    Args:
        model: The city.
        wanted: A level of the whole file, see ``choose_lod``; or ``finest`` or ``coarsest``: of each building
            its own. Cities mix levels: a few landmarks at LoD2 among blocks at LoD1. Footprints (LoD0) are
            no building's finest or coarsest, interiors nobody's. An object that is no building and lacks the
            level has its finest below it, else its coarsest above.
        findings: See ``choose_lod``.
        stands_in: Whether it has it.

    Raises:
        CityModelError: The level is absent.
    """
    polygons = model.polygons
    wish = None if wanted is None else _plain(wanted)
    is_building = model.is_building() | (not stands_in)
    if wish not in (FINEST, COARSEST):
        used = np.unique(polygons.lod[is_building[polygons.building]]).tolist()
        present = [model.lods[n] for n in used] if used and not is_building.all() else model.lods
        name = choose_lod(present, wanted, findings, model.measured_m is not None)
        at_level: NDArray[np.bool_] = polygons.lod == model.lods.index(name)
        if not is_building.all():
            at_level |= _own_level(model, name, ~is_building)
        return name, at_level
    order = {name: rank for rank, name in enumerate(sorted(model.lods))}
    ranks = np.array([order[name] for name in model.lods], np.int64)
    ranks = ranks if wish == FINEST else len(ranks) - 1 - ranks
    has_walls = np.array([not name.startswith("0") for name in model.lods], np.bool_)
    counts = has_walls[polygons.lod] & (polygons.kind != SurfaceKind.INTERIOR)
    rank = np.where(counts, ranks[polygons.lod], -1)
    unit, is_lead = _units(model, counts, wish)
    best = np.full(int(unit.max(initial=-1)) + 1, -1, np.int64)
    np.maximum.at(best, unit[is_lead], rank[is_lead])
    is_led = best[unit] >= 0
    np.maximum.at(best, unit[~is_led], rank[~is_led])
    return wish, counts & (rank == best[unit])


def _units(
    model: CityModel, counts: NDArray[np.bool_], wish: str
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Returns what each polygon chooses its level with, and whether it has a say in it."""
    polygons, objects = model.polygons, model.objects
    if polygons.part is None or objects is None:
        return polygons.building.astype(np.int64), counts
    own = polygons.part.astype(np.int64)
    outer = outer_parts(objects)[own].astype(np.int64)
    is_lead = counts & (outer == own)
    root = np.zeros(len(model.building_ids), np.int64)
    is_root = objects.parents < 0
    root[objects.building[is_root]] = np.flatnonzero(is_root)
    # Walls of the building itself may stand for those of all its parts.
    is_whole = np.zeros(len(root), np.bool_)
    is_whole[polygons.building[is_lead & is_root[own]]] = True
    unit = np.where(is_whole[polygons.building], root[polygons.building], outer)
    return (np.where(outer == own, unit, own) if wish == FINEST else unit), is_lead


def _own_level(model: CityModel, name: str, is_other: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns which polygons are of objects that lack a level, at the level that stands in for it."""
    polygons = model.polygons
    order = {other: rank for rank, other in enumerate(sorted(model.lods))}
    ranks = np.array([order[other] for other in model.lods], np.int64)
    # Below the level the finest is best, above it the coarsest; above counts after all below.
    distance = np.where(ranks <= order[name], order[name] - ranks, len(ranks) + ranks - order[name])
    own = np.where(is_other[polygons.building], distance[polygons.lod], 2 * len(ranks))
    best = np.full(len(model.building_ids), 2 * len(ranks), np.int64)
    np.minimum.at(best, polygons.building, own)
    is_best: NDArray[np.bool_] = is_other[polygons.building] & (own == best[polygons.building])
    return is_best


def lod_in_words(lod: str) -> str:
    """Returns a level's name for readers.

    Example:
        >>> lod_in_words("2.2"), lod_in_words("finest")
        ('LoD2.2', 'finest LoD')
    """
    return f"{lod} LoD" if lod in (FINEST, COARSEST) else f"LoD{lod}"


def choose_lod(
    present: Sequence[str], wanted: str | None, findings: Findings, has_heights: bool = False
) -> str:
    """Returns the name of the level to mesh, one for the whole file.

    Without a wish it is the lowest level that has walls: 1 if present, else 2, else 3; footprints
    (LoD0) only where there is nothing else. A whole number stands for its refinements: "1" takes
    "1.2" before "1.3", because the coarser of two is the closer to a plain LoD1. "3" also takes
    the outer shell of a LoD4. A source without levels ("") serves every wish.

    Args:
        present: Level names of the file.
        wanted: The level requested, or None.
        findings: Receives ``LOD_SUBSTITUTED`` where the name taken is not the name requested.
        has_heights: Whether the source states heights of buildings.

    Raises:
        CityModelError: The level is absent; the message names those that are there.

    Example:
        >>> choose_lod(["0", "1.2", "1.3", "2.2"], "1", Findings())
        '1.2'
    """
    names = sorted(present)
    if not names:
        raise CityModelError(
            "The city model has no geometry at any level of detail.", "Is it the building tile of the city?"
        )
    if wanted is None:
        return next((name for name in names if not name.startswith("0")), names[0])
    wanted = _plain(wanted)
    if wanted in names:
        return wanted
    candidates = _candidates(names, wanted)
    if not candidates:
        hint = f"Ask for `lod={names[-1]}`."
        if wanted == "1" and (names[-1] >= "2" or has_heights):
            hint = f"Ask for `lod={names[-1]}`, or derive it: `roof_height=median` (or max, p70, eave)."
        raise CityModelError(
            f"No building has a level of detail {wanted}; the file has: {', '.join(names)}.", hint
        )
    findings.add(LOD_SUBSTITUTED, "", f"{wanted} requested, {candidates[0] or 'unnamed level'} used")
    return candidates[0]


def has_lod(present: Sequence[str], wanted: str) -> bool:
    """Returns whether ``choose_lod`` would find a level.

    Example:
        >>> has_lod(["0", "2.2"], "2"), has_lod(["0", "2.2"], "1")
        (True, False)
    """
    return bool(_candidates(sorted(present), _plain(wanted)))


def _plain(wanted: str) -> str:
    return wanted.strip().lower().removeprefix("lod")


def _candidates(names: list[str], wanted: str) -> list[str]:
    found = [name for name in names if name.partition(".")[0] == wanted or name in (wanted, "")]
    if wanted == "3" and "4" in names:
        found.append("4")
    return found


def select_polygons(polygons: Polygons, chosen: NDArray[np.int64]) -> Polygons:
    """Returns some of the polygons, in the order given."""
    if len(chosen) == len(polygons) and np.all(chosen[1:] > chosen[:-1]):
        return polygons
    rings, polygon_starts = take_segments(polygons.polygon_starts, chosen)
    points, ring_starts = take_segments(polygons.ring_starts, rings)
    return Polygons(
        points=polygons.points[points],
        ring_starts=ring_starts,
        polygon_starts=polygon_starts,
        building=polygons.building[chosen],
        lod=polygons.lod[chosen],
        kind=polygons.kind[chosen],
        part=None if polygons.part is None else polygons.part[chosen],
        picture=None if polygons.picture is None else polygons.picture[chosen],
        uv=None if polygons.uv is None else polygons.uv[points],
    )


def slice_polygons(polygons: Polygons, first: int, last: int) -> Polygons:
    """Returns the polygons from ``first`` to before ``last``; their arrays are views."""
    if first == 0 and last >= len(polygons):
        return polygons
    rings = polygons.polygon_starts[first : last + 1]
    points = polygons.ring_starts[rings[0] : rings[-1] + 1]
    return Polygons(
        points=polygons.points[points[0] : points[-1]],
        ring_starts=points - points[0],
        polygon_starts=rings - rings[0],
        building=polygons.building[first:last],
        lod=polygons.lod[first:last],
        kind=polygons.kind[first:last],
        part=None if polygons.part is None else polygons.part[first:last],
        picture=None if polygons.picture is None else polygons.picture[first:last],
        uv=None if polygons.uv is None else polygons.uv[points[0] : points[-1]],
    )


def polygon_blocks(
    polygons: Polygons, chosen: NDArray[np.int64], block_polygons: int
) -> Iterator[tuple[int, Polygons]]:
    """Yields the chosen polygons by building, some thousand at a time, and how many came before.

    A building is never cut, and the buildings ascend.
    """
    building = polygons.building[chosen]
    if np.any(building[1:] < building[:-1]):
        order = np.argsort(building, kind="stable")
        chosen, building = chosen[order], building[order]
    for first, last in pairwise(group_cuts(building, block_polygons)):
        yield first, select_polygons(polygons, chosen[first:last])


def group_cuts(groups: NDArray[np.integer], size: int) -> list[int]:
    """Returns where to cut items in ascending groups into blocks of about ``size`` whole groups.

    Example:
        >>> group_cuts(np.array([0, 0, 0, 4, 4, 7]), 2)
        [0, 3, 5, 6]
    """
    is_last = np.append(groups[1:] != groups[:-1], True)
    ends = np.flatnonzero(is_last[: len(groups)]) + 1
    wanted = np.arange(size, len(groups) + size, size).clip(max=len(groups))
    cuts: list[int] = np.unique(ends[np.searchsorted(ends, wanted)]).tolist()
    return [0, *cuts]
