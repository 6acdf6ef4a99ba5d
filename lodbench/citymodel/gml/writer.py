"""CityGML 2.0 and 3.0, written a building at a time, with parts, attributes, surfaces by kind and solids.

City objects that are no buildings as CityGML: bridges and tunnels as buildings are, others by their shape.
Bridges and tunnels have all that buildings have, under names that differ by the word and the prefix alone.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from lodbench.citymodel.crs import epsg_codes
from lodbench.citymodel.gml.geometry_writer import GeometryXml, LevelShapes
from lodbench.citymodel.gml.properties_writer import (
    CITYGML_2,
    CITYGML_3,
    Dialect,
    Property,
    properties_of,
    tag,
)
from lodbench.citymodel.model import CityModel, SurfaceKind, group_by
from lodbench.citymodel.raw import buildings_only
from lodbench.citymodel.textures import WrittenPictures

# Namespace by prefix, without the version.
MODULES = {
    "brid": "bridge",
    "tun": "tunnel",
    "veg": "vegetation",
    "frn": "cityfurniture",
    "tran": "transportation",
    "wtr": "waterbody",
    "luse": "landuse",
    "dem": "relief",
}
# Names of bridges and tunnels that say more than the word and the prefix.
_OWN_NAMES = {
    "brid:Room": "brid:BridgeRoom",
    "brid:interiorRoom": "brid:interiorBridgeRoom",
    "tun:Room": "tun:HollowSpace",
    "tun:interiorRoom": "tun:interiorHollowSpace",
    "tun:TunnelRoom": "tun:HollowSpace",
    "tun:tunnelRoom": "tun:hollowSpace",
    "tun:roomInstallation": "tun:hollowSpaceInstallation",
    "brid:roomInstallation": "brid:bridgeRoomInstallation",
}
_TAG = re.compile(r"<(/?)bldg:(\w+)")


@dataclass(frozen=True, slots=True)
class _Kind:
    """How objects of a type are written: their elements, and what CityGML 2 calls their geometry."""

    element_2: str
    element_3: str
    shape_2: str


_GEOMETRY, _SURFACES, _WATER, _TERRAIN = "Geometry", "MultiSurface", "water", "terrain"
_KINDS = {
    "SolitaryVegetationObject": _Kind(
        "veg:SolitaryVegetationObject", "veg:SolitaryVegetationObject", _GEOMETRY
    ),
    "PlantCover": _Kind("veg:PlantCover", "veg:PlantCover", _SURFACES),
    "CityFurniture": _Kind("frn:CityFurniture", "frn:CityFurniture", _GEOMETRY),
    "Road": _Kind("tran:Road", "tran:Road", _SURFACES),
    "Railway": _Kind("tran:Railway", "tran:Railway", _SURFACES),
    "TransportSquare": _Kind("tran:Square", "tran:Square", _SURFACES),
    "Waterway": _Kind("tran:TransportationComplex", "tran:Waterway", _SURFACES),
    "WaterBody": _Kind("wtr:WaterBody", "wtr:WaterBody", _WATER),
    "LandUse": _Kind("luse:LandUse", "luse:LandUse", _SURFACES),
    "TINRelief": _Kind("dem:ReliefFeature", "dem:ReliefFeature", _TERRAIN),
    "GenericCityObject": _Kind("gen:GenericCityObject", "gen:GenericOccupiedSpace", _GEOMETRY),
    "OtherConstruction": _Kind("gen:GenericCityObject", "con:OtherConstruction", _GEOMETRY),
}
_ABOVE_GROUND = ("Road", "Railway", "TransportSquare", "Waterway", "SolitaryVegetationObject",
                 "PlantCover", "CityFurniture")  # fmt: skip


def element_of(type_: str, dialect: Dialect) -> str:
    """Returns the element of objects of a type that is neither building, bridge nor tunnel, or ""."""
    kind = _KINDS.get(type_)
    return "" if kind is None else kind.element_2 if dialect.version == "2.0" else kind.element_3


def like_buildings(type_: str) -> tuple[str, str]:
    """Returns the prefix of a bridge or tunnel or what is part of one, and its counterpart in buildings.

    Example:
        >>> like_buildings("BridgePart"), like_buildings("TunnelHollowSpace"), like_buildings("Road")
        (('brid', 'BuildingPart'), ('tun', 'BuildingRoom'), ('', 'Road'))
    """
    for word, prefix in (("Bridge", "brid"), ("Tunnel", "tun")):
        if type_.startswith(word):
            return prefix, type_.replace(word, "Building").replace("HollowSpace", "Room")
    return "", type_


def renamed(xml: str, prefix: str) -> str:
    """Returns the XML of a building under the names of another module of CityGML."""
    word = MODULES.get(prefix, "")

    def own(match: re.Match[str]) -> str:
        name = match[2].replace("Building", word.capitalize()).replace("building", word)
        name = f"{prefix}:{name}"
        return f"<{match[1]}{_OWN_NAMES.get(name, name)}"

    return _TAG.sub(own, xml)


def layer_geometry(
    geometry: GeometryXml, part: int, object_id: str, type_: str, dialect: Dialect
) -> Iterator[Property]:
    """Yields the geometry of an object of such a type as properties."""
    kind = _KINDS[type_]
    prefix = element_of(type_, dialect).partition(":")[0]
    if kind.shape_2 == _TERRAIN:
        yield from _terrain(geometry, part, object_id)
        return
    for shapes in geometry.levels_of(part):
        if dialect.version == "3.0":
            yield from _spaces(geometry, shapes, type_)
        elif kind.shape_2 == _GEOMETRY:
            level = max(shapes.level, 0 if prefix == "gen" else 1)
            parts = [text for text in (geometry.solid(shapes), geometry.surfaces(shapes.loose)) if text]
            whole = "".join(tag("gml:geometryMember", text) for text in parts)
            name = f"{prefix}:lod{level}Geometry"
            yield name, tag(name, parts[0] if len(parts) == 1 else tag("gml:MultiGeometry", whole))
        else:
            yield from _surfaces_2(geometry, shapes, type_, prefix)


def _surfaces_2(geometry: GeometryXml, shapes: LevelShapes, type_: str, prefix: str) -> Iterator[Property]:
    """Yields the geometry of what CityGML 2 describes by surfaces, and water by solids too."""
    loose, level = shapes.loose, max(shapes.level, 1 if type_ in _ABOVE_GROUND else 0)
    solid = ""
    if type_ in ("WaterBody", "PlantCover"):
        solid = geometry.solid(shapes)
    else:
        loose = [*loose, *shapes.enclosed]
    if type_ == "WaterBody":
        level = min(level, 1) if loose else level
    if loose:
        name = f"{prefix}:lod{level}MultiSurface"
        yield name, tag(name, geometry.surfaces(loose))
    if solid and type_ == "WaterBody":
        name = f"{prefix}:lod{max(shapes.level, 1)}Solid"
        yield name, tag(name, solid)
    elif solid:
        name = f"{prefix}:lod{level}MultiSolid"
        yield name, tag(name, tag("gml:MultiSolid", tag("gml:solidMember", solid)))


def _spaces(geometry: GeometryXml, shapes: LevelShapes, type_: str) -> Iterator[Property]:
    """Yields the geometry of a space of CityGML 3, or of a surface there."""
    loose, level = shapes.loose, shapes.level
    if type_ == "LandUse":
        loose = [*loose, *shapes.enclosed]
    elif level == 0:
        loose = [*loose, *shapes.enclosed]
    elif shapes.solids:
        yield f"core:lod{level}Solid", tag(f"core:lod{level}Solid", geometry.solid(shapes))
    if not loose:
        return
    if level == 1 and type_ != "LandUse":
        shape = tag("core:lod1MultiSurface", geometry.surfaces(loose))
        yield "core:boundary", tag("core:boundary", tag("gen:GenericThematicSurface", shape))
    else:
        yield f"core:lod{level}MultiSurface", tag(f"core:lod{level}MultiSurface", geometry.surfaces(loose))


def _terrain(geometry: GeometryXml, part: int, object_id: str) -> Iterator[Property]:
    """Yields the finest level of terrain, and its surfaces as triangles, each in a component of its own."""
    levels = list(geometry.levels_of(part))
    yield "dem:lod", tag("dem:lod", str(max((shapes.level for shapes in levels), default=0)))
    for shapes in levels:
        triangles = geometry.triangles([*shapes.loose, *shapes.enclosed])
        tin = tag("dem:tin", tag("gml:TriangulatedSurface", tag("gml:trianglePatches", triangles)))
        lod = tag("dem:lod", str(shapes.level))
        component = tag("dem:TINRelief", lod + tin, gml__id=f"{object_id}-lod{shapes.level}-tin")
        yield "dem:reliefComponent", tag("dem:reliefComponent", component)


DIALECTS = {"2.0": CITYGML_2, "3.0": CITYGML_3}
_NAME = re.compile(r"[^\W\d][\w.-]*")
_NOT_IN_NAMES = re.compile(r"[^\w.-]")

# Element of each type of object, and the property of its parent that holds it; by version.
_ELEMENTS = {
    "2.0": {
        "Building": ("bldg:Building", ""),
        "BuildingPart": ("bldg:BuildingPart", "bldg:consistsOfBuildingPart"),
        "BuildingInstallation": ("bldg:BuildingInstallation", "bldg:outerBuildingInstallation"),
        "BuildingConstructiveElement": ("bldg:BuildingInstallation", "bldg:outerBuildingInstallation"),
        "BuildingRoom": ("bldg:Room", "bldg:interiorRoom"),
        "BuildingFurniture": ("bldg:BuildingFurniture", "bldg:interiorFurniture"),
    },
    "3.0": {
        "Building": ("bldg:Building", ""),
        "BuildingPart": ("bldg:BuildingPart", "bldg:buildingPart"),
        "BuildingInstallation": ("bldg:BuildingInstallation", "bldg:buildingInstallation"),
        "BuildingConstructiveElement": (
            "bldg:BuildingConstructiveElement", "bldg:buildingConstructiveElement",
        ),
        "BuildingRoom": ("bldg:BuildingRoom", "bldg:buildingRoom"),
        "BuildingFurniture": ("bldg:BuildingFurniture", "bldg:buildingFurniture"),
        "BuildingStorey": ("bldg:Storey", "bldg:buildingSubdivision"),
        "BuildingUnit": ("bldg:BuildingUnit", "bldg:buildingSubdivision"),
    },
}  # fmt: skip


class CityGmlWriter:
    """Writes a city as CityGML.

    Args:
        model: The city; read with ``ReadOptions(has_details=True)`` it has attributes and solids.
        version: ``"2.0"`` or ``"3.0"``.
        pictures: Where those of its pictures lie that are kept, by number.

    Attributes:
        notes: How often something could not be said, by what; complete once all is written.
    """

    def __init__(
        self, model: CityModel, version: str = "2.0", pictures: WrittenPictures | None = None
    ) -> None:
        self.notes: Counter[str] = Counter()
        self._model, self._dialect = model, DIALECTS[version]
        self._objects = model.objects or buildings_only(model.building_ids)
        taken: set[str] = set()
        self._ids = _xml_ids(self._objects.ids, taken, self.notes)
        named = model.polygon_ids or [""] * len(model.polygons)
        owners = model.polygons.building if model.polygons.part is None else model.polygons.part
        wanted = [
            name or f"{self._ids[owner]}-p{n}"
            for n, (name, owner) in enumerate(zip(named, owners.tolist(), strict=True))
        ]
        polygon_ids = _xml_ids(wanted, taken, Counter())
        pictures = pictures or WrittenPictures()
        self._geometry = GeometryXml(model, self._dialect, polygon_ids, pictures, self.notes)
        self._of_building = group_by(self._objects.building)

    def chunks(self) -> Iterator[bytes]:
        """Yields the document piece by piece, a building at a time."""
        yield self._head().encode()
        for building in range(len(self._model.building_ids)):
            members = self._of_building.get(building, [])
            children = {n: [k for k in members if self._objects.parents[k] == n] for n in members}
            for root in [n for n in members if self._objects.parents[n] < 0]:
                xml = self._object(root, "", children)
                if xml:
                    yield f"<core:cityObjectMember>{xml}</core:cityObjectMember>\n".encode()
            yield self._geometry.appearance.take().encode()
        yield b"</core:CityModel>\n"

    def _head(self) -> str:
        version, types = self._dialect.version, set(self._objects.types)
        used = {element_of(name, self._dialect).partition(":")[0] for name in types}
        used |= {like_buildings(name)[0] for name in types}
        modules = {
            prefix: f"http://www.opengis.net/citygml/{name}/{version}"
            for prefix, name in MODULES.items()
            if prefix in used
        }
        named = self._dialect.namespaces | modules
        spaces = "".join(f' xmlns:{prefix}="{uri}"' for prefix, uri in named.items())
        head = f'<?xml version="1.0" encoding="UTF-8"?>\n<core:CityModel{spaces}>\n'
        points = self._model.polygons.points
        if len(points) == 0:
            return head
        low, high = points.min(axis=0) + self._model.origin, points.max(axis=0) + self._model.origin
        corners = "".join(
            tag(f"gml:{name}", " ".join(f"{x:.4f}" for x in corner))
            for name, corner in (("lowerCorner", low), ("upperCorner", high))
        )
        srs = srs_name(self._model.crs)
        if srs is None and self._model.crs is not None:
            self.notes[f"reference system {self._model.crs}, which has no EPSG code"] += 1
        stated = {} if srs is None else {"srsName": srs}
        return head + tag("gml:boundedBy", tag("gml:Envelope", corners, srsDimension="3", **stated)) + "\n"

    def _object(self, n: int, parent_type: str, children: dict[int, list[int]]) -> str:
        """Returns an object and all that belongs to it, its properties in the order of the schema."""
        table, version = self._objects, self._dialect.version
        prefix, type_ = like_buildings(table.types[n])
        if element_of(type_, self._dialect):
            return self._of_layer(n, type_)
        if prefix == "brid" and type_ == "BuildingConstructiveElement" and version == "2.0":
            self.notes["constructive element of a bridge written as an installation"] += 1
        if type_ not in _ELEMENTS[version] and "Building" in type_:
            plain = "Building" if table.parents[n] < 0 else "BuildingPart"
            if type_ not in _ELEMENTS["3.0"]:
                self.notes[f"type {type_} of an extension written as {plain}"] += 1
                type_ = plain
        if type_ not in _ELEMENTS[version]:
            self.notes[f"{type_}, which lodbench does not write as CityGML {version}"] += 1
            return ""
        element, _ = self._holder(n, type_, parent_type)
        rank = self._dialect.rank
        properties: list[Property] = list(self._geometry.properties(n, self._ids[n], type_))
        if table.attributes:
            properties += properties_of(table.attributes[n], type_, self._dialect)
        for child in children[n]:
            xml = self._object(child, type_, children)
            if xml:
                _, holder = self._holder(child, like_buildings(table.types[child])[1], type_)
                properties.append((holder, tag(holder, xml)))
        properties.sort(key=lambda one: rank.get(one[0], len(rank)))
        xml = tag(element, "".join(xml for _, xml in properties), gml__id=self._ids[n])
        return renamed(xml, prefix) if prefix and table.parents[n] < 0 else xml

    def _of_layer(self, n: int, type_: str) -> str:
        """Returns an object that is neither building, bridge nor tunnel."""
        table, dialect = self._objects, self._dialect
        element = element_of(type_, dialect)
        properties: list[Property] = list(layer_geometry(self._geometry, n, self._ids[n], type_, dialect))
        if table.attributes:
            stated = table.attributes[n].items()
            own = {key: value for key, value in stated if (type_, key) != ("TINRelief", "lod")}
            properties += properties_of(own, type_, dialect)
        properties.sort(key=lambda one: dialect.rank.get(one[0], len(dialect.rank)))
        xml = tag(element, "".join(xml for _, xml in properties), gml__id=self._ids[n])
        return renamed(xml, element.partition(":")[0])

    def _holder(self, n: int, type_: str, parent_type: str) -> tuple[str, str]:
        """Returns the element of an object, and the property of its parent that holds it."""
        known = _ELEMENTS[self._dialect.version]
        element, holder = known.get(type_, known["BuildingPart"])
        if self._dialect.version == "3.0":
            return element, holder
        is_inside = type_ == "BuildingFurniture" or (type_ == "BuildingInstallation" and self._is_interior(n))
        if is_inside and parent_type == "BuildingRoom" and type_ == "BuildingInstallation":
            return "bldg:IntBuildingInstallation", "bldg:roomInstallation"
        if is_inside and parent_type != "BuildingRoom":
            return "bldg:IntBuildingInstallation", "bldg:interiorBuildingInstallation"
        return element, holder

    def _is_interior(self, n: int) -> bool:
        polygons = self._model.polygons
        own = polygons.kind[polygons.part == n] if polygons.part is not None else np.zeros(0)
        return len(own) > 0 and bool((own == SurfaceKind.INTERIOR).all())


def srs_name(crs: str | None) -> str | None:
    """Returns the name of a reference system as CityGML files have it, or None where it has no code.

    Coordinates are written east first. Names that promise the order of the authority stand only where that
    is east first too; else the short form, which promises nothing.

    Example:
        >>> srs_name("EPSG:25832+7837")
        'urn:ogc:def:crs,crs:EPSG::25832,crs:EPSG::7837'
        >>> srs_name("EPSG:31468")
        'EPSG:31468'
    """
    if crs is None:
        return None
    codes = epsg_codes(crs)
    if not codes:
        return None
    from pyproj import CRS

    is_east_first = CRS.from_epsg(codes[0]).axis_info[0].direction.lower() == "east"
    if not is_east_first:
        return f"EPSG:{'+'.join(map(str, codes))}"
    if len(codes) == 1:
        return f"http://www.opengis.net/def/crs/EPSG/0/{codes[0]}"
    return "urn:ogc:def:crs," + ",".join(f"crs:EPSG::{code}" for code in codes)


def _xml_ids(names: Iterable[str], taken: set[str], notes: Counter[str]) -> list[str]:
    """Returns ids that XML allows, none of them twice; ``taken`` grows."""
    result: list[str] = []
    numbers: Counter[str] = Counter()  # how often each was taken: the search goes on where it ended
    for name in names:
        plain = own = name if _NAME.fullmatch(name) else f"id_{_NOT_IN_NAMES.sub('_', name)}"
        while own in taken:
            numbers[plain] += 1
            own = f"{plain}_{numbers[plain] + 1}"
        if own != name:
            notes["id that XML does not allow, written otherwise"] += 1
        taken.add(own)
        result.append(own)
    return result
