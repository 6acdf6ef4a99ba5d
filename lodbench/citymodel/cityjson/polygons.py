"""The polygons of CityJSON as they are collected, and the pictures that lie on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.attributes import ObjectTable, pitched_buildings
from lodbench.citymodel.model import (
    NO_PICTURE,
    Solids,
    starts_of,
)
from lodbench.citymodel.pictures import PictureTable
from lodbench.citymodel.raw import RawCity, blank
from lodbench.errors import CityModelError
from lodbench.findings import Findings

Json = dict[str, Any]


class TextureReader:
    """Reads which pictures lie on the surfaces of geometries, of the default theme or else the first.

    Raises:
        CityModelError: The places on the pictures are no pairs of numbers.
    """

    def __init__(self, appearance: Json, pictures: PictureTable, source: str) -> None:
        self._pictures = pictures
        self._theme = appearance.get("default-theme-texture")
        textures = appearance.get("textures")
        self._images = [
            (str(texture.get("image", "")), str(texture.get("wrapMode") or ""))
            if isinstance(texture, dict)
            else ("", "")
            for texture in (textures if isinstance(textures, list) else ())
        ]
        try:
            self._places = np.asarray(appearance.get("vertices-texture") or [], np.float64).reshape(-1, 2)
        except (TypeError, ValueError, OverflowError) as error:
            raise CityModelError(
                f"{source} has malformed vertices of textures ({error}).",
                "Mend them, or leave out `--textures`.",
            ) from None
        if appearance.get("materials"):
            pictures.notes["list of materials: colours of surfaces"] += 1

    def read(
        self, geometry: Json, surfaces: Sequence[Any], depth: int
    ) -> dict[int, tuple[int, NDArray[np.float64]]]:
        """Returns the picture of surfaces that have one, and the places of all their corners on it.

        Args:
            geometry: With a member ``texture``.
            surfaces: Its surfaces, in their order.
            depth: How many lists stand around a surface.
        """
        themes = geometry["texture"]
        if not isinstance(themes, dict) or not themes:
            return {}
        theme = self._theme if self._theme in themes else next(iter(themes))
        if len(themes) > 1:
            self._pictures.notes[f"theme of pictures besides {str(theme)[:60]!r}"] += len(themes) - 1
        values = themes[theme].get("values") if isinstance(themes[theme], dict) else None
        try:
            for _ in range(depth):
                values = list(chain.from_iterable(values or ()))
            if values is None or len(values) != len(surfaces):
                raise ValueError("another number of surfaces")
            found = {n: self._surface(*pair) for n, pair in enumerate(zip(surfaces, values, strict=True))}
        except (TypeError, ValueError, LookupError):
            self._pictures.notes["geometry with textures nested otherwise than its surfaces"] += 1
            return {}
        return {n: one for n, one in found.items() if one is not None}

    def _surface(self, surface: list[Any], labels: Any) -> tuple[int, NDArray[np.float64]] | None:
        """Returns the picture of a surface and (P, 2) places of its corners, NaN on rings without any."""
        if not labels or not labels[0] or type(labels[0][0]) is not int:
            return None
        image = labels[0][0]
        picture = (
            self._pictures.number(*self._images[image]) if 0 <= image < len(self._images) else NO_PICTURE
        )
        if picture == NO_PICTURE:
            self._pictures.notes["surface whose picture is not there"] += 1
            return None
        places = [np.full((len(ring), 2), np.nan) for ring in surface]
        for own, label in zip(places, labels, strict=False):
            corners = label[1:] if label else []
            if not label or label[0] != image or len(corners) != len(own):
                continue
            if all(type(k) is int and 0 <= k < len(self._places) for k in corners):
                own[:] = self._places[corners]
        if not np.isfinite(places[0]).all():
            self._pictures.notes["surface whose places on its picture do not fit its corners"] += 1
            return None
        return picture, np.concatenate(places)


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
