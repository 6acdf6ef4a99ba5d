"""CityGML 2.0 and 3.0 as they are written: namespaces, names, and the order that their schemas ask for."""

from __future__ import annotations

from dataclasses import dataclass

from lodbench.citymodel.model import SurfaceKind

Rank = dict[str, int]

_SURFACES = {
    SurfaceKind.GROUND: "GroundSurface",
    SurfaceKind.WALL: "WallSurface",
    SurfaceKind.ROOF: "RoofSurface",
    SurfaceKind.CLOSURE: "ClosureSurface",
    SurfaceKind.FLOOR: "OuterFloorSurface",
    SurfaceKind.CEILING: "OuterCeilingSurface",
    SurfaceKind.INTERIOR: "InteriorWallSurface",
}
_OBJECT = (
    "gml:description",
    "gml:name",
    "core:creationDate",
    "core:terminationDate",
    "core:externalReference",
)


@dataclass(frozen=True, slots=True)
class Dialect:
    """A version of CityGML.

    Attributes:
        version: ``"2.0"`` or ``"3.0"``.
        namespaces: URI by prefix.
        surfaces: Element of each kind of boundary surface.
        openings: Element of windows and of doors.
        boundary, opening: Properties that hold them.
        levels: Whole levels of detail that there are.
        surface_levels: Levels at which boundary surfaces have geometry.
        loose_levels: Levels at which an object has surfaces of its own that bound nothing.
        date_form: How a day is written where it is one.
        rank: Place of each property among the children of any object.
    """

    version: str
    namespaces: dict[str, str]
    surfaces: dict[int, str]
    openings: dict[int, str]
    boundary: str
    opening: str
    levels: tuple[int, ...]
    surface_levels: tuple[int, ...]
    loose_levels: tuple[int, ...]
    date_form: str
    rank: Rank


def _ranks(*names: str) -> Rank:
    return {name: place for place, name in enumerate(names)}


def _namespaces(version: str, gml: str, address: str) -> dict[str, str]:
    modules = {"bldg": "building", "gen": "generics", "app": "appearance"}
    if version == "3.0":
        modules["con"] = "construction"
    return {
        "core": f"http://www.opengis.net/citygml/{version}",
        **{prefix: f"http://www.opengis.net/citygml/{name}/{version}" for prefix, name in modules.items()},
        "gml": gml,
        "xAL": address,
        "xlink": "http://www.w3.org/1999/xlink",
    }


_FACTS = ("bldg:class", "bldg:function", "bldg:usage")
_STOREYS = (
    "bldg:storeysAboveGround", "bldg:storeysBelowGround", "bldg:storeyHeightsAboveGround",
    "bldg:storeyHeightsBelowGround",
)  # fmt: skip

CITYGML_2 = Dialect(
    version="2.0",
    namespaces=_namespaces("2.0", "http://www.opengis.net/gml", "urn:oasis:names:tc:ciq:xsdschema:xAL:2.0"),
    surfaces={kind: f"bldg:{name}" for kind, name in _SURFACES.items()},
    openings={SurfaceKind.OPENING: "bldg:Window", SurfaceKind.DOOR: "bldg:Door"},
    boundary="bldg:boundedBy",
    opening="bldg:opening",
    levels=(0, 1, 2, 3, 4),
    surface_levels=(2, 3, 4),
    loose_levels=(0, 1, 2, 3, 4),
    date_form="{}",
    rank=_ranks(
        *_OBJECT, "core:relativeToTerrain", "core:relativeToWater", "gen:attribute",
        *_FACTS, "bldg:yearOfConstruction", "bldg:yearOfDemolition", "bldg:roofType",
        "bldg:measuredHeight", *_STOREYS, "bldg:lod0FootPrint", "bldg:lod0RoofEdge",
        "bldg:lod1Solid", "bldg:lod1MultiSurface",
        "bldg:lod2Solid", "bldg:lod2MultiSurface", "bldg:lod2Geometry", "bldg:lod3Geometry",
        "bldg:lod4Geometry", "bldg:outerBuildingInstallation", "bldg:interiorBuildingInstallation",
        "room:lod4Solid", "room:lod4MultiSurface",
        "bldg:boundedBy", "bldg:lod3Solid", "bldg:lod3MultiSurface", "bldg:lod4Solid",
        "bldg:lod4MultiSurface", "bldg:opening", "bldg:interiorFurniture", "bldg:roomInstallation",
        "bldg:interiorRoom", "bldg:consistsOfBuildingPart", "bldg:address",
    ),
)  # fmt: skip
CITYGML_3 = Dialect(
    version="3.0",
    namespaces=_namespaces("3.0", "http://www.opengis.net/gml/3.2", "urn:oasis:names:tc:ciq:xal:3"),
    surfaces={
        kind: f"{'core' if kind == SurfaceKind.CLOSURE else 'con'}:{name}" for kind, name in _SURFACES.items()
    },
    openings={SurfaceKind.OPENING: "con:WindowSurface", SurfaceKind.DOOR: "con:DoorSurface"},
    boundary="core:boundary",
    opening="con:fillingSurface",
    levels=(0, 1, 2, 3),
    surface_levels=(0, 1, 2, 3),
    loose_levels=(0, 2, 3),
    date_form="{}T00:00:00",
    rank=_ranks(
        *_OBJECT, "core:relativeToTerrain", "core:relativeToWater", "core:genericAttribute",
        "core:boundary", "core:lod0MultiSurface", "core:lod1MultiSurface", "core:lod1Solid", "core:lod2Solid",
        "core:lod2MultiSurface", "core:lod3Solid", "core:lod3MultiSurface", "con:fillingSurface",
        "con:dateOfConstruction", "con:dateOfDemolition", "con:height", *_FACTS, "bldg:roofType", *_STOREYS,
        "bldg:buildingConstructiveElement", "bldg:buildingInstallation", "bldg:buildingRoom",
        "bldg:buildingFurniture", "bldg:buildingSubdivision", "bldg:address", "bldg:buildingPart",
    ),
)  # fmt: skip


def tag(name: str, content: str = "", **attributes: str) -> str:
    """Returns an element; ``gml__id`` becomes ``gml:id``. Attributes and content are XML already.

    Example:
        >>> tag("gml:name", "a &amp; b"), tag("gml:surfaceMember", xlink__href="#p1")
        ('<gml:name>a &amp; b</gml:name>', '<gml:surfaceMember xlink:href="#p1"/>')
    """
    told = "".join(f' {key.replace("__", ":")}="{value}"' for key, value in attributes.items())
    return f"<{name}{told}>{content}</{name}>" if content else f"<{name}{told}/>"
