"""The city model as read: buildings and their polygons at every level of detail, before meshing."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.lifespans import Period
from lodbench.citymodel.objects import CityObjects, Solids
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

    Attributes:
        points: (P, 3) float64, metres in the model's local frame (x east, y north, z up).
        ring_starts: (R + 1,) int64 offsets into ``points``.
        polygon_starts: (N + 1,) int64 offsets into the rings.
        building: (N,) int32 index of the building each polygon belongs to.
        lod: (N,) int16 index into ``CityModel.lods``.
        kind: (N,) uint8 ``SurfaceKind``.
        part: (N,) int32 index into ``CityModel.objects``; None where buildings are all there is.
        picture: (N,) int32 index into ``CityModel.pictures``, -1 for none; None where none were asked for.
        uv: (P, 2) float64 place of each point on its polygon's picture, (0, 0) the lower left corner; NaN
            where there is none. With ``picture``.
    """

    points: NDArray[np.float64]
    ring_starts: NDArray[np.int64]
    polygon_starts: NDArray[np.int64]
    building: NDArray[np.int32]
    lod: NDArray[np.int16]
    kind: NDArray[np.uint8]
    part: NDArray[np.int32] | None = None
    picture: NDArray[np.int32] | None = None
    uv: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.building)


@dataclass(frozen=True, slots=True, repr=False)
class CityModel:
    """Buildings with their polygons, in metres, in a local frame.

    ``points + origin`` are coordinates in ``crs``. A model without a CRS is in a local frame of
    its own (a Wavefront OBJ); its origin is zero unless the user gave one.

    Attributes:
        source: The file or folder it was read from.
        format: ``"CityGML"``, ``"OBJ"``, ...
        version: The format's version, or None where the format has none.
        crs: Name pyproj understands (``"EPSG:25832+7837"``), or None when unknown.
        origin: (3,) float64, what was subtracted from the CRS coordinates.
        building_ids: One id per building, in file order.
        num_parts: Building parts met, over all buildings.
        lods: Names of the levels of detail present, ascending: ``("0", "1", "2.2")``.
        polygons: All polygons of all levels.
        polygons_read: Per level, polygons in the file; those too short to be one are not kept.
        findings: What was wrong, changed or dropped while reading.
        objects: Buildings and their parts; None where buildings are all there is.
        solids: Volumes that the polygons close; only with ``ReadOptions(has_details=True)``.
        polygon_ids: The source's id of each polygon, or ""; likewise, else empty.
        has_textures: Whether the source has pictures or materials of its surfaces.
        pictures: Those; only with ``ReadOptions(has_textures=True)``.
        has_interiors: Whether rooms and furniture are asked for.
        pitched: (B,) which buildings have pitched roofs, as the source tells; None where it tells of none.
        measured_m: (B,) heights of buildings above the ground, as the source tells, NaN where it does not;
            None where it tells of none.
        period: First day, and the day after the last, between which the same buildings stand; None where no
            building has an end.
    """

    source: str
    format: str
    version: str | None
    crs: str | None
    origin: NDArray[np.float64]
    building_ids: tuple[str, ...]
    num_parts: int
    lods: tuple[str, ...]
    polygons: Polygons
    polygons_read: tuple[int, ...]
    findings: Findings
    objects: CityObjects | None = None
    solids: Solids | None = None
    polygon_ids: tuple[str, ...] = ()
    has_interiors: bool = False
    has_textures: bool = False
    pictures: Pictures | None = None
    pitched: NDArray[np.bool_] | None = None
    measured_m: NDArray[np.float64] | None = None
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
        """Tells which of ``building_ids`` are buildings, and no objects of another layer."""
        return np.array(["Building" in name for name in self.types()], np.bool_)
