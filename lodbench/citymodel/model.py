"""The city model as read: buildings and their polygons at every level of detail, before meshing."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.lifespans import Period
from lodbench.citymodel.pictures import Pictures
from lodbench.findings import Findings


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


# No house is higher: heights above the sea are.
TALLEST_M = 1000.0


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


@dataclass(slots=True)
class ObjectTable:
    """Grows the objects and solids of a city while it is read.

    Faces name polygons by serial numbers, which count all polygons met, dropped ones included.
    """

    has_details: bool
    ids: list[str] = field(default_factory=list)
    types: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    building: list[int] = field(default_factory=list)
    attributes: list[dict[str, Any]] = field(default_factory=list)
    solids: list[tuple[int, list[list[tuple[int, bool]]], int]] = field(default_factory=list)
    num_composites: int = 0
    polygon_ids: dict[int, str] = field(default_factory=dict)
    num_polygons: int = 0
    roof_types: list[tuple[int, str]] = field(default_factory=list)
    measured_m: dict[int, float] = field(default_factory=dict)

    def add(
        self,
        object_id: str,
        type_: str,
        parent: int,
        building: int,
        attributes: dict[str, Any] | None = None,
        roof_type: str = "",
        height_m: float | None = None,
    ) -> int:
        """Returns the index of a new object; its roof type and height count for its building."""
        if roof_type:
            self.roof_types.append((building, roof_type))
        if height_m is not None and 0 < height_m < TALLEST_M:  # of parts the highest
            self.measured_m[building] = max(height_m, self.measured_m.get(building, 0.0))
        self.ids.append(object_id)
        self.types.append(type_)
        self.parents.append(parent)
        self.building.append(building)
        if self.has_details:
            self.attributes.append(attributes or {})
        return len(self.ids) - 1

    @property
    def is_plain(self) -> bool:
        """Whether there are buildings only, of which nothing but their ids is reported."""
        return not self.has_details and self.types.count("Building") == len(self.types)

    def heights(self, count: int) -> NDArray[np.float64] | None:
        """Returns (count,) measured heights of buildings, metres, NaN for none; None where no one has any."""
        heights = [self.measured_m.get(building, np.nan) for building in range(count)]
        return np.asarray(heights) if self.measured_m else None

    def finish(self) -> CityObjects:
        """Returns the objects."""
        return CityObjects(
            tuple(self.ids),
            tuple(self.types),
            np.asarray(self.parents, np.int32),
            np.asarray(self.building, np.int32),
            tuple(self.attributes),
        )

    def finish_solids(self, serials: NDArray[np.int64]) -> tuple[Solids, tuple[str, ...]]:
        """Returns the solids, and an id or "" for each polygon.

        Args:
            serials: (N,) serial number of each polygon that is there; -1 for copies.
        """
        size = int(serials.max(initial=-1)) + 1
        index = np.full(size + 1, -1, np.int64)
        index[serials[serials >= 0]] = np.flatnonzero(serials >= 0)
        shells = [shell for _, solid, _ in self.solids for shell in solid]
        faces = np.asarray([number for shell in shells for number, _ in shell], np.int64)
        solids = Solids(
            np.asarray([part for part, _, _ in self.solids], np.int32),
            np.cumsum([0, *(len(solid) for _, solid, _ in self.solids)]).astype(np.int64),
            np.cumsum([0, *map(len, shells)]).astype(np.int64),
            index[np.where(faces < size, faces, size)],
            np.asarray([is_flipped for shell in shells for _, is_flipped in shell], np.bool_),
            np.asarray([composite for _, _, composite in self.solids], np.int32),
        )
        return solids, tuple(self.polygon_ids.get(number, "") for number in serials.tolist())


def outer_parts(objects: CityObjects) -> NDArray[np.int32]:
    """Returns (O,) the building or part each object stands with: itself, or what it hangs on."""
    result = np.arange(len(objects), dtype=np.int32)
    for n, (type_, parent) in enumerate(zip(objects.types, objects.parents.tolist(), strict=True)):
        if type_ not in ("Building", "BuildingPart") and 0 <= parent < n:
            result[n] = result[parent]
    return result


# Attributes that name the kind of a roof: of CityGML and CityJSON, 3DBAG, OpenStreetMap, and ALKIS.
ATTRIBUTES = ("roofType", "b3_dak_type", "dak_type", "roof:shape", "roof_shape", "dachform")
# Of the surveying authorities of Germany (2100 to 3800) and of SIG 3D (1010 to 1100, 1120): single pitches,
# gables, hips, mansards, tents, cones, saw teeth, mixed forms. Flat, arched, combined and other ones are not.
_CODES = frozenset(
    {"2100", "2200", "3100", "3200", "3300", "3400", "3500", "3600", "3800", "5000"}
    | {"1010", "1020", "1030", "1040", "1050", "1060", "1070", "1080", "1100", "1120"}
)  # fmt: skip
# Four digits at the end: of the code itself, or of an address or a name, ".../roofType.xml#3100".
_CODE = re.compile(r"(?<!\d)(\d{4})(?:\.0)?\s*$")
# Parts of words, in lower case; what says that there is no pitch goes before.
_WORDS = (
    "slanted", "pitch", "gable", "hipped", "gambrel", "mansard", "pyramid", "skillion", "saltbox", "pavilion",
    "cone", "conical", "sawtooth", "sattel", "walm", "pultd", "zeltd", "kegeld", "sheddach", "zadeldak",
    "schilddak", "lessenaar", "tentdak",
)  # fmt: skip
_LEVEL_WORDS = ("flat", "unpitched", "not pitched")


def is_pitched(roof_type: str) -> bool:
    """Returns whether a word or code says that a roof is pitched; of unknown ones nothing is known.

    Example:
        >>> is_pitched("3100"), is_pitched("SATTELDACH"), is_pitched("multiple horizontal")
        (True, True, False)
    """
    words = roof_type.lower()
    code = _CODE.search(words)
    if code is not None:
        return code[1] in _CODES
    return any(word in words for word in _WORDS) and not any(word in words for word in _LEVEL_WORDS)


def roof_type_of(attributes: Mapping[str, Any]) -> str:
    """Returns the word or code under which an object's attributes describe its roof, or ""."""
    return next(filter(None, (word_of(attributes.get(name)) for name in ATTRIBUTES)), "")


def word_of(value: object) -> str:
    """Returns a value as a word or code, "" where it is none; codes may be numbers with a decimal point."""
    if isinstance(value, float):
        return str(int(value)) if value.is_integer() else ""
    return str(value).strip() if isinstance(value, str | int) and not isinstance(value, bool) else ""


def pitched_buildings(stated: Iterable[tuple[int, str]], count: int) -> NDArray[np.bool_] | None:
    """Returns (B,) which buildings have pitched roofs: at least half of what is stated of them says so.

    None where no building has.

    Args:
        stated: Buildings and words or codes; of those with parts, of each.
        count: Number of buildings, B.
    """
    balance, is_any = np.zeros(count, np.int64), np.zeros(count, np.bool_)
    for building, roof_type in stated:
        has_pitch = is_pitched(roof_type)
        balance[building] += 1 if has_pitch else -1
        is_any[building] |= has_pitch
    is_any &= balance >= 0
    return is_any if is_any.any() else None
