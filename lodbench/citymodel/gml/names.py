"""The vocabulary of CityGML: which element names matter, and what they mean."""

from __future__ import annotations

from functools import lru_cache

from lodbench.citymodel.gml.xml import local_name, namespace_of
from lodbench.citymodel.model import SurfaceKind

XLINK_HREF = "{http://www.w3.org/1999/xlink}href"
GML_IDS = ("{http://www.opengis.net/gml}id", "{http://www.opengis.net/gml/3.2}id")

MEMBERS = ("cityObjectMember", "featureMember", "featureMembers", "member", "appearanceMember")
# City objects inside others, by their names in CityJSON.
NESTED_TYPES = {
    "BuildingPart": "BuildingPart",
    "BuildingInstallation": "BuildingInstallation",
    "BuildingConstructiveElement": "BuildingConstructiveElement",
    "IntBuildingInstallation": "BuildingInstallation",
    "Room": "BuildingRoom",
    "BuildingRoom": "BuildingRoom",
    "BuildingFurniture": "BuildingFurniture",
    "Storey": "BuildingStorey",
    "BuildingUnit": "BuildingUnit",
    "BridgePart": "BridgePart",
    "BridgeInstallation": "BridgeInstallation",
    "BridgeConstructionElement": "BridgeConstructiveElement",
    "BridgeConstructiveElement": "BridgeConstructiveElement",
    "IntBridgeInstallation": "BridgeInstallation",
    "BridgeRoom": "BridgeRoom",
    "BridgeFurniture": "BridgeFurniture",
    "TunnelPart": "TunnelPart",
    "TunnelInstallation": "TunnelInstallation",
    "TunnelConstructiveElement": "TunnelConstructiveElement",
    "IntTunnelInstallation": "TunnelInstallation",
    "HollowSpace": "TunnelHollowSpace",
    "TunnelFurniture": "TunnelFurniture",
}
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
        "Room",
        "BuildingRoom",
        "IntBuildingInstallation",
        "BuildingFurniture",
        "InteriorWallSurface",
        "CeilingSurface",
        "FloorSurface",
        "IntBridgeInstallation",
        "BridgeRoom",
        "BridgeFurniture",
        "IntTunnelInstallation",
        "HollowSpace",
        "TunnelHollowSpace",
        "TunnelFurniture",
    }
)


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
