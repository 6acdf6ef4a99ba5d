"""The town as a CityGML 2.0 file, LoD1 and LoD2, in a German national grid; byte for byte from the seed."""

from __future__ import annotations

from collections.abc import Iterator
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import SurfaceKind
from lodbench.datasets.demo.building import Building
from lodbench.datasets.demo.solid import Face, Solid
from lodbench.datasets.demo.town import TOWN_VERSION, Town

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
# Codes of the German surveying authorities' LoD2 profile for bldg:function and bldg:roofType.
_FUNCTIONS = {
    "residential": "31001_1000",
    "garage": "31001_2463",
    "commercial": "31001_2000",
    "industrial": "31001_2100",
    "public": "31001_3000",
    "church": "31001_3041",
}
_ROOF_TYPES = {
    "flat": "1000",
    "gabled": "3100",
    "hipped": "3200",
    "mansard": "3400",
    "pavilion": "3500",
    "serrated": "3800",
}
_BOUNDARIES = {
    SurfaceKind.GROUND: "GroundSurface",
    SurfaceKind.WALL: "WallSurface",
    SurfaceKind.ROOF: "RoofSurface",
}


def citygml_text(town: Town) -> str:
    """Returns the file's text: coordinates in `CRS_NAME`, metres with three decimals."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>']
    attributes = " ".join(f"{name}={quoteattr(value)}" for name, value in _NAMESPACES.items())
    lines.append(f"<CityModel {attributes}>")
    name = f"lodbench demo town, version {TOWN_VERSION}, seed {town.seed}"
    lines.append(f"<gml:description>{escape(_DESCRIPTION)}</gml:description>")
    lines.append(f"<gml:name>{escape(name)}</gml:name>")
    lines += _envelope(town)
    for building in town.buildings:
        lines.append("<cityObjectMember>")
        lines += _building(building)
        lines.append("</cityObjectMember>")
    lines.append("</CityModel>\n")
    return "\n".join(lines)


_DESCRIPTION = (
    "A made-up town; it lies nowhere. LoD1 boxes end halfway between eaves and ridge, their outlines "
    "snap to half a metre and leave out annexes and small courtyards."
)


def _envelope(town: Town) -> Iterator[str]:
    points = np.concatenate([solid.points for b in town.buildings for solid in (b.lod1, b.lod2)])
    yield "<gml:boundedBy>"
    yield f'<gml:Envelope srsName={quoteattr(CRS_NAME)} srsDimension="3">'
    yield f"<gml:lowerCorner>{_coordinates(points.min(axis=0)[None])}</gml:lowerCorner>"
    yield f"<gml:upperCorner>{_coordinates(points.max(axis=0)[None])}</gml:upperCorner>"
    yield "</gml:Envelope>"
    yield "</gml:boundedBy>"


def _building(building: Building) -> Iterator[str]:
    """Yields one building: attributes, the LoD1 box, the LoD2 solid, and the surfaces it refers to."""
    plan, name = building.plan, building.identifier
    heights = building.lod2.points[:, 2]
    yield f"<bldg:Building gml:id={quoteattr(name)}>"
    yield '<gen:stringAttribute name="district">'
    yield f"<gen:value>{escape(plan.district)}</gen:value></gen:stringAttribute>"
    yield f"<bldg:function>{_FUNCTIONS[plan.function]}</bldg:function>"
    yield f"<bldg:roofType>{_ROOF_TYPES[plan.roof.name]}</bldg:roofType>"
    yield f'<bldg:measuredHeight uom="m">{heights.max() - heights.min():.2f}</bldg:measuredHeight>'
    yield "<bldg:lod1Solid>"
    yield from _solid(f"{name}_lod1", _inline_members(building.lod1, f"{name}_lod1"))
    yield "</bldg:lod1Solid>"
    yield "<bldg:lod2Solid>"
    links = (f'<gml:surfaceMember xlink:href="#{name}_lod2_p{k}"/>' for k in range(len(building.lod2.faces)))
    yield from _solid(f"{name}_lod2", links)
    yield "</bldg:lod2Solid>"
    for k, face in enumerate(building.lod2.faces):
        yield from _boundary(building.lod2, face, f"{name}_lod2", k)
    yield "</bldg:Building>"


def _solid(identifier: str, members: Iterator[str]) -> Iterator[str]:
    yield f'<gml:Solid gml:id="{identifier}"><gml:exterior><gml:CompositeSurface>'
    yield from members
    yield "</gml:CompositeSurface></gml:exterior></gml:Solid>"


def _inline_members(solid: Solid, identifier: str) -> Iterator[str]:
    for k, face in enumerate(solid.faces):
        yield "<gml:surfaceMember>"
        yield from _polygon(solid, face, f"{identifier}_p{k}")
        yield "</gml:surfaceMember>"


def _boundary(solid: Solid, face: Face, identifier: str, k: int) -> Iterator[str]:
    """Yields one thematic surface with its polygon, which the solid refers to."""
    element = _BOUNDARIES[face.kind]
    yield f'<bldg:boundedBy><bldg:{element} gml:id="{identifier}_s{k}"><bldg:lod2MultiSurface>'
    yield "<gml:MultiSurface><gml:surfaceMember>"
    yield from _polygon(solid, face, f"{identifier}_p{k}")
    yield "</gml:surfaceMember></gml:MultiSurface>"
    yield f"</bldg:lod2MultiSurface></bldg:{element}></bldg:boundedBy>"


def _polygon(solid: Solid, face: Face, identifier: str) -> Iterator[str]:
    yield f'<gml:Polygon gml:id="{identifier}">'
    for k, ring in enumerate(face.rings):
        role = "interior" if k else "exterior"
        # GML repeats the first point at the end of a ring.
        text = _coordinates(solid.points[[*ring, ring[0]]])
        yield f'<gml:{role}><gml:LinearRing><gml:posList srsDimension="3">{text}</gml:posList>'
        yield f"</gml:LinearRing></gml:{role}>"
    yield "</gml:Polygon>"


def _coordinates(points: Points) -> str:
    """Returns points, (N, 3) local metres, as absolute coordinates in whole millimetres."""
    return " ".join(f"{value:.3f}" for value in (np.round(points, 3) + ORIGIN_M).ravel().tolist())
