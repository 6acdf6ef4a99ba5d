"""What a reader hands over: polygons in the coordinates of the file, before frames and cleaning.

``PolygonCollector`` grows them one by one, for CityJSON and readers of other packages; ``city_of_columns``
makes a ``RawCity`` of what it or the reader of CityGML has gathered; ``merge_cities`` joins tiles.
"""

from __future__ import annotations

import gc
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lodbench.citymodel.attributes import ObjectTable, common_period, pitched_buildings
from lodbench.citymodel.model import CityObjects, Period, Pictures, Solids, starts_of
from lodbench.citymodel.options import AxisOrder
from lodbench.citymodel.textures import SurfaceTextures, merge_textures
from lodbench.errors import CityModelError
from lodbench.findings import Findings

Scalar = TypeVar("Scalar", bound=np.generic)


class NotACity(CityModelError):
    """A file is of another kind, or holds no building: among other tiles it can be passed over."""


@dataclass(slots=True, kw_only=True)
class RawCity:
    """Polygons as a file states them: its axes, its reference systems, its closing points.

    Whoever works on it uses it up: points are cleaned and moved where they lie, because a second
    copy of them is more memory than all else that reading a city takes.
    """

    source: str  # the file's name
    format: str  # ``"CityGML"``, ``"OBJ"``, ..
    version: str | None = None  # the format's version
    # Reference systems declared, as written; None stands for "not declared". Empty for a format that cannot
    # declare one
    srs_names: tuple[str | None, ...]
    building_ids: tuple[str, ...]  # one id per building, in file order
    num_parts: int = 0  # building parts met
    lods: tuple[str, ...]  # level names the ``lod`` array points into; not sorted, all used
    points: NDArray[np.float64]  # (P, 3), columns in the order of the file
    ring_starts: NDArray[np.int64]  # (R + 1,) offsets into ``points``
    polygon_starts: NDArray[np.int64]  # (N + 1,) offsets into the rings
    building: NDArray[np.int32]  # (N,)
    lod: NDArray[np.int16]  # (N,)
    kind: NDArray[np.uint8]  # (N,) ``SurfaceKind``
    srs: NDArray[np.int16]  # (N,) index into ``srs_names``
    # Rings end with their first point again, as GML requires; (R,) where the tiles of a city differ
    has_closing_points: bool | NDArray[np.bool_] = False
    findings: Findings = field(default_factory=Findings)  # what was met while reading
    # For each of ``srs_names``, which of the first two columns is the easting, where the format settles it;
    # empty where it never does
    axis_orders: tuple[AxisOrder, ...] = ()
    has_textures: bool = False  # whether the file has pictures or materials of its surfaces
    # As in ``Polygons`` and ``CityModel``
    part: NDArray[np.int32] | None = None
    objects: CityObjects | None = None
    solids: Solids | None = None
    polygon_ids: tuple[str, ...] = ()
    pictures: Pictures | None = None
    picture: NDArray[np.int32] | None = None
    uv: NDArray[np.float64] | None = None
    pitched: NDArray[np.bool_] | None = None
    measured_m: NDArray[np.float64] | None = None
    period: Period | None = None

    def systems(self) -> tuple[tuple[str | None, AxisOrder], ...]:
        """Returns name and axis order of each reference system; one without a name where there is none."""
        names = self.srs_names or (None,)
        undecided: AxisOrder = "auto"
        return tuple(zip(names, self.axis_orders or (undecided,) * len(names), strict=True))


def joined(cities: Sequence[tuple[NDArray[Scalar] | None, int]], lack: Any) -> NDArray[Scalar] | None:
    """Returns (B,) an attribute of the buildings of several cities in a row; None if no city has it.

    Args:
        cities: The attribute of each, or None, and how many buildings it has.
        lack: Value for buildings of cities without it.
    """
    if all(values is None for values, _ in cities):
        return None
    return np.concatenate([np.full(n, lack) if values is None else values for values, n in cities])


def buildings_only(ids: tuple[str, ...]) -> CityObjects:
    """Returns the objects of a city whose source knows buildings alone."""
    return CityObjects(
        ids, ("Building",) * len(ids), np.full(len(ids), -1, np.int32), np.arange(len(ids), dtype=np.int32)
    )


class GrowingArray:
    """Collects blocks of rows into one array.

    Unlike blocks kept in a list and joined at the end, the rows exist once: large pieces of memory
    grow by moving pages, and freed blocks do not stay behind between others that live on.

    Args:
        dtype: Of the rows.
        row_shape: Shape of one row, ``()`` for plain numbers.

    Example:
        >>> array = GrowingArray(np.int32)
        >>> array.extend(np.array([1, 2]))
        >>> array.extend(np.array([3]))
        >>> array.finish()
        array([1, 2, 3], dtype=int32)
    """

    def __init__(self, dtype: DTypeLike, row_shape: tuple[int, ...] = ()) -> None:
        self._rows: NDArray[Any] = np.zeros((0, *row_shape), dtype)
        self._size = 0

    def extend(self, block: NDArray[Any]) -> None:
        """Appends the rows of a block, cast to the array's type."""
        end = self._size + len(block)
        if end > len(self._rows):
            self._resize(end if self._size == 0 else end + end // 8)
        self._rows[self._size : end] = block
        self._size = end

    def finish(self) -> NDArray[Any]:
        """Returns the rows; the collector is empty afterwards."""
        self._resize(self._size)
        rows, self._rows, self._size = self._rows, self._rows[:0].copy(), 0
        return rows

    def _resize(self, size: int) -> None:
        # Nobody else ever saw the array, so no reference can be left dangling.
        self._rows.resize((size, *self._rows.shape[1:]), refcheck=False)


_MAX_LODS = 64


@dataclass(slots=True)
class PolygonCollector:
    """Grows polygons into the arrays of a ``RawCity``.

    Points come in blocks; rings and polygons are plain lists until the end.
    """

    point_blocks: list[NDArray[np.float64]] = field(default_factory=list)
    ring_lengths: list[int] = field(default_factory=list)
    ring_counts: list[int] = field(default_factory=list)
    owners: list[tuple[int, int, int, int]] = field(default_factory=list)  # building, lod, kind, part
    lods: list[str] = field(default_factory=list)
    building_ids: list[str] = field(default_factory=list)
    objects: ObjectTable | None = None
    serials: list[int] = field(default_factory=list)  # of ``objects``, where these have details
    textures: SurfaceTextures | None = None  # of polygons by their serial numbers
    findings: Findings = field(default_factory=Findings)

    def add_polygon(self, building: int, lod: str, points: NDArray[np.float64], kind: int) -> None:
        """Adds one polygon without holes.

        Args:
            building: Index into ``building_ids``.
            lod: Name of its level of detail.
            points: (N, 3) corners, the first not repeated.
            kind: Its ``SurfaceKind``.
        """
        self.point_blocks.append(points)
        self.ring_lengths.append(len(points))
        self.ring_counts.append(1)
        self.owners.append((building, self.lod_index(lod), kind, building))

    def lod_index(self, name: str) -> int:
        """Returns the number of a level of detail, a new one where it is new."""
        if name not in self.lods:
            if len(self.lods) == _MAX_LODS:
                raise CityModelError(
                    f"There are more than {_MAX_LODS} levels of detail.", "Four is usual: correct the file."
                )
            self.lods.append(name)
        return self.lods.index(name)

    def finish(
        self, *, source: str, format: str, version: str | None, srs_names: tuple[str | None, ...]
    ) -> RawCity:
        """Returns everything collected; all of it is in the first of ``srs_names``."""
        # A third of the time that asarray takes for a list of tuples.
        owners = np.fromiter(chain.from_iterable(self.owners), np.int64).reshape(-1, 4)
        building, lod, kind, part = owners.T
        columns: dict[str, NDArray[Any]] = {
            "points": np.concatenate(self.point_blocks) if self.point_blocks else np.zeros((0, 3)),
            "ring_lengths": np.asarray(self.ring_lengths, np.int64),
            "ring_counts": np.asarray(self.ring_counts, np.int64),
            "building": building,
            "lod": lod.astype(np.int16),
            "kind": kind.astype(np.uint8),
            "part": part.astype(np.int32),
            "serial": np.asarray(self.serials, np.int64),
        }
        return city_of_columns(
            columns,
            table=self.objects,
            textures=self.textures,
            source=source,
            format=format,
            version=version,
            srs_names=srs_names,
            building_ids=tuple(self.building_ids),
            lods=tuple(self.lods),
            findings=self.findings,
        )


def city_of_columns(
    columns: Mapping[str, NDArray[Any]],
    *,
    table: ObjectTable | None = None,
    textures: SurfaceTextures | None = None,
    **stated: Any,
) -> RawCity:
    """Returns a city of the polygons that a reader has gathered.

    Args:
        columns: ``points`` and ``building`` as in ``RawCity``; (R,) ``ring_lengths``, (N,) ``ring_counts``;
            ``lod``, ``kind``, ``srs`` where they are not 0 for all, ``part`` where there are parts. With
            details (N,) ``serial``, the number of each polygon in table and textures, -1 for a copy.
        table: Buildings and what else the city has.
        textures: Of the polygons, in a city with details.
        stated: All else of a ``RawCity``.
    """
    ring_starts, polygon_starts = starts_of(columns["ring_lengths"]), starts_of(columns["ring_counts"])
    building_ids, blank = stated["building_ids"], np.zeros(len(columns["ring_counts"]), np.int16)
    if table is not None:
        stated["num_parts"] = table.types.count("BuildingPart")
        stated["pitched"] = pitched_buildings(table.roof_types, len(building_ids))
        stated["measured_m"] = table.heights(len(building_ids))
        # Where buildings have no parts, their own numbers say it all.
        if len(table.ids) != len(building_ids) or not table.is_plain:
            stated["part"], stated["objects"] = columns["part"], table.finish()
        if table.has_details:
            stated["solids"], stated["polygon_ids"] = table.finish_solids(columns["serial"])
            if textures is not None:
                laid = textures.finish(columns["serial"], ring_starts[polygon_starts])
                stated["pictures"], stated["picture"], stated["uv"] = laid
    return RawCity(
        points=columns["points"],
        ring_starts=ring_starts,
        polygon_starts=polygon_starts,
        building=columns["building"].astype(np.int32, copy=False),
        lod=columns.get("lod", blank),
        kind=columns.get("kind", blank.astype(np.uint8)),
        srs=columns.get("srs", blank),
        **stated,
    )


@contextmanager
def paused_collector() -> Iterator[None]:
    """Keeps Python from looking for cycles: JSON has a million lists and none, and it doubles the time."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def merge_cities(source: str, cities: list[RawCity]) -> RawCity:
    """Returns several tiles as one city; ids that two tiles share stay as they are.

    Args:
        source: Name of the folder or archive.
        cities: One or more tiles, of any format; their points are taken from them.
    """
    first = cities[0]
    systems = tuple(dict.fromkeys(system for city in cities for system in city.systems()))
    lods = tuple(dict.fromkeys(name for city in cities for name in city.lods))
    findings = Findings([item for city in cities for item in city.findings.items])
    building_ids = tuple(name for city in cities for name in city.building_ids)
    pictures, picture, uv = merge_textures(
        [(city.pictures, city.picture, city.uv, len(city.building), len(city.points)) for city in cities]
    )
    before = starts_of(np.asarray([len(city.building_ids) for city in cities]))
    part, objects, solids, polygon_ids = _merge_objects(cities)
    return RawCity(
        source=source,
        format=first.format,
        version=first.version,
        srs_names=tuple(name for name, _ in systems),
        building_ids=building_ids,
        num_parts=sum(city.num_parts for city in cities),
        lods=lods,
        points=_taken_points(cities),
        ring_starts=starts_of(np.concatenate([np.diff(city.ring_starts) for city in cities])),
        polygon_starts=starts_of(np.concatenate([np.diff(city.polygon_starts) for city in cities])),
        building=_counted_on([city.building for city in cities], before[:-1]),
        lod=np.concatenate([_renamed(c.lod, c.lods, lods) for c in cities]),
        kind=np.concatenate([city.kind for city in cities]),
        srs=np.concatenate([_renamed(c.srs, c.systems(), systems) for c in cities]),
        has_closing_points=np.concatenate(
            [np.broadcast_to(city.has_closing_points, len(city.ring_starts) - 1) for city in cities]
        ),
        findings=findings,
        axis_orders=tuple(order for _, order in systems),
        part=part,
        objects=objects,
        solids=solids,
        polygon_ids=polygon_ids,
        has_textures=any(city.has_textures for city in cities),
        pictures=pictures,
        picture=picture,
        uv=uv,
        pitched=joined([(city.pitched, len(city.building_ids)) for city in cities], False),
        measured_m=joined([(city.measured_m, len(city.building_ids)) for city in cities], np.nan),
        period=common_period(city.period for city in cities),
    )


def _taken_points(cities: list[RawCity]) -> NDArray[np.float64]:
    """Returns the points of all cities, (P, 3), which have none afterwards: they are not held twice."""
    points = GrowingArray(np.float64, (3,))
    for city in cities:
        points.extend(city.points)
        city.points = np.zeros((0, 3))
    return points.finish()


def _counted_on(columns: Sequence[NDArray[np.int32]], firsts: NDArray[np.int64]) -> NDArray[np.int32]:
    """Returns columns of numbers in a row, those of each column counted from its first."""
    return np.concatenate([c + n for c, n in zip(columns, firsts, strict=True)]).astype(np.int32)


def _merge_objects(
    cities: list[RawCity],
) -> tuple[NDArray[np.int32] | None, CityObjects | None, Solids | None, tuple[str, ...]]:
    """Returns parts, objects, solids and polygon ids of several tiles, as far as any has them."""
    if all(city.objects is None for city in cities):
        return None, None, None, ()
    tables = [city.objects or buildings_only(city.building_ids) for city in cities]
    parts = [city.part if city.part is not None else city.building for city in cities]
    buildings = starts_of(np.asarray([len(city.building_ids) for city in cities]))[:-1]
    firsts = starts_of(np.asarray([len(table) for table in tables]))[:-1]
    polygons = starts_of(np.asarray([len(city.building) for city in cities]))[:-1]
    objects = CityObjects(
        tuple(name for table in tables for name in table.ids),
        tuple(name for table in tables for name in table.types),
        np.concatenate(
            [np.where(t.parents < 0, -1, t.parents + n) for t, n in zip(tables, firsts, strict=True)]
        ).astype(np.int32),
        _counted_on([table.building for table in tables], buildings),
        tuple(values for table in tables for values in (table.attributes or ({},) * len(table)))
        if any(table.attributes for table in tables)
        else (),
    )
    part = _counted_on(parts, firsts)
    if all(city.solids is None for city in cities):
        return part, objects, None, ()
    stated = [
        (city.solids, n, f)
        for city, n, f in zip(cities, polygons, firsts, strict=True)
        if city.solids is not None
    ]
    solids = Solids(
        np.concatenate([s.part + f for s, _, f in stated]).astype(np.int32),
        starts_of(np.concatenate([np.diff(s.shell_starts) for s, _, _ in stated])),
        starts_of(np.concatenate([np.diff(s.face_starts) for s, _, _ in stated])),
        np.concatenate([np.where(s.faces < 0, -1, s.faces + n) for s, n, _ in stated]),
        np.concatenate([s.is_flipped for s, _, _ in stated]),
        np.concatenate([np.where(s.composite < 0, -1, s.composite + n) for s, n, _ in stated]).astype(
            np.int32
        ),
    )
    ids = (city.polygon_ids or ("",) * len(city.building) for city in cities)
    return part, objects, solids, tuple(chain.from_iterable(ids))


def _renamed(
    indices: NDArray[np.int16], names: tuple[Hashable, ...], all_names: tuple[Hashable, ...]
) -> NDArray[np.int16]:
    table = np.asarray([all_names.index(name) for name in names], np.int16)
    return table[indices] if len(table) else indices
