"""The town as CityGML 2.0 files in a German national grid; byte for byte from the seed.

Two files, as real cities deliver them: one with LoD1 and LoD2, and one, ten times as large, with LoD3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import SurfaceKind
from lodbench.synthesis.town.building import Building
from lodbench.synthesis.town.solid import Face, Solid
from lodbench.synthesis.town.town import TOWN_VERSION, Town

Points = NDArray[np.float64]

CRS_NAME = "urn:ogc:def:crs,crs::EPSG::25832,crs::EPSG::7837"
# Where the made-up town lies in UTM zone 32: easting, northing and height of its local origin, metres.
ORIGIN_M = np.array([567_000.0, 5_539_000.0, 0.0])

_NAMESPACES = {
    "xmlns": "http://www.opengis.net/citygml/2.0",
    "xmlns:bldg": "http://www.opengis.net/citygml/building/2.0",
    "xmlns:gen": "http://www.opengis.net/citygml/generics/2.0",
    "xmlns:gml": "http://www.opengis.net/gml",
    "xmlns:xlink": "http://www.w3.org/1999/xlink",
    "xmlns:xsi": "http://www.w3.org/2001/XMLSchema-instance",
    "xsi:schemaLocation": (
        "http://www.opengis.net/citygml/building/2.0 "
        "http://schemas.opengis.net/citygml/building/2.0/building.xsd "
        "http://www.opengis.net/citygml/generics/2.0 "
        "http://schemas.opengis.net/citygml/generics/2.0/generics.xsd"
    ),
}
# Codes of the German surveying authorities' LoD2 profile for bldg:function.
_FUNCTIONS = {
    "residential": "31001_1000",
    "garage": "31001_2463",
    "commercial": "31001_2000",
    "industrial": "31001_2100",
    "public": "31001_3000",
    "church": "31001_3041",
}
_BOUNDARIES = {
    SurfaceKind.GROUND: "GroundSurface",
    SurfaceKind.WALL: "WallSurface",
    SurfaceKind.ROOF: "RoofSurface",
    SurfaceKind.FLOOR: "OuterCeilingSurface",
}


_DESCRIPTION = (
    "A made-up town; it lies nowhere. LoD1 boxes end about halfway between eaves and ridge, their outlines "
    "snap to half a metre and leave out annexes and small courtyards. LoD3 adds eaves, dormers, windows, "
    "doors, chimneys and balconies, and was surveyed later: some buildings are new, gone or higher."
)


def citygml_text(town: Town) -> str:
    """Returns the file with LoD1 and LoD2: coordinates in `CRS_NAME`, metres with three decimals."""
    return _city_text(town, town.mapped, _coarse_geometry)


def fine_citygml_text(town: Town) -> str:
    """Returns the file with LoD3, likewise."""
    return _city_text(town, town.standing, _fine_geometry)


def _city_text(
    town: Town, buildings: Sequence[Building], geometry: Callable[[Building], Iterator[str]]
) -> str:
    name = f"lodbench demo town, version {TOWN_VERSION}, look {town.look.name}, seed {town.seed}"
    # One envelope for both files, so that readers give them one frame.
    points = np.concatenate([solid.points for b in town.buildings for solid in (b.lod1, b.lod2, b.lod3)])
    lines = [*document_start(_NAMESPACES, name, _DESCRIPTION), *envelope(points)]
    for building in buildings:
        lines.append("<cityObjectMember>")
        lines += _building(building, geometry)
        lines.append("</cityObjectMember>")
    lines.append("</CityModel>\n")
    return "\n".join(lines)


def document_start(namespaces: dict[str, str], name: str, description: str) -> Iterator[str]:
    """Yields the lines of a CityGML file up to its bounds."""
    yield '<?xml version="1.0" encoding="UTF-8"?>'
    attributes = " ".join(f"{prefix}={quoteattr(uri)}" for prefix, uri in namespaces.items())
    yield f"<CityModel {attributes}>"
    yield f"<gml:description>{escape(description)}</gml:description>"
    yield f"<gml:name>{escape(name)}</gml:name>"


def envelope(points: Points) -> Iterator[str]:
    """Yields the bounds of points, (N, 3) local metres, with the reference system of the file."""
    yield "<gml:boundedBy>"
    yield f'<gml:Envelope srsName={quoteattr(CRS_NAME)} srsDimension="3">'
    yield f"<gml:lowerCorner>{coordinates(points.min(axis=0)[None])}</gml:lowerCorner>"
    yield f"<gml:upperCorner>{coordinates(points.max(axis=0)[None])}</gml:upperCorner>"
    yield "</gml:Envelope>"
    yield "</gml:boundedBy>"


def _building(building: Building, geometry: Callable[[Building], Iterator[str]]) -> Iterator[str]:
    """Yields one building: its attributes, then its geometry."""
    plan = building.plan
    heights = building.lod2.points[:, 2]
    yield f"<bldg:Building gml:id={quoteattr(building.identifier)}>"
    yield '<gen:stringAttribute name="district">'
    yield f"<gen:value>{escape(plan.district)}</gen:value></gen:stringAttribute>"
    yield f"<bldg:function>{_FUNCTIONS[plan.function]}</bldg:function>"
    yield f"<bldg:roofType>{plan.roof.shape.code}</bldg:roofType>"
    yield f'<bldg:measuredHeight uom="m">{heights.max() - heights.min():.2f}</bldg:measuredHeight>'
    yield from geometry(building)
    yield "</bldg:Building>"


def _coarse_geometry(building: Building) -> Iterator[str]:
    """Yields the LoD1 box, the LoD2 solid, and the surfaces it refers to."""
    name = building.identifier
    yield "<bldg:lod1Solid>"
    yield from _solid(f"{name}_lod1", _inline_members(building.lod1, f"{name}_lod1"))
    yield "</bldg:lod1Solid>"
    yield "<bldg:lod2Solid>"
    yield from _solid(f"{name}_lod2", _links(building.lod2, f"{name}_lod2"))
    yield "</bldg:lod2Solid>"
    for k in range(len(building.lod2.faces)):
        yield from _boundary(building.lod2, k, f"{name}_lod2", "lod2MultiSurface", ())


def _fine_geometry(building: Building) -> Iterator[str]:
    """Yields chimneys and balconies, surfaces with their openings, and the LoD3 solid of both."""
    name, solid = f"{building.identifier}_lod3", building.lod3
    for k, installation in enumerate(building.installations):
        part = f"{building.identifier}_i{k}"
        yield "<bldg:outerBuildingInstallation>"
        yield f'<bldg:BuildingInstallation gml:id="{part}"><bldg:lod3Geometry>'
        yield from _solid(f"{part}_lod3", _inline_members(installation, f"{part}_lod3"))
        yield "</bldg:lod3Geometry></bldg:BuildingInstallation></bldg:outerBuildingInstallation>"
    openings: dict[int, list[int]] = {}
    for k, face in enumerate(solid.faces):
        if face.host is not None:
            openings.setdefault(face.host, []).append(k)
    for k, face in enumerate(solid.faces):
        if face.host is None:
            yield from _boundary(solid, k, name, "lod3MultiSurface", openings.get(k, ()))
    yield "<bldg:lod3Solid>"
    yield from _solid(name, _links(solid, name))
    yield "</bldg:lod3Solid>"


def _links(solid: Solid, identifier: str) -> Iterator[str]:
    return (f'<gml:surfaceMember xlink:href="#{identifier}_p{k}"/>' for k in range(len(solid.faces)))


def _solid(identifier: str, members: Iterator[str]) -> Iterator[str]:
    yield f'<gml:Solid gml:id="{identifier}"><gml:exterior><gml:CompositeSurface>'
    yield from members
    yield "</gml:CompositeSurface></gml:exterior></gml:Solid>"


def _inline_members(solid: Solid, identifier: str) -> Iterator[str]:
    for k, face in enumerate(solid.faces):
        yield "<gml:surfaceMember>"
        yield from _polygon(solid, face, f"{identifier}_p{k}")
        yield "</gml:surfaceMember>"


def _boundary(
    solid: Solid, number: int, identifier: str, role: str, openings: Iterable[int]
) -> Iterator[str]:
    """Yields one thematic surface with its polygon and its openings', which the solid refers to."""
    element = _BOUNDARIES[solid.faces[number].kind]
    yield f'<bldg:boundedBy><bldg:{element} gml:id="{identifier}_s{number}">'
    yield from _multi_surface(solid, number, identifier, role)
    for opening in openings:
        name = "Door" if solid.faces[opening].is_door else "Window"
        yield f'<bldg:opening><bldg:{name} gml:id="{identifier}_o{opening}">'
        yield from _multi_surface(solid, opening, identifier, role)
        yield f"</bldg:{name}></bldg:opening>"
    yield f"</bldg:{element}></bldg:boundedBy>"


def _multi_surface(solid: Solid, number: int, identifier: str, role: str) -> Iterator[str]:
    yield f"<bldg:{role}><gml:MultiSurface><gml:surfaceMember>"
    yield from _polygon(solid, solid.faces[number], f"{identifier}_p{number}")
    yield f"</gml:surfaceMember></gml:MultiSurface></bldg:{role}>"


def _polygon(solid: Solid, face: Face, identifier: str) -> Iterator[str]:
    yield f'<gml:Polygon gml:id="{identifier}">'
    for k, ring in enumerate(face.rings):
        role = "interior" if k else "exterior"
        # GML repeats the first point at the end of a ring.
        text = coordinates(solid.points[[*ring, ring[0]]])
        yield f'<gml:{role}><gml:LinearRing><gml:posList srsDimension="3">{text}</gml:posList>'
        yield f"</gml:LinearRing></gml:{role}>"
    yield "</gml:Polygon>"


def coordinates(points: Points) -> str:
    """Returns points, (N, 3) local metres, as absolute coordinates.

    Whole millimetres, or tenths where the points need them.
    """
    fine = np.round(points, 4)
    decimals = 3 if (fine == np.round(points, 3)).all() else 4
    return " ".join(f"{value:.{decimals}f}" for value in (fine + ORIGIN_M).ravel().tolist())
