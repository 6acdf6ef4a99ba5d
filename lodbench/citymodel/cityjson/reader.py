"""CityJSON 1.0, 1.1, 2.0 and CityJSONSeq: objects, parents, transforms, templates, text levels."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.attributes import Lifespans, ObjectTable, overall_height, roof_type_of
from lodbench.citymodel.cityjson.geometry import GeometryReader, TextureReader, points_of
from lodbench.citymodel.codes import BUILDING_EMPTY, DUPLICATE_ID, NOT_A_BUILDING
from lodbench.citymodel.crs import crs_label, is_in_degrees
from lodbench.citymodel.gml.names import INTERIOR_NAMES, STOREYS
from lodbench.citymodel.options import ReadOptions, types_of
from lodbench.citymodel.raw import NotACity, PolygonCollector, RawCity, paused_collector
from lodbench.citymodel.textures import SurfaceTextures
from lodbench.errors import CityModelError
from lodbench.storage.json_text import list_or_empty

_GROUP = "CityObjectGroup"

Json = dict[str, Any]


# A feature is one building with its parts; a line of this size is something else.
_MAX_LINE_BYTES = 1 << 28


def documents_of(stream: BinaryIO, source: str, repeated: list[str]) -> Iterator[Any]:
    """Yields one JSON document per line of a sequence, or the one document that fills the file."""
    first = stream.readline(_MAX_LINE_BYTES)
    try:
        yield _parse(first, source, 1, repeated)
    except CityModelError:
        rest = stream.read()
        if not rest.strip():
            raise
        # Not one document per line: a single one over many lines.
        yield _parse(first + rest, source, None, repeated)
        return
    for number, line in enumerate(iter(lambda: stream.readline(_MAX_LINE_BYTES), b""), start=2):
        if line.strip():
            yield _parse(line, source, number, repeated)


def _parse(data: bytes, source: str, line: int | None, repeated: list[str]) -> Any:
    where = f"{source}, line {line}" if line is not None else source

    def mapping(pairs: list[tuple[str, Any]]) -> Json:
        values = dict(pairs)
        return values if len(values) == len(pairs) else _apart(pairs, repeated)

    try:
        return json.loads(
            data.decode("utf-8-sig"), parse_constant=_refuse_constant, object_pairs_hook=mapping
        )
    except RecursionError:
        raise CityModelError(
            f"{where}: the JSON is nested too deeply.",
            "City models nest a dozen levels: do not trust this file.",
        ) from None
    except UnicodeDecodeError as error:
        raise CityModelError(
            f"{where} is not UTF-8 (byte {error.start}).", "CityJSON is UTF-8: convert the file."
        ) from None
    except ValueError as error:
        raise CityModelError(
            f"{where} is not well-formed JSON: {error}.",
            "The file is damaged or cut off: download or export it again.",
        ) from None


def _apart(pairs: list[tuple[str, Any]], repeated: list[str]) -> Json:
    """Returns a JSON object with keys that stand twice; city objects stay apart, the later as ``id~2``."""
    values: Json = {}
    numbers: Counter[str] = Counter()  # how often each was met: the search goes on where it ended
    for key, value in pairs:
        own = key
        if isinstance(value, dict) and "type" in value:
            while own in values:
                numbers[key] += 1
                own = f"{key}~{numbers[key] + 1}"
            if own != key:
                repeated.append(key)
        values[own] = value
    return values


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is no JSON number")


def declared_system(metadata: Any, source: str) -> str | None:
    """Returns the name of the reference system in the metadata of a file, or None.

    Raises:
        CityModelError: It is no text.

    Example:
        >>> declared_system({"crs": {"epsg": 25832}}, "city.json")
        'EPSG:25832'
    """
    if isinstance(metadata, list):  # against the schema, and published all the same
        names = (declared_system(one, source) for one in metadata if isinstance(one, dict))
        return next(filter(None, names), None)
    if not isinstance(metadata, dict):
        return None
    crs = metadata.get("crs")
    # 0.9 and 1.0 files write the EPSG code alone, too.
    name = metadata.get("referenceSystem") or (crs.get("epsg") if isinstance(crs, dict) else crs)
    if isinstance(name, int):
        return f"EPSG:{name}"
    if not isinstance(name, str | None):
        raise CityModelError(
            f"{source} has a reference system that is no text: {str(name)[:60]}.",
            "Write it as https://www.opengis.net/def/crs/EPSG/0/25832, or name it with `crs=EPSG:...`",
        )
    return name


_EARTH_M = (6.2e6, 6.5e6)  # how far from the middle of the Earth its places are


_TILESET_HINT = (
    "Its tiles are meshes of their own (.b3dm, .glb): convert them to one .glb or .obj, or take the CityGML "
    "or CityJSON they were made from."
)


def place_of_tileset(document: dict[str, Any]) -> str:
    """Returns where the root of a tileset lies, in words; "" where it says no place.

    Example:
        >>> place_of_tileset({"root": {"boundingVolume": {"region": [0.2, 0.8, 0.2, 0.8, 0, 9]}}})
        'at latitude 45.83662, longitude 11.45916'
    """
    try:
        longitude, latitude = _degrees(document["root"])
    except (KeyError, TypeError, ValueError, IndexError):
        return ""
    return f"at latitude {latitude:.5f}, longitude {longitude:.5f}"


def _degrees(root: dict[str, Any]) -> tuple[float, float]:
    """Returns longitude and latitude of the middle of a tile."""
    from pyproj import Transformer

    volume = root["boundingVolume"]
    if "region" in volume:  # west, south, east, north in radians
        west, south, east, north = np.degrees(np.asarray(volume["region"][:4], np.float64)).tolist()
        return 0.5 * (west + east), 0.5 * (south + north)
    middle = np.asarray((volume.get("box") or volume["sphere"])[:3], np.float64)
    matrix = np.asarray(root.get("transform", np.eye(4)), np.float64).reshape(4, 4)  # column by column
    place = np.append(middle, 1.0) @ matrix[:, :3]
    if not _EARTH_M[0] < np.linalg.norm(place) < _EARTH_M[1]:
        raise ValueError("no place on Earth")
    degrees = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*place)
    return float(degrees[0]), float(degrees[1])


def parents_of(objects: dict[str, Json]) -> dict[str, str]:
    """Returns the object that each is a part of; a group only lists its members, which stay their own."""
    parents: dict[str, str] = {}
    for object_id, item in objects.items():
        if item.get("type") == _GROUP:
            continue
        for child in item.get("children") or ():
            parents.setdefault(str(child), object_id)
    for object_id, item in objects.items():
        given = (str(parent) for parent in item.get("parents") or ())
        own = next((one for one in given if objects.get(one, {}).get("type") != _GROUP), None)
        if own is not None:
            parents[object_id] = own
    return {child: parent for child, parent in parents.items() if parent in objects}


def roots_of(objects: dict[str, Json], parents: dict[str, str]) -> dict[str, str]:
    """Returns the topmost ancestor of each object; a circle ends where it closes."""
    roots: dict[str, str] = {}
    for object_id in objects:
        top, line = object_id, {object_id}
        while top not in roots and (parent := parents.get(top)) is not None and parent not in line:
            top = parent
            line.add(top)
        roots.update(dict.fromkeys(line, roots.get(top, top)))
    return roots


_HINT = "Check it with a CityJSON validator."
_CONSTRUCTIONS = ("Building", "Bridge", "Tunnel")
_LOOKS = ("textures", "materials")
_MAX_DEPTH = 100  # of parts in parts: real ones have three, and who writes them goes down as deep


def read_cityjson(
    open_stream: Callable[[], BinaryIO],
    source: str,
    options: ReadOptions,
    textures: SurfaceTextures | None = None,
) -> RawCity:
    """Returns the buildings of a CityJSON file or a sequence of CityJSON features, and objects of its layers.

    Args:
        open_stream: Opens the document.
        source: Its name, for messages.
        options: ``is_strict``, ``has_details``, ``layers``, ``date``.
        textures: Receives the pictures of surfaces, which are kept then; with ``has_details``.

    Raises:
        CityModelError: The file is no JSON, no CityJSON, or breaks its structure; the message names
            the object.
    """
    reader = _Reader(source, options, textures)
    with paused_collector(), open_stream() as stream:
        return reader.result(reader.read(documents_of(stream, source, reader.repeated)))


class _Reader:
    """State of one file while it is read."""

    def __init__(self, source: str, options: ReadOptions, textures: SurfaceTextures | None) -> None:
        self._source = source
        self._is_strict = options.is_strict
        self._wanted = types_of(options.layers)
        self._objects = ObjectTable(options.has_details)
        self._collector = PolygonCollector(objects=self._objects, textures=textures)
        self._lifespans = Lifespans(options.date, self._collector.findings)
        self._version: str | None = None
        self._srs_name: str | None = None
        self._transform: Json | None = None
        self._templates: Json = {}
        self._others: Counter[str] = Counter()
        self._template_textures: TextureReader | None = None
        self._has_textures = False
        self.repeated: list[str] = []  # keys of objects that one mapping has twice

    def read(self, documents: Iterator[Any]) -> str:
        """Reads all documents, and forgets them; returns the name of the format."""
        self.read_header(next(documents))
        is_sequence = False
        for feature in documents:
            is_sequence = True
            if isinstance(feature, dict) and feature.get("type") == "CityJSON":
                self._read_next_header(feature)  # of a sequence that was appended
            else:
                self.read_feature(feature)
        return "CityJSONSeq" if is_sequence else "CityJSON"

    def read_header(self, document: Any) -> None:
        kind = document.get("type") if isinstance(document, dict) else None
        if kind == "CityJSONFeature":
            raise CityModelError(
                f"{self._source} is a CityJSON feature without the CityJSON line that should come first.",
                "Without its transform the coordinates mean nothing: put the header line before it.",
            )
        if kind != "CityJSON":
            if isinstance(document, dict) and {"asset", "root", "geometricError"} <= document.keys():
                where = f" {place_of_tileset(document)}".rstrip()
                raise NotACity(
                    f"{self._source} is a tileset of 3D Tiles{where}, no city model.", _TILESET_HINT
                )
            hint = "Name GeoJSON footprints .geojson." if kind == "FeatureCollection" else _HINT
            raise NotACity(f"{self._source} is JSON, but not CityJSON (type {kind!r}).", hint)
        version = str(document.get("version", ""))
        if version.partition(".")[0] not in ("1", "2"):
            raise CityModelError(
                f"{self._source} is CityJSON {version or 'of no version'}.", "1.0 to 2.0 is read."
            )
        self._version = version
        self._srs_name = declared_system(document.get("metadata"), self._source)
        self._transform = document.get("transform")
        templates = document.get("geometry-templates")
        self._templates = templates if isinstance(templates, dict) else {}
        self.read_feature(document)

    def _read_next_header(self, document: Json) -> None:
        """Reads a line that says anew what transform and templates the features behind it have."""
        before = self._srs_name
        self.read_header(document)
        names = {None if name is None else crs_label(name)[0] for name in (before, self._srs_name)}
        if len(names) > 1:
            raise CityModelError(
                f"{self._source} joins features in {before} and in {self._srs_name}.",
                "One file has one reference system: part it at its CityJSON lines.",
            )

    def read_feature(self, document: Any) -> None:
        """Adds the buildings of a document with objects and vertices of its own."""
        if not isinstance(document, dict) or not isinstance(document.get("CityObjects", {}), dict):
            raise CityModelError(f"{self._source} has a feature that is no CityJSON object.", _HINT)
        appearance, textures = document.get("appearance"), None
        self._has_textures |= isinstance(appearance, dict) and any(map(appearance.get, _LOOKS))
        if self._collector.textures is not None and isinstance(appearance, dict):
            textures = TextureReader(appearance, self._collector.textures, self._source)
        if document.get("type") == "CityJSON":
            self._template_textures = textures  # templates stand in headers, and so do their pictures
        objects: dict[str, Json] = document.get("CityObjects", {})
        if not objects:
            return
        vertices = self._vertices(document.get("vertices", []))
        geometry = GeometryReader(
            self._collector, vertices, self._templates, self._is_strict, textures, self._template_textures,
            is_in_degrees(self._srs_name),
        )  # fmt: skip
        numbers = self._number_objects(objects)
        storeys = self._storeys(numbers)
        outside = self._levels_outside(objects, numbers, storeys)
        for object_id, item in objects.items():
            part = numbers.get(object_id)
            if part is None:
                continue
            number = self._objects.building[part]
            is_room = item.get("type") in INTERIOR_NAMES
            try:
                for shape in item.get("geometry") or ():
                    is_doubled = part in storeys and (number, str(shape.get("lod"))) in outside
                    geometry.read(shape, number, object_id, is_room or is_doubled, part)
            except CityModelError:
                raise
            except (TypeError, ValueError, KeyError, IndexError, AttributeError, OverflowError) as error:
                raise CityModelError(
                    f"{self._source}: the geometry of {object_id} is malformed ({error}).", _HINT
                ) from None
        geometry.finish()

    def _storeys(self, numbers: dict[str, int]) -> set[int]:
        """Returns the numbers of storeys and units of buildings, and of what is in them."""
        table, storeys = self._objects, set[int]()
        for part in sorted(numbers.values()):  # parents come first
            if table.types[part] in STOREYS or table.parents[part] in storeys:
                storeys.add(part)
        return storeys

    def _levels_outside(
        self, objects: dict[str, Json], numbers: dict[str, int], storeys: set[int]
    ) -> set[tuple[int, str]]:
        """Returns buildings and levels that have surfaces besides those of storeys and rooms."""
        if not storeys:
            return set()
        return {
            (self._objects.building[part], str(shape.get("lod")))
            for object_id, part in numbers.items()
            if part not in storeys and objects[object_id].get("type") not in INTERIOR_NAMES
            for shape in list_or_empty(objects[object_id].get("geometry"))
            if isinstance(shape, dict)
        }

    def _vertices(self, values: Any) -> NDArray[np.float64]:
        """Returns (V, 3) coordinates: the transform is applied where there is one."""
        try:
            vertices = points_of(values)
        except (TypeError, ValueError, OverflowError) as error:
            raise CityModelError(f"{self._source} has malformed vertices ({error}).", _HINT) from None
        if not np.isfinite(vertices).all():
            raise CityModelError(f"{self._source} has vertices that are not finite numbers.", _HINT)
        if self._transform is None:
            if self._version != "1.0" and len(vertices) and np.all(vertices == np.floor(vertices)):
                raise CityModelError(
                    f"{self._source} has no transform, without which its whole numbers mean nothing.", _HINT
                )
            return vertices
        try:
            scale = np.asarray(self._transform["scale"], np.float64).reshape(3)
            translate = np.asarray(self._transform["translate"], np.float64).reshape(3)
        except (TypeError, ValueError, KeyError) as error:
            raise CityModelError(f"{self._source} has a malformed transform ({error}).", _HINT) from None
        _require_scale(vertices, scale, self._source)
        return vertices * scale + translate

    def _number_objects(self, objects: dict[str, Json]) -> dict[str, int]:
        """Adds every object that belongs to a building, parents first; returns their numbers by id."""
        for object_id, item in objects.items():
            if not isinstance(item, dict):
                raise CityModelError(f"{self._source}: the object {object_id} is malformed.", _HINT)
        parents = parents_of(objects)
        roots = roots_of(objects, parents)
        left_out = self._left_out(objects, roots)
        has_geometry = {roots[object_id] for object_id, item in objects.items() if item.get("geometry")}
        numbers: dict[str, int] = {}
        depths: dict[str, int] = {}
        for object_id, item in objects.items():
            root = roots[object_id]
            root_type = str(objects[root].get("type"))
            if root_type not in self._wanted and not _is_building(root_type):
                self._others[str(item.get("type"))] += 1
                continue
            line = [object_id]
            while line[-1] not in numbers and line[-1] != root:
                line.append(parents[line[-1]])
            if not left_out.isdisjoint(line):
                continue
            for own in reversed(line):
                if own not in numbers:
                    parent = -1 if own == root else numbers[parents[own]]
                    depths[own] = 0 if own == root else depths[parents[own]] + 1
                    if depths[own] > _MAX_DEPTH:
                        raise CityModelError(f"{self._source}: {own} is nested too deeply.", _HINT)
                    numbers[own] = self._add_object(own, objects[own], parent, root in has_geometry)
        return numbers

    def _left_out(self, objects: dict[str, Json], roots: dict[str, str]) -> set[str]:
        """Returns the ids of buildings and parts that do not stand, and of objects of extensions in them."""
        left_out = set()
        for object_id, item in objects.items():
            type_, root = str(item.get("type")), str(objects[roots[object_id]].get("type"))
            attributes = item.get("attributes")
            if root not in self._wanted and not _is_building(root):
                continue
            if type_.startswith("+") and not any(word in type_ for word in _CONSTRUCTIONS):
                self._others[type_] += 1
                left_out.add(object_id)
            elif isinstance(attributes, dict) and not self._lifespans.stands(object_id, attributes):
                left_out.add(object_id)
        return left_out

    def _add_object(self, object_id: str, item: Json, parent: int, has_geometry: bool) -> int:
        """Returns the number of a new object, which is a building of its own where it has no parent."""
        table = self._objects
        building = table.building[parent] if parent >= 0 else self._add_building(object_id, has_geometry)
        stated = item.get("attributes")
        stated = stated if isinstance(stated, dict) else {}
        attributes = None
        if table.has_details:
            attributes = dict(stated)
            if item.get("address"):
                attributes["address"] = item["address"]
        type_, height_m = str(item.get("type")), overall_height(stated)
        height_m = height_m if parent < 0 or type_ == "BuildingPart" else None
        return table.add(object_id, type_, parent, building, attributes, roof_type_of(stated), height_m)

    def _add_building(self, building_id: str, has_geometry: bool) -> int:
        findings = self._collector.findings
        if not has_geometry:
            findings.add(BUILDING_EMPTY, building_id)
        self._collector.building_ids.append(building_id)
        return len(self._collector.building_ids) - 1

    def result(self, format: str) -> RawCity:
        for name in self.repeated:
            self._collector.findings.add(DUPLICATE_ID, name, "names two objects; the later gets ~2 and so on")
        for name, count in sorted(self._others.items()):
            self._collector.findings.add(NOT_A_BUILDING, name, f"{count} of them")
        if not self._collector.building_ids and (ended := self._lifespans.none_stands()):
            raise NotACity(f"{self._source} {ended}.", "Take it as it stood before: `date=YYYY-MM-DD`")
        if not self._collector.building_ids:
            raise NotACity(f"{self._source} has no buildings.", "Is it the building tile of the city?")
        city = self._collector.finish(
            source=self._source, format=format, version=self._version, srs_names=(self._srs_name,)
        )
        city.has_textures, city.period = self._has_textures, self._lifespans.period()
        return city


def _require_scale(vertices: NDArray[np.float64], scale: NDArray[np.float64], source: str) -> None:
    """Makes sure that a transform keeps the vertices apart that it scales."""
    is_lost = ~np.isfinite(scale) | (scale == 0)
    if len(vertices) and is_lost[2] and np.isfinite(scale[2]):
        is_lost[2] = bool(np.ptp(vertices[:, 2]))
    if len(vertices) and is_lost.any():
        axes = " and ".join(axis for axis, lost in zip("xyz", is_lost.tolist(), strict=True) if lost)
        values = ", ".join(f"{value:g}" for value in scale.tolist())
        raise CityModelError(
            f"{source} has a transform with the scale [{values}], which leaves nothing of {axes}: "
            "the program that wrote it lost the coordinates.",
            "Export it again, or with another program.",
        )


def _is_building(kind: str) -> bool:
    # Extensions name their own: "+NoiseBuilding", and "BuildingZ" without the sign has been seen.
    return kind.lstrip("+").startswith("Building") or (kind.startswith("+") and "Building" in kind)
