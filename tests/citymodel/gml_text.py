"""Small CityGML documents for the tests: boxes with walls, in the shapes real files come in."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.citymodel import read_city_model
from lodbench.citymodel.model import CityModel

Point = tuple[float, float, float]
Ring = Sequence[Point]

_HEAD = (
    '<?xml version="1.0" encoding="{encoding}"?>\n'
    '<core:CityModel xmlns:core="http://www.opengis.net/citygml/{version}" '
    'xmlns:bldg="http://www.opengis.net/citygml/building/{version}" '
    'xmlns:gml="http://www.opengis.net/gml{gml}" xmlns:xlink="http://www.w3.org/1999/xlink" '
    'xmlns:uro="https://www.geospatial.jp/iur/uro/3.1">\n{envelope}'
)


def city(
    members: str, *, version: str = "2.0", srs: str | None = "EPSG:25832", encoding: str = "UTF-8"
) -> str:
    """Wraps members in a city model."""
    envelope = (
        f'<gml:boundedBy><gml:Envelope srsName="{srs}" srsDimension="3">'
        "<gml:lowerCorner>0 0 0</gml:lowerCorner><gml:upperCorner>1 1 1</gml:upperCorner>"
        "</gml:Envelope></gml:boundedBy>\n"
        if srs
        else ""
    )
    gml = "/3.2" if version == "3.0" else ""
    head = _HEAD.format(version=version, gml=gml, envelope=envelope, encoding=encoding)
    return head + members + "</core:CityModel>\n"


def member(content: str, building_id: str = "b1") -> str:
    """Wraps properties in a building and a member."""
    return (
        f'<core:cityObjectMember><bldg:Building gml:id="{building_id}">{content}</bldg:Building>'
        "</core:cityObjectMember>\n"
    )


def pos_list(ring: Ring) -> str:
    return (
        "<gml:posList>" + " ".join(f"{c!r}" for point in [*ring, ring[0]] for c in point) + "</gml:posList>"
    )


def polygon(outline: Ring | str, holes: Iterable[Ring] = (), gml_id: str = "") -> str:
    """A polygon; an outline given as a string stands as it is inside the LinearRing."""
    text = outline if isinstance(outline, str) else pos_list(outline)
    identity = f' gml:id="{gml_id}"' if gml_id else ""
    inner = "".join(
        f"<gml:interior><gml:LinearRing>{pos_list(hole)}</gml:LinearRing></gml:interior>" for hole in holes
    )
    return (
        f"<gml:Polygon{identity}><gml:exterior><gml:LinearRing>{text}</gml:LinearRing></gml:exterior>"
        f"{inner}</gml:Polygon>"
    )


def surface_members(polygons: Iterable[str]) -> str:
    return "".join(f"<gml:surfaceMember>{text}</gml:surfaceMember>" for text in polygons)


def solid(members: str, lod: int = 1) -> str:
    return (
        f"<bldg:lod{lod}Solid><gml:Solid><gml:exterior><gml:CompositeSurface>{members}"
        f"</gml:CompositeSurface></gml:exterior></gml:Solid></bldg:lod{lod}Solid>"
    )


def solid_of(rings: Iterable[Ring], lod: int = 1) -> str:
    """A solid of plain faces."""
    return solid(surface_members(map(polygon, rings)), lod)


def multi_surface(members: str, lod: int = 2, attributes: str = "") -> str:
    return (
        f"<bldg:lod{lod}MultiSurface><gml:MultiSurface{attributes}>{members}</gml:MultiSurface>"
        f"</bldg:lod{lod}MultiSurface>"
    )


def bounded_by(kind: str, content: str) -> str:
    return f"<bldg:boundedBy><bldg:{kind}>{content}</bldg:{kind}></bldg:boundedBy>"


def link(href: str) -> str:
    return f'<gml:surfaceMember xlink:href="{href}"/>'


def box_rings(
    x: float = 500000.0, y: float = 5600000.0, z: float = 50.0, size: float = 10.0, height: float = 6.0
) -> list[Ring]:
    """The six faces of a box, outward."""
    a, b, c, d = (x, y, z), (x + size, y, z), (x + size, y + size, z), (x, y + size, z)
    e, f, g, h = ((p[0], p[1], z + height) for p in (a, b, c, d))
    return [[a, d, c, b], [e, f, g, h], [a, b, f, e], [b, c, g, f], [c, d, h, g], [d, a, e, h]]


def box_area(size: float = 10.0, height: float = 6.0) -> float:
    return 2 * size * size + 4 * size * height


def box_city(**options: float) -> str:
    """One LoD1 box as a solid."""
    return city(member(solid(surface_members(polygon(ring) for ring in box_rings(**options)))))


def write(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def model_of(tmp_path: Path, text: str | bytes, **options: object) -> CityModel:
    """Reads a CityGML text."""
    return read_city_model(write(tmp_path / "city.gml", text), **options)  # type: ignore[arg-type]


def codes(model: CityModel) -> dict[str, int]:
    """Counts findings by code."""
    return {key.split()[0]: count for key, count in model.findings.counts().items()}


def squares(path: Path, count: int = 40, driver: str = "ESRI Shapefile", **options: Any) -> Path:
    """Writes footprints of 10 m with heights; ``options`` are those of ``pyogrio.raw.write``."""
    import pyogrio
    import shapely

    x = 500000.0 + 20.0 * np.arange(count)
    boxes = shapely.to_wkb(shapely.box(x, 5600000.0, x + 10.0, 5600010.0))
    pyogrio.raw.write(
        str(path),
        boxes,
        [np.full(count, 6.0), np.array([f"b{i}" for i in range(count)], object)],
        fields=["height", "ID"],
        geometry_type="Polygon",
        crs="EPSG:25832",
        driver=driver,
        **options,
    )
    return path
