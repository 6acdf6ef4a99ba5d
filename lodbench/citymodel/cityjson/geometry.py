"""Geometry of CityJSON: nested index lists to flat rings, with every index checked."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.attributes import ObjectTable
from lodbench.citymodel.codes import BAD_INDEX, GEOMETRY_EMPTY, GEOMETRY_UNSUPPORTED, SEMANTICS_MISFIT
from lodbench.citymodel.gml.names import INTERIOR_NAMES, SURFACE_KINDS
from lodbench.citymodel.model import SurfaceKind
from lodbench.citymodel.raw import PolygonCollector
from lodbench.citymodel.textures import Image, SurfaceTextures
from lodbench.errors import CityModelError
from lodbench.storage.json_text import list_or_empty

Json = dict[str, Any]

# How many lists of lists stand around a surface.
DEPTHS = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2, "CompositeSolid": 2}


def points_of(values: Any) -> NDArray[np.float64]:
    """Returns (N, 3) coordinates.

    Raises:
        ValueError: They are no points of three numbers each; the message says which.
        TypeError, OverflowError: One is nothing that numpy takes for a number.
    """
    numbers = np.asarray(values)
    if numbers.size and numbers.dtype.kind not in "iuf":
        raise ValueError("one is no number")  # numpy would take "1" for 1
    if numbers.size and (numbers.ndim != 2 or numbers.shape[1] != 3):
        raise ValueError("one has no three coordinates")
    return numbers.astype(np.float64).reshape(-1, 3)


def surface_kinds(geometry: dict[str, Any], num_surfaces: int, is_interior: bool) -> tuple[list[int], str]:
    """Returns the ``SurfaceKind`` of each surface, in the order of the boundaries, and what is odd about it.

    Labels nested otherwise than the surfaces are taken in their order where their number fits.
    """
    if is_interior:
        return [int(SurfaceKind.INTERIOR)] * num_surfaces, ""
    unknown = [int(SurfaceKind.UNKNOWN)] * num_surfaces
    semantics = geometry.get("semantics")
    if not isinstance(semantics, dict):
        return unknown, ""
    labels = semantics.get("values", [])  # null is no label for any surface
    if labels is None or not (labels or semantics.get("surfaces")):
        return unknown, ""
    names = [str(surface.get("type")) for surface in semantics.get("surfaces", ())]
    known = [int(SurfaceKind.INTERIOR if n in INTERIOR_NAMES else SURFACE_KINDS.get(n, 0)) for n in names]
    values, is_aligned = _labels(labels, geometry["boundaries"], DEPTHS[geometry["type"]])
    if len(values) != num_surfaces:
        return unknown, f"{len(values)} labels of {num_surfaces} surfaces: none is taken"
    if set(map(type, values)) == {int} and 0 <= min(values) and max(values) < len(known):
        kinds, num_lost = [known[v] for v in values], 0
    else:
        kinds = [known[v] if type(v) is int and 0 <= v < len(known) else 0 for v in values]
        num_lost = sum(v is not None and not (type(v) is int and 0 <= v < len(known)) for v in values)
    if num_lost:
        return kinds, f"{num_lost} of {num_surfaces} labels name no surface type of the geometry"
    return kinds, "" if is_aligned else f"{num_surfaces} labels nested otherwise, taken in their order"


def _labels(values: Any, boundaries: list[Any], depth: int) -> tuple[list[Any], bool]:
    """Returns the labels in the order of the surfaces, and whether they are nested as the surfaces are."""
    flat: list[Any] = []
    if _align(values, boundaries, depth, flat):
        return flat, True
    flat.clear()
    stack = [iter(values)] if isinstance(values, list) else []
    while stack:
        value = next(stack[-1], stack)
        if value is stack:
            stack.pop()
        elif isinstance(value, list):
            stack.append(iter(value))
        else:
            flat.append(value)
    return flat, False


def _align(values: Any, boundaries: list[Any], depth: int, flat: list[Any]) -> bool:
    """Appends one label per surface, None for those below a null; returns whether the nesting agrees."""
    if values is None:
        flat += [None] * len(flatten(boundaries, depth))
        return True
    if not isinstance(values, list) or len(values) != len(boundaries):
        return False
    if depth:
        return all(_align(v, b, depth - 1, flat) for v, b in zip(values, boundaries, strict=True))
    flat += values
    return list not in set(map(type, values))


def flatten(boundaries: list[Any], depth: int) -> list[Any]:
    """Returns the surfaces of a solid or of several."""
    for _ in range(depth):
        boundaries = list(chain.from_iterable(boundaries))
    return boundaries


_WITHOUT_SURFACES = frozenset({"MultiPoint", "MultiLineString"})


class GeometryReader:
    """Adds geometries that share one list of vertices to a collector.

    Args:
        collector: Receives polygons and findings.
        vertices: (V, 3) coordinates the indices point into.
        templates: The file's ``geometry-templates``, or an empty mapping.
        is_strict: Whether a bad index is an error, or a finding that drops its polygon.
        textures: Reads which pictures lie on the surfaces; None where they are not kept.
        template_textures: Reads those of templates.
        is_in_degrees: Whether the vertices are, where no template in metres can be set down.
    """

    def __init__(
        self,
        collector: PolygonCollector,
        vertices: NDArray[np.float64],
        templates: dict[str, Any],
        is_strict: bool,
        textures: TextureReader | None = None,
        template_textures: TextureReader | None = None,
        is_in_degrees: bool = False,
    ) -> None:
        self._collector = collector
        self._vertices = vertices
        self._templates = templates
        self._is_strict = is_strict
        self._textures = textures
        self._template_textures = template_textures
        self._is_in_degrees = is_in_degrees
        self._begin()

    def _begin(self) -> None:
        """Starts a run of polygons whose indices are checked and looked up together."""
        self._indices: list[Any] = []
        self._first_polygon = len(self._collector.ring_counts)
        self._first_ring = len(self._collector.ring_lengths)
        self._objects: list[tuple[int, str]] = []  # first polygon of each geometry, and whose it is

    def read(
        self, geometry: dict[str, Any], building: int, object_id: str, is_interior: bool, part: int
    ) -> None:
        """Adds one geometry of an object, which is the ``part``-th of the city."""
        kind = geometry["type"]
        findings = self._collector.findings
        if kind == "GeometryInstance" and self._is_in_degrees:
            findings.add(GEOMETRY_UNSUPPORTED, object_id, "a template in metres at a place in degrees")
        elif kind == "GeometryInstance":
            self._read_instance(geometry, building, object_id, is_interior, part)
        elif kind in DEPTHS:
            if not self._read_surfaces(geometry, building, object_id, is_interior, part):
                findings.add(GEOMETRY_EMPTY, object_id, f"{kind} of LoD{geometry.get('lod')}")
        elif kind not in _WITHOUT_SURFACES:
            findings.add(GEOMETRY_UNSUPPORTED, object_id, str(kind))

    def finish(self) -> None:
        """Turns the indices gathered so far into points.

        Raises:
            CityModelError: An index is out of range and the reader is strict.
        """
        if self._indices:
            if not self._is_sound(self._indices):
                self._drop_bad_polygons()
            indices = np.asarray(self._indices, np.int64)
            self._collector.point_blocks.append(self._vertices[indices])
        self._begin()

    def _is_sound(self, indices: list[Any]) -> bool:
        # Python would take -1 for the last vertex, and true for 1.
        return not indices or (
            set(map(type, indices)) == {int} and 0 <= min(indices) and max(indices) < len(self._vertices)
        )

    def _drop_bad_polygons(self) -> None:
        """Leaves out of the current run every polygon with a bad index, telling whose it is."""
        collector = self._collector
        counts = collector.ring_counts[self._first_polygon :]
        lengths = collector.ring_lengths[self._first_ring :]
        owners = collector.owners[self._first_polygon :]
        serials = collector.serials[self._first_polygon :]
        del collector.ring_counts[self._first_polygon :], collector.owners[self._first_polygon :]
        del collector.serials[self._first_polygon :]
        del collector.ring_lengths[self._first_ring :]
        starts = [polygon for polygon, _ in self._objects]
        kept: list[Any] = []
        ring = position = 0
        for polygon, count in enumerate(counts):
            own_lengths = lengths[ring : ring + count]
            indices = self._indices[position : position + sum(own_lengths)]
            ring, position = ring + count, position + len(indices)
            if self._is_sound(indices):
                kept += indices
                collector.ring_lengths += own_lengths
                collector.ring_counts.append(count)
                collector.owners.append(owners[polygon])
                collector.serials += serials[polygon : polygon + 1]  # none where no details are kept
            else:
                geometry = bisect.bisect_right(starts, self._first_polygon + polygon) - 1
                self._report_index(indices, self._objects[geometry][1])
        self._indices = kept

    def _read_surfaces(
        self, geometry: dict[str, Any], building: int, object_id: str, is_interior: bool, part: int
    ) -> int:
        """Adds the surfaces of a geometry; returns how many it has, sound or not."""
        collector, indices = self._collector, self._indices
        lod = collector.lod_index(lod_name(geometry.get("lod", "")))
        surfaces = flatten(geometry["boundaries"], DEPTHS[geometry["type"]])
        kinds, oddity = surface_kinds(geometry, len(surfaces), is_interior)
        if oddity:
            collector.findings.add(SEMANTICS_MISFIT, object_id, f"LoD{geometry.get('lod')}: {oddity}")
        self._objects.append((len(collector.ring_counts), object_id))
        collector.owners += [(building, lod, kind, part) for kind in kinds]
        table = collector.objects
        if table is not None and table.has_details:
            if self._textures is not None and "texture" in geometry:
                self._textures.read(geometry, surfaces, table.num_polygons)
            self._note_solids(geometry, table, part, len(surfaces))
        rings = list(chain.from_iterable(surfaces))
        indices += chain.from_iterable(rings)
        collector.ring_lengths += map(len, rings)
        collector.ring_counts += map(len, surfaces)
        return len(surfaces)

    def _note_solids(self, geometry: dict[str, Any], table: ObjectTable, part: int, count: int) -> None:
        """Gives the next polygons their serial numbers, and notes which solids they close."""
        serials = self._collector.serials
        first = table.num_polygons
        table.num_polygons += count
        serials += range(first, first + count)
        depth = DEPTHS[geometry["type"]]
        if depth == 0:
            return
        composite = -1
        if geometry["type"] == "CompositeSolid":
            composite = table.num_composites
            table.num_composites += 1
        for solid in [geometry["boundaries"]] if depth == 1 else geometry["boundaries"]:
            shells = []
            for shell in solid:
                shells.append([(first + k, False) for k in range(len(shell))])
                first += len(shell)
            if any(shells):
                table.solids.append((part, shells, composite))

    def _report_index(self, indices: list[Any], object_id: str) -> None:
        detail = f"a polygon with the indices {str(indices)[:60]}, of {len(self._vertices)} vertices"
        if self._is_strict:
            raise CityModelError(
                f"{object_id} has {detail}.",
                "Mend the file, or see `lodbench city check FILE` for all of them.",
            )
        self._collector.findings.add(BAD_INDEX, object_id, detail)

    def _read_instance(
        self, geometry: dict[str, Any], building: int, object_id: str, is_interior: bool, part: int
    ) -> None:
        """Adds a template, moved by its 4x4 matrix to its reference point."""
        number = geometry["template"]
        if type(number) is not int or number < 0:
            raise ValueError(f"template {number!r}")
        template = self._templates["templates"][number]
        anchor = geometry["boundaries"][0]
        if type(anchor) is not int or not 0 <= anchor < len(self._vertices):
            self._report_index([anchor], object_id)
            return
        matrix = np.asarray(geometry["transformationMatrix"], np.float64).reshape(4, 4)
        local = points_of(self._templates["vertices-templates"])
        placed = local @ matrix[:3, :3].T + matrix[:3, 3] + self._vertices[anchor]
        if not np.isfinite(placed).all():
            raise ValueError("template coordinates are not finite")
        self.finish()
        inner = GeometryReader(self._collector, placed, {}, self._is_strict, self._template_textures)
        inner.read(template, building, object_id, is_interior, part)
        inner.finish()
        self._begin()


def lod_name(value: Any) -> str:
    """Returns the level as text: ``1``, ``1.0``, ``"1"`` and ``"LoD1"`` are one level, ``2.2`` another.

    Example:
        >>> lod_name(1.0), lod_name("2.2"), lod_name(0), lod_name("LoD2"), lod_name(None)
        ('1', '2.2', '0', '2', '')
    """
    text = "" if value is None else str(value).strip()
    return text.removeprefix(text[:3] if text[:3].lower() == "lod" else "").strip().removesuffix(".0")


class TextureReader:
    """Lays pictures on the surfaces of geometries, of the default theme or else the first.

    Args:
        appearance: Of a document or feature.
        textures: Receives the pictures, by the serial numbers of polygons.
        source: The file's name, for messages.

    Raises:
        CityModelError: The places on the pictures are no pairs of numbers.
    """

    def __init__(self, appearance: Json, textures: SurfaceTextures, source: str) -> None:
        self._textures = textures
        self._theme = appearance.get("default-theme-texture")
        self._images = [
            Image(str(texture.get("image", "")), str(texture.get("wrapMode") or ""))
            if isinstance(texture, dict)
            else Image("")
            for texture in list_or_empty(appearance.get("textures"))
        ]
        try:
            self._places = np.asarray(appearance.get("vertices-texture") or [], np.float64).reshape(-1, 2)
        except (TypeError, ValueError, OverflowError) as error:
            raise CityModelError(
                f"{source} has malformed vertices of textures ({error}).",
                "Mend them, or leave out `--textures`.",
            ) from None
        if appearance.get("materials"):
            textures.notes["list of materials: colours of surfaces"] += 1

    def read(self, geometry: Json, surfaces: Sequence[Any], first_serial: int) -> None:
        """Lays pictures on the surfaces of a geometry with a member ``texture``, in their order."""
        themes, notes = geometry["texture"], self._textures.notes
        if not isinstance(themes, dict) or not themes:
            return
        theme = self._theme if self._theme in themes else next(iter(themes))
        if len(themes) > 1:
            notes[f"theme of pictures besides {str(theme)[:60]!r}"] += len(themes) - 1
        values: Any = themes[theme].get("values") if isinstance(themes[theme], dict) else None
        try:
            values = flatten(values, DEPTHS[geometry["type"]])
            if len(values) != len(surfaces):
                raise ValueError("another number of surfaces")
            said = [
                [self._ring(label) for label in labels]
                if labels and labels[0] and type(labels[0][0]) is int
                else None
                for labels in values
            ]
        except (TypeError, ValueError, LookupError):
            notes["geometry with textures nested otherwise than its surfaces"] += 1
            return
        for serial, (surface, rings) in enumerate(zip(surfaces, said, strict=True), first_serial):
            if rings is not None:
                self._textures.lay(serial, list(map(len, surface)), rings)

    def _ring(self, label: list[Any]) -> tuple[Image | None, NDArray[np.float64]] | None:
        """Returns the picture of a ring, None without one in the file, and (n, 2) places of its corners."""
        if not label or type(label[0]) is not int:
            return None
        image, *corners = label
        are_there = all(type(k) is int and 0 <= k < len(self._places) for k in corners)
        places = self._places[corners] if corners and are_there else np.zeros((0, 2))
        return self._images[image] if 0 <= image < len(self._images) else None, places
