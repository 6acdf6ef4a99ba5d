"""Polygons one by one into what a reader hands over: for CityJSON, and readers of other packages."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.attributes import ObjectTable, pitched_buildings
from lodbench.citymodel.model import Solids, starts_of
from lodbench.citymodel.pictures import PictureTable
from lodbench.citymodel.raw import RawCity, blank
from lodbench.errors import CityModelError
from lodbench.findings import Findings

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
