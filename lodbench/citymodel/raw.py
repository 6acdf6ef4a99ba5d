"""What a reader hands over: polygons in the coordinates of the file, before frames and cleaning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lodbench.citymodel.lifespans import Period
from lodbench.citymodel.model import CityObjects, ObjectTable, Solids, pitched_buildings
from lodbench.citymodel.options import AxisOrder
from lodbench.citymodel.pictures import Pictures, PictureTable, blank
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

    Attributes:
        source: The file's name.
        format: ``"CityGML"``, ``"OBJ"``, ...
        version: The format's version, or None.
        srs_names: Reference systems declared, as written; None stands for "not declared". Empty for
            a format that cannot declare one.
        building_ids: One id per building, in file order.
        num_parts: Building parts met.
        lods: Level names the ``lod`` array points into; not sorted, all used.
        points: (P, 3) float64, columns in the order of the file.
        ring_starts: (R + 1,) int64 offsets into ``points``.
        polygon_starts: (N + 1,) int64 offsets into the rings.
        building: (N,) int32.
        lod: (N,) int16.
        kind: (N,) uint8 ``SurfaceKind``.
        srs: (N,) int16 index into ``srs_names``.
        has_closing_points: Rings end with their first point again, as GML requires; (R,) where the tiles of
            a city differ.
        findings: What was met while reading.
        axis_orders: For each of ``srs_names``, which of the first two columns is the easting, where the
            format settles it; empty where it never does.
        has_textures: Whether the file has pictures or materials of its surfaces.
        part, objects, solids, polygon_ids, pictures, picture, uv, pitched, measured_m, period: As in
            ``Polygons`` and ``CityModel``.
    """

    source: str
    format: str
    version: str | None = None
    srs_names: tuple[str | None, ...]
    building_ids: tuple[str, ...]
    num_parts: int = 0
    lods: tuple[str, ...]
    points: NDArray[np.float64]
    ring_starts: NDArray[np.int64]
    polygon_starts: NDArray[np.int64]
    building: NDArray[np.int32]
    lod: NDArray[np.int16]
    kind: NDArray[np.uint8]
    srs: NDArray[np.int16]
    has_closing_points: bool | NDArray[np.bool_] = False
    findings: Findings = field(default_factory=Findings)
    axis_orders: tuple[AxisOrder, ...] = ()
    part: NDArray[np.int32] | None = None
    objects: CityObjects | None = None
    solids: Solids | None = None
    polygon_ids: tuple[str, ...] = ()
    has_textures: bool = False
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

    Points come in blocks; rings and polygons are plain lists until the end. ``painted`` has the number of a
    picture and the places of the corners for those polygons that have one.
    """

    point_blocks: list[NDArray[np.float64]] = field(default_factory=list)
    ring_lengths: list[int] = field(default_factory=list)
    ring_counts: list[int] = field(default_factory=list)
    owners: list[tuple[int, int, int, int]] = field(default_factory=list)
    lods: list[str] = field(default_factory=list)
    building_ids: list[str] = field(default_factory=list)
    objects: ObjectTable | None = None
    serials: list[int] = field(default_factory=list)
    pictures: PictureTable | None = None
    painted: dict[int, tuple[int, NDArray[np.float64]]] = field(default_factory=dict)
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

    def _painted_corners(
        self, firsts: NDArray[np.int64]
    ) -> tuple[NDArray[np.int32] | None, NDArray[np.float64] | None]:
        """Returns the picture of each polygon and the place of each point on it; ``firsts``: (N + 1,)."""
        if self.pictures is None:
            return None, None
        picture, uv = blank(len(firsts) - 1, int(firsts[-1]))
        for polygon, (number, places) in self.painted.items():
            picture[polygon], uv[firsts[polygon] : firsts[polygon + 1]] = number, places
        return picture, uv

    def finish(
        self, *, source: str, format: str, version: str | None, srs_names: tuple[str | None, ...]
    ) -> RawCity:
        """Returns everything collected; all of it is in the first of ``srs_names``."""
        # A third of the time that asarray takes for a list of tuples.
        owners = np.fromiter(chain.from_iterable(self.owners), np.int64).reshape(-1, 4)
        table = self.objects
        solids: Solids | None = None
        polygon_ids: tuple[str, ...] = ()
        if table is not None and table.has_details:
            solids, polygon_ids = table.finish_solids(np.asarray(self.serials, np.int64))
        is_plain = table is None or (len(table.ids) == len(self.building_ids) and table.is_plain)
        points = np.concatenate(self.point_blocks) if self.point_blocks else np.zeros((0, 3))
        ring_starts = starts_of(np.asarray(self.ring_lengths, np.int64))
        polygon_starts = starts_of(np.asarray(self.ring_counts, np.int64))
        picture, uv = self._painted_corners(ring_starts[polygon_starts])
        return RawCity(
            source=source,
            format=format,
            version=version,
            srs_names=srs_names,
            building_ids=tuple(self.building_ids),
            num_parts=0 if table is None else table.types.count("BuildingPart"),
            lods=tuple(self.lods),
            points=points,
            ring_starts=ring_starts,
            polygon_starts=polygon_starts,
            building=owners[:, 0].astype(np.int32),
            lod=owners[:, 1].astype(np.int16),
            kind=owners[:, 2].astype(np.uint8),
            srs=np.zeros(len(owners), np.int16),
            findings=self.findings,
            part=None if is_plain else owners[:, 3].astype(np.int32),
            objects=None if table is None or is_plain else table.finish(),
            solids=solids,
            polygon_ids=polygon_ids,
            pictures=None if self.pictures is None else self.pictures.finish(),
            picture=picture,
            uv=uv,
            pitched=None if table is None else pitched_buildings(table.roof_types, len(self.building_ids)),
            measured_m=None if table is None else table.heights(len(self.building_ids)),
        )
