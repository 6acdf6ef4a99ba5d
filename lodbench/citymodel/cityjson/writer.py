"""CityJSON 2.0 and CityJSONSeq: buildings with parts, attributes, solids and semantics, to the millimetre."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np

from lodbench.citymodel.crs import epsg_codes
from lodbench.citymodel.model import CityModel, CityObjects, Polygons, SurfaceKind, group_by
from lodbench.citymodel.raw import buildings_only
from lodbench.citymodel.textures import WrittenPictures, counted_lines

_SURFACE_NAMES = {
    SurfaceKind.WALL: "WallSurface",
    SurfaceKind.ROOF: "RoofSurface",
    SurfaceKind.GROUND: "GroundSurface",
    SurfaceKind.CLOSURE: "ClosureSurface",
    SurfaceKind.OPENING: "Window",
    SurfaceKind.DOOR: "Door",
    SurfaceKind.FLOOR: "OuterFloorSurface",
    SurfaceKind.CEILING: "OuterCeilingSurface",
}
_TYPES = frozenset(
    {
        "Building", "BuildingPart", "BuildingInstallation", "BuildingConstructiveElement",
        "BuildingFurniture", "BuildingStorey", "BuildingRoom", "BuildingUnit",
        "Bridge", "BridgePart", "BridgeInstallation", "BridgeConstructiveElement", "BridgeRoom",
        "BridgeFurniture", "Tunnel", "TunnelPart", "TunnelInstallation", "TunnelConstructiveElement",
        "TunnelHollowSpace", "TunnelFurniture", "OtherConstruction", "SolitaryVegetationObject",
        "PlantCover", "CityFurniture", "TINRelief", "Road", "Railway", "Waterway", "TransportSquare",
        "WaterBody", "LandUse", "GenericCityObject",
    }
)  # fmt: skip
# Attributes that CityJSON takes a single text for.
_ONE_TEXT = ("class", "function", "usage")
_MILLIMETRE = 0.001
_LOD = re.compile(r"[0-3](\.[0-3])?")

Json = dict[str, Any]


def cityjson_text(model: CityModel, pictures: WrittenPictures | None = None) -> tuple[bytes, tuple[str, ...]]:
    """Returns a city as one CityJSON 2.0 document, and a line for each thing it could not say.

    Args:
        model: The city; read with ``ReadOptions(has_details=True)`` it has attributes and solids.
        pictures: Those of its pictures that are kept.
    """
    writer = _Writer(model, pictures or WrittenPictures())
    objects: Json = {}
    for building in range(len(model.building_ids)):
        objects |= writer.objects_of(building)
    document = writer.header() | {"CityObjects": objects, "vertices": writer.vertices.tolist()}
    document |= writer.textures.appearance()
    content = json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()
    return content, counted_lines(writer.notes)


def cityjsonseq_text(
    model: CityModel, pictures: WrittenPictures | None = None
) -> tuple[bytes, tuple[str, ...]]:
    """Returns a city as a sequence of CityJSON features, a building to a line; see ``cityjson_text``."""
    writer = _Writer(model, pictures or WrittenPictures())
    lines = [
        json.dumps(
            writer.header() | {"CityObjects": {}, "vertices": []}, separators=(",", ":"), ensure_ascii=False
        )
    ]
    for building, building_id in enumerate(model.building_ids):
        # A feature has an appearance of its own.
        writer.textures = TextureWriter(model.polygons, pictures or WrittenPictures())
        objects = writer.objects_of(building)
        used = sorted(
            {n for item in objects.values() for shape in item.get("geometry", ()) for n in _leaves(shape)}
        )
        place = {number: k for k, number in enumerate(used)}
        for item in objects.values():
            for shape in item.get("geometry", ()):
                shape["boundaries"] = _renumbered(shape["boundaries"], place)
        feature = {
            "type": "CityJSONFeature",
            "id": building_id,
            "CityObjects": objects,
            "vertices": writer.vertices[used].tolist(),
            **writer.textures.appearance(),
        }
        lines.append(json.dumps(feature, separators=(",", ":"), ensure_ascii=False))
    return ("\n".join(lines) + "\n").encode(), counted_lines(writer.notes)


class _Writer:
    """Turns buildings into CityJSON objects whose boundaries point into one list of vertices.

    Attributes:
        vertices: (V, 3) int64, millimetres.
        notes: How often something could not be said, by what.
        textures: Receives the pictures of the surfaces written.
    """

    def __init__(self, model: CityModel, pictures: WrittenPictures) -> None:
        polygons = model.polygons
        self._model = model
        self.textures = TextureWriter(polygons, pictures)
        self._objects: CityObjects = model.objects or buildings_only(model.building_ids)
        self._low = polygons.points.min(axis=0) if len(polygons.points) else np.zeros(3)
        whole = np.rint((polygons.points - self._low) / _MILLIMETRE).astype(np.int64)
        self.vertices, inverse = np.unique(whole, axis=0, return_inverse=True)
        self._corners: list[int] = inverse.reshape(-1).tolist()
        self._rings = polygons.ring_starts.tolist()
        self._polygon_rings = polygons.polygon_starts.tolist()
        part = polygons.building if polygons.part is None else polygons.part
        self._kinds: list[int] = polygons.kind.tolist()
        self._lods: list[int] = polygons.lod.tolist()
        self._of_part = group_by(part)
        self._of_building = group_by(self._objects.building)
        self._solids_of_part: dict[int, list[int]] = {}
        if model.solids is not None:
            self._solids_of_part = group_by(model.solids.part)
        self.notes: Counter[str] = Counter()
        self._lod_names = [self._lod_name(name) for name in model.lods]

    def _lod_name(self, name: str) -> str:
        """Returns the name of a level as CityJSON allows it: 0 to 3, and what refines them."""
        own = name if _LOD.fullmatch(name) else "1"
        if name.startswith("4"):  # of CityGML 2: the inside of level 3
            own = "3.3" if "3" in self._model.lods else "3"
        if own != name:
            self.notes[f"LoD{name or ' unnamed'} written as LoD{own}"] += 1
        return own

    def header(self) -> Json:
        """Returns what comes before the objects: version, transform, reference system."""
        translate = (self._low + self._model.origin).tolist()
        header: Json = {
            "type": "CityJSON",
            "version": "2.0",
            "transform": {"scale": [_MILLIMETRE] * 3, "translate": translate},
        }
        name, left_out = reference_system(self._model.crs)
        if left_out:
            self.notes[left_out] += 1
        if name is not None:
            header["metadata"] = {"referenceSystem": name}
        return header

    def objects_of(self, building: int) -> Json:
        """Returns a building and all that belongs to it, by id."""
        table, result = self._objects, {}
        members = self._of_building.get(building, [])
        for n in members:
            item: Json = {"type": self._type(n)}
            attributes = dict(table.attributes[n]) if table.attributes else {}
            address = attributes.pop("address", None)
            if address:
                item["address"] = [self._address(one) for one in listed(address)]
            if attributes:
                item["attributes"] = {key: fitting(key, value) for key, value in attributes.items()}
                for key in _ONE_TEXT:
                    if len(listed(attributes.get(key, ""))) > 1:
                        self.notes[f"several values of {key!r} joined to one text, as CityJSON asks for"] += 1
            children = [table.ids[k] for k in members if table.parents[k] == n]
            if children:
                item["children"] = children
            if table.parents[n] >= 0:
                item["parents"] = [table.ids[table.parents[n]]]
            geometry = list(self._geometry(n))
            if geometry:
                item["geometry"] = geometry
            result[table.ids[n]] = item
        return result

    def _address(self, address: Any) -> Any:
        """Returns an address without its point, whose indices were of another list of vertices."""
        if not isinstance(address, dict) or "location" not in address:
            return address
        self.notes["point of an address"] += 1
        return {key: value for key, value in address.items() if key != "location"}

    def _type(self, n: int) -> str:
        type_ = self._objects.types[n]
        if type_ in _TYPES:
            return type_
        plain = "Building" if self._objects.parents[n] < 0 else "BuildingPart"
        self.notes[f"type {type_} of an extension written as {plain}"] += 1
        return plain

    def _geometry(self, part: int) -> Iterator[Json]:
        """Yields the geometries of an object: per level its solids, and the surfaces that are in none."""
        solids: dict[int, list[list[list[tuple[int, bool]]]]] = defaultdict(list)
        enclosed: set[int] = set()
        for solid in self._solids_of_part.get(part, ()):
            shells = self._model.solids.shells_of(solid) if self._model.solids is not None else []
            if shells:
                solids[self._lods[shells[0][0][0]]].append(shells)
                enclosed.update(face for shell in shells for face, _ in shell)
        for lod, volumes in sorted(solids.items()):
            values = [[[kind for kind in shell] for shell in volume] for volume in volumes]
            shapes = [[[self._surface(*face) for face in shell] for shell in volume] for volume in volumes]
            if len(volumes) == 1:
                yield self._shape("Solid", lod, shapes[0], values[0])
            else:
                yield self._shape("CompositeSolid", lod, shapes, values)
        loose: dict[int, list[tuple[int, bool]]] = defaultdict(list)
        for polygon in self._of_part.get(part, ()):
            if polygon not in enclosed:
                loose[self._lods[polygon]].append((polygon, False))
        for lod, faces in sorted(loose.items()):
            kind = "CompositeSurface" if self._objects.types[part] == "TINRelief" else "MultiSurface"
            yield self._shape(kind, lod, [self._surface(*face) for face in faces], faces)

    def _surface(self, polygon: int, is_flipped: bool) -> list[list[int]]:
        rings = range(self._polygon_rings[polygon], self._polygon_rings[polygon + 1])
        surface = [self._corners[self._rings[r] : self._rings[r + 1]] for r in rings]
        return [ring[::-1] for ring in surface] if is_flipped else surface

    def _shape(self, type_: str, lod: int, boundaries: list[Any], faces: list[Any]) -> Json:
        """Returns a geometry; ``faces`` are nested as its semantic values are."""
        surfaces: dict[str, int] = {}

        def label(face: Any) -> Any:
            if isinstance(face, list):
                return [label(inner) for inner in face]
            kind = self._kinds[face[0]]
            if kind == SurfaceKind.INTERIOR:
                self.notes["polygon of a room written without the kind of its surface"] += 1
            name = _SURFACE_NAMES.get(SurfaceKind(kind))
            return None if name is None else surfaces.setdefault(name, len(surfaces))

        values = label(faces)
        shape: Json = {"type": type_, "lod": self._lod_names[lod], "boundaries": boundaries}
        if self._model.pictures is not None:
            shape |= self.textures.texture(faces)
        if surfaces:
            shape["semantics"] = {"surfaces": [{"type": name} for name in surfaces], "values": values}
        return shape


def listed(value: Any) -> list[Any]:
    """Returns a list as it is, and anything else as a list of one."""
    return value if isinstance(value, list) else [value]


def fitting(key: str, value: Any) -> Any:
    """Returns an attribute of the type that CityJSON requires, where it asks for one and it can be."""
    if key in _ONE_TEXT:
        return ", ".join(map(str, listed(value)))
    if key.startswith("storeyHeights") and isinstance(value, int | float):
        return [value]
    if key.startswith("storeys") and str(value).isdigit():
        return int(value)
    return value


def reference_system(crs: str | None) -> tuple[str | None, str]:
    """Returns the name in CityJSON's form, which has one code, and what of the system it cannot say.

    Example:
        >>> reference_system("EPSG:7415")
        ('https://www.opengis.net/def/crs/EPSG/0/7415', '')
    """
    if crs is None:
        return None, ""
    codes = epsg_codes(crs)
    if len(codes) == 1:
        return _url(codes[0]), ""
    if not codes:
        return None, f"reference system {crs}, which has no EPSG code"
    left_out = f"vertical reference system of {crs}: CityJSON names one EPSG code, and the two have none"
    return _url(codes[0]), left_out


def _url(code: int) -> str:
    return f"https://www.opengis.net/def/crs/EPSG/0/{code}"


def _leaves(shape: Json) -> Iterator[int]:
    stack = [shape["boundaries"]]
    while stack:
        for value in stack.pop():
            if isinstance(value, list):
                stack.append(value)
            else:
                yield value


def _renumbered(values: list[Any], place: dict[int, int]) -> list[Any]:
    return [_renumbered(v, place) if isinstance(v, list) else place[v] for v in values]


_THEME = "pictures"


class TextureWriter:
    """Collects the textures of a document or feature."""

    def __init__(self, polygons: Polygons, pictures: WrittenPictures) -> None:
        self._polygons, self._pictures = polygons, pictures
        self._textures: dict[int, int] = {}
        self._places: dict[tuple[float, ...], int] = {}

    def values(self, faces: Any) -> Any:
        """Returns the texture values of polygons, nested as these are; a polygon is (number, is turned)."""
        if isinstance(faces, list):
            return [self.values(face) for face in faces]
        (polygon, is_flipped), polygons = faces, self._polygons
        values: list[list[int | None]] = []
        for ring in range(polygons.polygon_starts[polygon], polygons.polygon_starts[polygon + 1]):
            points = slice(polygons.ring_starts[ring], polygons.ring_starts[ring + 1])
            found = self._pictures.on_ring(polygons, polygon, points)
            if found is None:
                values.append([None])
                continue
            number = self._textures.setdefault(found[0], len(self._textures))
            places = [tuple(place) for place in np.round(found[1], 7).tolist()]
            indices = [self._places.setdefault(place, len(self._places)) for place in places]
            values.append([number, *(indices[::-1] if is_flipped else indices)])
        return values

    def texture(self, faces: list[Any]) -> Json:
        """Returns the member ``texture`` of a geometry, or nothing where it has none."""
        values = self.values(faces)
        return {"texture": {_THEME: {"values": values}}} if _has_any(values) else {}

    def appearance(self) -> Json:
        """Returns the member ``appearance`` of the document, or nothing where it has none."""
        if not self._textures:
            return {}
        textures = [
            {"type": "JPG" if name.endswith(".jpg") else "PNG", "image": name}
            | ({"wrapMode": wrap} if wrap else {})
            for name, wrap in map(self._pictures.images.__getitem__, self._textures)
        ]
        places = [list(place) for place in self._places]
        return {
            "appearance": {
                "textures": textures, "vertices-texture": places, "default-theme-texture": _THEME,
            }
        }  # fmt: skip


def _has_any(values: Any) -> bool:
    if isinstance(values, list):
        return any(map(_has_any, values))
    return values is not None
