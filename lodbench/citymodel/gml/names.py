"""The vocabulary of CityGML: which element names matter, and what they mean."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from itertools import chain
from typing import Any, cast

from lxml import etree

from lodbench.citymodel.attributes import NAMES, overall_height, take_measured_height
from lodbench.citymodel.gml.xml import Element, local_name, metres_of, namespace_of, numbers_in, value_of
from lodbench.citymodel.model import SurfaceKind

GML_IDS = ("{http://www.opengis.net/gml}id", "{http://www.opengis.net/gml/3.2}id")

MEMBERS = ("cityObjectMember", "featureMember", "featureMembers", "member", "appearanceMember")
# City objects inside others, by their names in CityJSON.
NESTED_TYPES = {
    name: name
    for name in (
        "BuildingPart", "BuildingInstallation", "BuildingConstructiveElement", "BuildingRoom",
        "BuildingFurniture", "BuildingUnit", "BridgePart", "BridgeInstallation", "BridgeConstructiveElement",
        "BridgeRoom", "BridgeFurniture", "TunnelPart", "TunnelInstallation", "TunnelConstructiveElement",
        "TunnelFurniture",
    )
} | {
    "IntBuildingInstallation": "BuildingInstallation", "Room": "BuildingRoom", "Storey": "BuildingStorey",
    "BridgeConstructionElement": "BridgeConstructiveElement", "IntBridgeInstallation": "BridgeInstallation",
    "IntTunnelInstallation": "TunnelInstallation", "HollowSpace": "TunnelHollowSpace",
}  # fmt: skip
# Parts of the inside of a building, drawn where it has no surfaces besides theirs.
STOREYS = frozenset({"Storey", "BuildingUnit", "BuildingStorey"})
# Properties that hold surfaces and objects, or refer to them elsewhere.
OBJECT_PROPERTIES = frozenset(
    {
        "boundedBy", "boundary", "consistsOfBuildingPart", "buildingPart", "outerBuildingInstallation",
        "buildingInstallation", "interiorBuildingInstallation", "interiorRoom", "buildingRoom", "opening",
        "buildingSubdivision", "buildingConstructiveElement", "interiorFurniture", "roomInstallation",
        "buildingFurniture", "consistsOfBridgePart", "bridgePart", "outerBridgeInstallation",
        "outerBridgeConstruction", "bridgeInstallation", "bridgeConstructiveElement",
        "interiorBridgeInstallation", "interiorBridgeRoom", "bridgeRoom", "bridgeFurniture",
        "consistsOfTunnelPart", "tunnelPart", "outerTunnelInstallation", "tunnelInstallation",
        "tunnelConstructiveElement", "interiorTunnelInstallation", "interiorHollowSpace", "hollowSpace",
        "tunnelFurniture", "trafficArea", "auxiliaryTrafficArea",
    }
)  # fmt: skip
_NESTED = tuple("{*}" + name for name in NESTED_TYPES)
_NESTED_IN_BUILDINGS = tuple(name for name in _NESTED if "Bridge" not in name and "Tunnel" not in name)

# Exact names only: PLATEAU's `uro:lod1HeightType` and the like begin with "lod" and hold no geometry.
_PROPERTY_SUFFIXES = ("Solid", "MultiSurface", "Geometry", "ImplicitRepresentation")
_PROPERTY_LODS = {f"lod{lod}{suffix}": str(lod) for lod in range(5) for suffix in _PROPERTY_SUFFIXES}
ROOF_EDGE = "lod0RoofEdge"
_PROPERTY_LODS |= {"lod0FootPrint": "0", ROOF_EDGE: "0"}
GEOMETRY_PROPERTIES = tuple("{*}" + name for name in _PROPERTY_LODS)
_MULTI_SOLIDS = {f"lod{lod}MultiSolid": str(lod) for lod in range(1, 5)}  # of plants
_SURFACES = {f"lod{lod}Surface": str(lod) for lod in range(2, 5)}  # of water
_PROPERTY_LODS |= _MULTI_SOLIDS | _SURFACES
# Terrain says its level beside its surface, not in the name of it.
RELIEF_SURFACE = "tin"
# All that is looked for below an object, in one pass: every name more costs at every element.
_NOT_OF_BUILDINGS = {f"{{*}}lod0{name}" for name in ("Solid", "Geometry", "ImplicitRepresentation")}
WALKED_IN_BUILDINGS = (
    *(name for name in GEOMETRY_PROPERTIES if name not in _NOT_OF_BUILDINGS),
    *_NESTED_IN_BUILDINGS,
)
WALKED = (
    *GEOMETRY_PROPERTIES,
    *_NESTED,
    *("{*}" + name for name in (RELIEF_SURFACE, *_MULTI_SOLIDS, *_SURFACES)),
)

BOUNDARY = "boundedBy"
_WALKED_NAMES = frozenset(name.removeprefix("{*}") for name in WALKED)


class WalkedTags(dict[str, bool]):
    """Full tag to whether it is among ``WALKED``, filled as tags are met."""

    def __missing__(self, tag: str) -> bool:
        self[tag] = is_walked = local_name(tag) in _WALKED_NAMES
        return is_walked


_KINDS = {
    "WallSurface": SurfaceKind.WALL,
    "RoofSurface": SurfaceKind.ROOF,
    "GroundSurface": SurfaceKind.GROUND,
    "ClosureSurface": SurfaceKind.CLOSURE,
    "OuterFloorSurface": SurfaceKind.FLOOR,
    "OuterCeilingSurface": SurfaceKind.CEILING,
    "Window": SurfaceKind.OPENING,
    "Door": SurfaceKind.DOOR,
    "WindowSurface": SurfaceKind.OPENING,
    "DoorSurface": SurfaceKind.DOOR,
    "BuildingInstallation": SurfaceKind.INSTALLATION,
    "BuildingConstructiveElement": SurfaceKind.INSTALLATION,
    "BridgeInstallation": SurfaceKind.INSTALLATION,
    "BridgeConstructionElement": SurfaceKind.INSTALLATION,
    "BridgeConstructiveElement": SurfaceKind.INSTALLATION,
    "TunnelInstallation": SurfaceKind.INSTALLATION,
    "TunnelConstructiveElement": SurfaceKind.INSTALLATION,
    "OtherConstruction": SurfaceKind.INSTALLATION,
}
SURFACE_KINDS = {name: int(kind) for name, kind in _KINDS.items()}  # they are compared for every surface
# Surfaces that only ever bound the outside: no look at what is around them is needed.
OUTER_NAMES = frozenset(
    {"WallSurface", "RoofSurface", "GroundSurface", "OuterFloorSurface", "OuterCeilingSurface"}
)
INTERIOR_NAMES = frozenset(
    {
        "Room", "BuildingRoom", "IntBuildingInstallation", "BuildingFurniture", "InteriorWallSurface",
        "CeilingSurface", "FloorSurface", "IntBridgeInstallation", "BridgeRoom", "BridgeFurniture",
        "IntTunnelInstallation", "HollowSpace", "TunnelHollowSpace", "TunnelFurniture",
    }
)  # fmt: skip


# What the geometry walk does at an element. Plain integers: the walk compares them a million times,
# and members of an IntEnum cost five times as much to compare.
POLYGON = 0  # a new polygon begins
RING = 1  # a new ring begins
NUMBERS = 2  # posList or pos: adds to the ring
TUPLES = 3  # GML2 coordinates: adds to the ring
REFERENCE = 4  # may refer to geometry elsewhere
ORIENTABLE = 5  # may turn its polygons round
CURVE = 6  # numbers below belong to no surface, unless inside a ring
NOTHING = 7  # passes by

_NODES = {
    "Polygon": POLYGON,
    "PolygonPatch": POLYGON,
    "Triangle": POLYGON,
    "Rectangle": POLYGON,
    "exterior": RING,
    "interior": RING,
    "outerBoundaryIs": RING,
    "innerBoundaryIs": RING,
    "posList": NUMBERS,
    "pos": NUMBERS,
    "coordinates": TUPLES,
    "surfaceMember": REFERENCE,
    "geometryMember": REFERENCE,
    "solidMember": REFERENCE,
    "baseSurface": REFERENCE,
    "OrientableSurface": ORIENTABLE,
    "LineString": CURVE,
    "Point": CURVE,
    "controlPoint": CURVE,  # of a Tin, behind its triangles
    "Curve": CURVE,
    "LineStringSegment": CURVE,
}
POLYGONS = tuple("{*}" + name for name, node in _NODES.items() if node == POLYGON)


class NodeTable(dict[str, int]):
    """Full tag to what the walk does there, filled as tags are met, so that a known tag costs one look-up."""

    def __missing__(self, tag: str) -> int:
        self[tag] = node = _NODES.get(local_name(tag), NOTHING)
        return node


@lru_cache(maxsize=256)
def property_lod(tag: str) -> str | None:
    """Returns the level of detail of a geometry property of CityGML, or None for anything else.

    Example:
        >>> property_lod("{http://www.opengis.net/citygml/building/2.0}lod2MultiSurface")
        '2'
        >>> property_lod("{https://www.geospatial.jp/iur/uro/3.1}lod1Solid") is None
        True
    """
    if "opengis.net/citygml" not in namespace_of(tag):
        return None
    return _PROPERTY_LODS.get(local_name(tag))


@lru_cache(maxsize=256)
def is_citygml(tag: str) -> bool:
    """Returns whether a tag is of CityGML itself, of any version, and of no extension."""
    return "opengis.net/citygml" in namespace_of(tag)


@lru_cache(maxsize=1024)
def is_extension(tag: str) -> bool:
    """Returns whether a tag is a property by which an extension (ADE) hangs on what is CityGML's.

    Example:
        >>> is_extension("{http://www.sig3d.org/citygml/2.0/energy/1.0}thermalZone")
        True
        >>> is_extension("{http://www.opengis.net/citygml/building/2.0}boundedBy")
        False
    """
    name, namespace = local_name(tag), namespace_of(tag)
    if "opengis.net/citygml" in namespace:
        return name.startswith("adeOf")
    # Properties begin with a small letter, objects with a large one.
    return name[:1].islower() and "opengis.net/gml" not in namespace


@lru_cache(maxsize=256)
def is_building_tag(tag: str) -> bool:
    """Returns whether a tag is the ``Building`` of any version of CityGML."""
    return local_name(tag) == "Building" and is_citygml(tag)


# Days, heights and roofs of objects; where their envelopes are.
HEIGHTS = ("measuredHeight", "storeyHeightsAboveGround", "storeyHeightsBelowGround")
_NOTED = frozenset({*NAMES, "height", *HEIGHTS, "roofType", "stringAttribute", "boundedBy"})
# Plain integers: looking a member up in its class costs more than the rest of a step.
_UNKNOWN, _ROOF, _INTERIOR = map(int, (SurfaceKind.UNKNOWN, SurfaceKind.ROOF, SurfaceKind.INTERIOR))


def plain_numbers(element: Element) -> str:
    """Returns the numbers of a GML2 ``coordinates`` element separated by blanks.

    The element may name its own separators: ``cs`` between coordinates, ``ts`` between tuples,
    ``decimal`` as the decimal sign.
    """
    text = element.text or ""
    decimal = element.get("decimal", ".")
    for separator in (element.get("cs", ","), element.get("ts", " ")):
        if separator.strip() and separator != decimal:
            text = text.replace(separator, " ")
    return text if decimal == "." else text.replace(decimal, ".")


def surface_kind(prop: Element, building: Element) -> int:
    """Returns the ``SurfaceKind`` of a geometry property, from the elements around it."""
    node = prop.getparent()
    if node is None or node is building:
        return _ROOF if local_name(prop.tag) == ROOF_EDGE else _UNKNOWN
    name = local_name(node.tag)
    if name in OUTER_NAMES:
        return SURFACE_KINDS[name]
    kind = _UNKNOWN
    while node is not None and node is not building:
        name = local_name(node.tag)
        if name in INTERIOR_NAMES:
            return _INTERIOR
        if kind == _UNKNOWN:
            kind = SURFACE_KINDS.get(name, _UNKNOWN)
        node = node.getparent()
    return kind


def is_in_ring(element: Element) -> bool:
    """Returns whether a curve or point belongs to a ring (``curveMember``, ``pointProperty``)."""
    node = element.getparent()
    while node is not None:
        name = local_name(node.tag)
        if name in ("Ring", "LinearRing"):
            return True
        if name in ("MultiGeometry", "MultiCurve", "Polygon"):
            return False
        node = node.getparent()
    return False


def owner_of(prop: Element, building: Element, part_of: dict[Element, int], own: int) -> int:
    """Returns the object a geometry property belongs to: the nearest around it."""
    node = prop.getparent()
    while node is not None and node is not building:
        if node in part_of:
            return part_of[node]
        node = node.getparent()
    return own


def storeys_among(building: Element, part_of: dict[Element, int]) -> set[int]:
    """Returns the numbers of the storeys and units of a building, and of what is in them."""
    storeys: set[int] = set()
    for element, number in part_of.items():  # what is around an object comes before it
        if local_name(element.tag) in STOREYS or owner_of(element, building, part_of, -1) in storeys:
            storeys.add(number)
    return storeys


def relief_lod(surface: Element) -> str:
    """Returns the level of detail of a terrain surface, which stands beside it."""
    relief = surface.getparent()
    return "" if relief is None else (relief.findtext("{*}lod") or "").strip()


def is_another_s(node: Element, building: Element, left_out: set[Element]) -> bool:
    """Tells whether something inside of a building stands in what is left out, or in an extension's property.

    What a property of another namespace holds is no boundary of the building: thermal zones, measured noise.
    Objects of other namespaces in properties of CityGML are, such as a roof of a kind of its own.
    """
    above = node.getparent()
    while above is not None and above is not building:
        if above in left_out or is_extension(above.tag):
            return True
        above = above.getparent()
    return False


def extension_above(node: Element, building: Element) -> Element | None:
    """Returns the outermost property of an extension that something inside of a building stands in."""
    outermost = None
    for above in node.iterancestors():
        if above is building:
            break
        outermost = above if is_extension(above.tag) else outermost
    return outermost


def buildings_inside(element: Element) -> set[Element]:
    """Returns the buildings inside of another (``generalizesTo``), which are read as their own."""
    return {inner for inner in element.iterdescendants("{*}Building") if is_building_tag(inner.tag)}


class _NotedNames(dict[str, str]):
    """Full tag to local name, "" for what is not noted; filled as tags are met."""

    def __missing__(self, tag: str) -> str:
        name = local_name(tag)
        self[tag] = name = name if name in _NOTED else ""
        return name


_noted_names = _NotedNames()


def noted_children(element: Element) -> dict[str, list[Element]]:
    """Returns the children of an object that say what it is, not of what, by their local names."""
    noted: dict[str, list[Element]] = {}
    for child in element:
        name = _noted_names[child.tag]
        if name:
            noted.setdefault(name, []).append(child)
    return noted


def gml_id(element: Element) -> str | None:
    """Returns an element's id, or None."""
    for name in GML_IDS:
        value = element.get(name)
        if value is not None:
            return str(value)
    return None


def envelope_srs(element: Element) -> str | None:
    """Returns the srsName of an element's own ``boundedBy/Envelope``, if it has one."""
    for child in element.iterchildren("{*}boundedBy"):
        for envelope in child.iterchildren("{*}Envelope"):
            name = envelope.get("srsName")
            return None if name is None else str(name).strip()
    return None


def measured_height(noted: Mapping[str, list[Element]]) -> float | None:
    """Returns an object's height above the ground in metres, from its ``noted_children``; or its storeys'."""
    heights: dict[str, Any] = {}
    for name in HEIGHTS:
        for child in noted.get(name, ()):
            metres = metres_of(child)
            if metres is not None:
                heights[name] = [float(word) * metres for word in numbers_in(child)]
    if "height" in noted:
        heights["height"] = value_of(noted["height"][-1], 0)
    if not heights:
        return None
    if "measuredHeight" not in heights:
        take_measured_height(heights)
    return overall_height(heights)


# Of the object itself, of its surfaces and parts, and of their surfaces: a look at all would cost too much,
# and one expression for all three merges what it finds in the square of their number.
_LINKED = [
    etree.XPath(f"{path}[@xlink:href]", namespaces={"xlink": "http://www.w3.org/1999/xlink"})
    for path in ("*", "*/*/*", "*/*/*/*/*")
]


def linked_objects(element: Element) -> list[Element]:
    """Returns the properties of an object and of its parts that refer to a surface or part elsewhere."""
    linked = chain.from_iterable(cast("list[Element]", find(element)) for find in _LINKED)
    return [prop for prop in linked if len(prop) == 0 and local_name(prop.tag) in OBJECT_PROPERTIES]
