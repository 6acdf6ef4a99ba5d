"""The city model as read: buildings and their polygons at every level of detail, before meshing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import LOD_SUBSTITUTED, STAYS_FLAT
from lodbench.errors import CityModelError
from lodbench.findings import Findings

# First day, and the day after the last, between which the same objects stand; None where none has an end.
Period = tuple[str, str]
# No land lies lower or higher, metres: what does is a mark for cells where nobody measured, -9999 mostly.
LOWEST_M, HIGHEST_M = -500.0, 9000.0
# No house is higher: heights above the sea are.
TALLEST_M = 1000.0
FLAT = "0"  # what names of levels without walls begin with
NO_PICTURE = -1
# From here downward a polygon has no picture but the colour of its material.
FIRST_COLOUR = -2
# Instead of one level for all: of each building the level with most detail, or with least.
FINEST, COARSEST = "finest", "coarsest"
Colour = tuple[int, int, int]


class SurfaceKind(IntEnum):
    """What a polygon is part of, as far as the source says."""

    UNKNOWN = 0
    WALL = 1
    ROOF = 2
    GROUND = 3
    CLOSURE = 4
    OPENING = 5  # windows, and openings of no known kind
    INSTALLATION = 6
    FLOOR = 7  # outer floors: balconies, arcades
    INTERIOR = 8  # rooms and furniture: read, counted, never meshed
    DOOR = 9
    CEILING = 10  # outer ceilings: what a balcony or an arcade shows from below


@dataclass(frozen=True, slots=True)
class Polygons:
    """Planar polygons with holes, flat: points belong to rings, rings to polygons.

    Rings are not closed (the last point differs from the first); the first ring of a polygon is
    its outline, the others are holes.
    """

    points: NDArray[np.float64]  # (P, 3) float64, metres in the model's local frame (x east, y north, z up)
    ring_starts: NDArray[np.int64]  # (R + 1,) int64 offsets into ``points``
    polygon_starts: NDArray[np.int64]  # (N + 1,) int64 offsets into the rings
    building: NDArray[np.int32]  # (N,) int32 index of the building each polygon belongs to
    lod: NDArray[np.int16]  # (N,) int16 index into ``CityModel.lods``
    kind: NDArray[np.uint8]  # (N,) uint8 ``SurfaceKind``
    # (N,) int32 index into ``CityModel.objects``; None where buildings are all there is
    part: NDArray[np.int32] | None = None
    # (N,) int32 index into ``CityModel.pictures``, -1 for none; None where none were requested
    picture: NDArray[np.int32] | None = None
    # (P, 2) float64 place of each point on its polygon's picture, (0, 0) the lower left corner; NaN where
    # there is none. With ``picture``.
    uv: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.building)


@dataclass(frozen=True, slots=True, repr=False)
class CityModel:
    """Buildings with their polygons, in metres, in a local frame.

    ``points + origin`` are coordinates in ``crs``. A model without a CRS is in a local frame of
    its own (a Wavefront OBJ); its origin is zero unless the user gave one.
    """

    source: str  # the file or folder it was read from
    format: str  # ``"CityGML"``, ``"OBJ"``, ..
    version: str | None  # the format's version, or None where the format has none
    crs: str | None  # name pyproj understands (``"EPSG:25832+7837"``), or None when unknown
    origin: NDArray[np.float64]  # (3,) float64, what was subtracted from the CRS coordinates
    building_ids: tuple[str, ...]  # one id per building, in file order
    num_parts: int  # building parts met, over all buildings
    lods: tuple[str, ...]  # names of the levels of detail present, ascending: ``("0", "1", "2.2")``
    polygons: Polygons  # all polygons of all levels
    polygons_read: tuple[int, ...]  # per level, polygons in the file; those too short to be one are not kept
    findings: Findings  # what was wrong, changed or dropped while reading
    objects: CityObjects | None = None  # buildings and their parts; None where buildings are all there is
    # Volumes that the polygons close; only with ``ReadOptions(has_details=True)``
    solids: Solids | None = None
    polygon_ids: tuple[str, ...] = ()  # the source's id of each polygon, or ""; likewise, else empty
    has_interiors: bool = False  # whether rooms and furniture are requested
    has_textures: bool = False  # whether the source has pictures or materials of its surfaces
    pictures: Pictures | None = None  # those; only with ``ReadOptions(has_textures=True)``
    # (B,) which buildings have pitched roofs, as the source states; None where it states none
    pitched: NDArray[np.bool_] | None = None
    # (B,) heights of buildings above the ground, as the source states, NaN where it does not; None where it
    # states none
    measured_m: NDArray[np.float64] | None = None
    # First day, and the day after the last, between which the same buildings stand; None where no building
    # has an end
    period: Period | None = None

    def __repr__(self) -> str:
        counts = f"{len(self.building_ids)} buildings, {len(self.polygons)} polygons"
        levels = ", ".join(name or "unnamed" for name in self.lods)
        return f"CityModel({counts}, LoD {levels}, {self.crs or 'local frame'}, {self.source})"

    def types(self) -> tuple[str, ...]:
        """Returns what each of ``building_ids`` is, as CityJSON calls it; buildings where nothing is said."""
        if self.objects is None:
            return ("Building",) * len(self.building_ids)
        roots = np.flatnonzero(self.objects.parents < 0).tolist()
        types = {int(self.objects.building[n]): self.objects.types[n] for n in roots}
        return tuple(types.get(n, "Building") for n in range(len(self.building_ids)))

    def is_building(self) -> NDArray[np.bool_]:
        """Returns which of ``building_ids`` are buildings, and no objects of another layer."""
        return np.array(["Building" in name for name in self.types()], np.bool_)


@dataclass(frozen=True, slots=True)
class CityObjects:
    """The objects of a city as a tree, flat, parents before their children."""

    ids: tuple[str, ...]  # O ids
    # O names as CityJSON has them: ``Building``, ``BuildingPart``, ``BuildingInstallation``, ..
    types: tuple[str, ...]
    parents: NDArray[np.int32]  # (O,) int32 index of the object each is part of, -1 for buildings
    building: NDArray[np.int32]  # (O,) int32 index of the building each belongs to
    attributes: tuple[dict[str, Any], ...] = ()  # O mappings, or none at all where details were not requested

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True)
class Solids:
    """Which polygons close which volume, flat: faces belong to shells, shells to solids."""

    part: NDArray[np.int32]  # (S,) int32 object each solid belongs to
    # (S + 1,) int64 offsets into the shells; the first of a solid is its outside
    shell_starts: NDArray[np.int64]
    face_starts: NDArray[np.int64]  # (H + 1,) int64 offsets into the faces
    faces: NDArray[np.int64]  # (F,) int64 polygon of each face; -1 where the polygon was dropped
    is_flipped: NDArray[np.bool_]  # (F,) bool, whether the solid sees the polygon from behind
    composite: NDArray[np.int32]  # (S,) int32 composite that each solid is a part of, -1 for none

    def shells_of(self, solid: int) -> list[list[tuple[int, bool]]]:
        """Returns polygon and direction of each face of each shell; faces that were dropped are left out."""
        shells = []
        for shell in range(self.shell_starts[solid], self.shell_starts[solid + 1]):
            span = slice(self.face_starts[shell], self.face_starts[shell + 1])
            faces = zip(self.faces[span].tolist(), self.is_flipped[span].tolist(), strict=True)
            shells.append([face for face in faces if face[0] >= 0])
        return [shell for shell in shells if shell]


def outer_parts(objects: CityObjects) -> NDArray[np.int32]:
    """Returns (O,) the building or part each object stands with: itself, or what it hangs on."""
    result = np.arange(len(objects), dtype=np.int32)
    for n, (type_, parent) in enumerate(zip(objects.types, objects.parents.tolist(), strict=True)):
        if type_ not in ("Building", "BuildingPart") and 0 <= parent < n:
            result[n] = result[parent]
    return result


def starts_of(lengths: NDArray[np.integer]) -> NDArray[np.int64]:
    """Returns offsets from lengths: ``(n + 1,)``, beginning with 0.

    Example:
        >>> starts_of(np.array([2, 3]))
        array([0, 2, 5])
    """
    starts = np.zeros(len(lengths) + 1, np.int64)
    np.cumsum(lengths, out=starts[1:])
    return starts


def group_by(owner: NDArray[np.integer]) -> dict[int, list[int]]:
    """Returns the indices of each owner, ascending.

    Example:
        >>> group_by(np.array([7, 2, 7]))
        {7: [0, 2], 2: [1]}
    """
    groups: dict[int, list[int]] = {}
    for n, number in enumerate(owner.tolist()):
        groups.setdefault(number, []).append(n)
    return groups


def take_segments(
    starts: NDArray[np.int64], chosen: NDArray[np.integer]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the item indices of the chosen segments in a row, and the offsets of the result.

    Args:
        starts: (S + 1,) offsets of all segments.
        chosen: (C,) segment indices, in any order, repeats allowed.

    Returns:
        items: indices into the items the segments are made of.
        new_starts: (C + 1,) offsets into ``items``.

    Example:
        >>> take_segments(np.array([0, 2, 5]), np.array([1, 0]))
        (array([2, 3, 4, 0, 1]), array([0, 3, 5]))
    """
    lengths = starts[chosen + 1] - starts[chosen]
    new_starts = starts_of(lengths)
    items = np.arange(new_starts[-1]) + np.repeat(starts[chosen] - new_starts[:-1], lengths)
    return items, new_starts


def select_polygons(polygons: Polygons, chosen: NDArray[np.int64]) -> Polygons:
    """Returns some of the polygons, in the order given."""
    if len(chosen) == len(polygons) and np.all(chosen[1:] > chosen[:-1]):
        return polygons
    rings, polygon_starts = take_segments(polygons.polygon_starts, chosen)
    points, ring_starts = take_segments(polygons.ring_starts, rings)
    return _some(polygons, chosen, points, ring_starts, polygon_starts)


def slice_polygons(polygons: Polygons, first: int, last: int) -> Polygons:
    """Returns the polygons from ``first`` to before ``last``; their arrays are views."""
    if first == 0 and last >= len(polygons):
        return polygons
    rings = polygons.polygon_starts[first : last + 1]
    starts = polygons.ring_starts[rings[0] : rings[-1] + 1]
    points = slice(starts[0], starts[-1])
    return _some(polygons, slice(first, last), points, starts - starts[0], rings - rings[0])


def _some(
    polygons: Polygons, chosen: Any, points: Any, ring_starts: NDArray[np.int64], starts: NDArray[np.int64]
) -> Polygons:
    names = ("building", "lod", "kind", "part", "picture")
    columns = {name: column for name in names if (column := getattr(polygons, name)) is not None}
    of_each = {name: column[chosen] for name, column in columns.items()}
    uv = None if polygons.uv is None else polygons.uv[points]
    return Polygons(polygons.points[points], ring_starts, starts, **of_each, uv=uv)


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


@dataclass(frozen=True, slots=True)
class Pictures:
    """The pictures of a city; polygons name them by number (``Polygons.picture``, ``Polygons.uv``)."""

    files: tuple[Path, ...] = ()  # where each lies
    notes: tuple[str, ...] = ()  # what of the source's appearances is not kept, a line each
    # RGB of materials; a polygon without a picture has number ``FIRST_COLOUR - k`` for the k-th
    colours: tuple[Colour, ...] = ()
    # How each goes on beyond its edges, in the word of CityGML, "" where nothing is said
    wraps: tuple[str, ...] = ()


def is_flat(model: CityModel) -> NDArray[np.bool_]:
    """Returns which buildings have a known height, and outlines at level 0 alone; (B,)."""
    if model.measured_m is None:
        return np.zeros(len(model.building_ids), np.bool_)
    polygons = model.polygons
    has_walls, has_outline = np.zeros((2, len(model.building_ids)), np.bool_)
    at_level_0 = np.array([name.startswith(FLAT) for name in model.lods], np.bool_)[polygons.lod]
    has_outline[polygons.building[at_level_0]] = True
    has_walls[polygons.building[~at_level_0 & (polygons.kind != SurfaceKind.INTERIOR)]] = True
    return has_outline & ~has_walls & np.isfinite(model.measured_m)


def tell_flat(model: CityModel, findings: Findings) -> None:
    """Adds a finding for each building that is drawn flat though its height is known."""
    if model.measured_m is not None:
        for n in np.flatnonzero(is_flat(model)).tolist():
            detail = f"{model.measured_m[n]:g} m high; as a block with lod=1 and roof_height=max"
            findings.add(STAYS_FLAT, model.building_ids[n], detail)


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
    wanted = plain_level(wanted)
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
    return bool(_candidates(sorted(present), plain_level(wanted)))


def plain_level(wanted: str) -> str:
    """Returns a level as it is named in files: ``LoD2`` is ``2``."""
    return wanted.strip().lower().removeprefix("lod")


def _candidates(names: list[str], wanted: str) -> list[str]:
    levels = [name for name in names if name.partition(".")[0] == wanted or name in (wanted, "")]
    if wanted == "3" and "4" in names:
        levels.append("4")
    return levels
