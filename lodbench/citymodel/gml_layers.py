"""City objects that are no buildings as CityGML: bridges and tunnels as buildings are, others by their shape.

Bridges and tunnels have all that buildings have, under names that differ by the word and the prefix alone.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

from lodbench.citymodel.gml_dialect import Dialect, tag
from lodbench.citymodel.gml_geometry import GeometryXml
from lodbench.citymodel.gml_levels import LevelShapes
from lodbench.citymodel.gml_properties import Property

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
