"""One small town written in every format, so that the readers can be held against each other."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from .gml_text import bounded_by, city, link, member, multi_surface, polygon, solid, surface_members

Point = tuple[float, float, float]
Surface = tuple[str, list[list[Point]]]  # semantic name, rings

_GML3 = (
    '<CityModel xmlns="http://www.opengis.net/citygml/3.0" '
    'xmlns:bldg="http://www.opengis.net/citygml/building/3.0" '
    'xmlns:con="http://www.opengis.net/citygml/construction/3.0" '
    'xmlns:gml="http://www.opengis.net/gml/3.2" xmlns:xlink="http://www.w3.org/1999/xlink">'
    '<gml:boundedBy><gml:Envelope srsName="EPSG:25832"/></gml:boundedBy>'
)


def house(x: float, y: float, width: float, height: float) -> list[Surface]:
    """An L-shaped house with a courtyard hole in its roof and floor, a wall with a window in it."""
    w, h, z = width, height, 101.25
    plan = [(0, 0), (2 * w, 0), (2 * w, w), (w, w), (w, 2 * w), (0, 2 * w)]
    hole = [(0.3 * w, 0.3 * w), (0.6 * w, 0.3 * w), (0.6 * w, 0.6 * w), (0.3 * w, 0.6 * w)]

    def at(points: Sequence[tuple[float, float]], level: float) -> list[Point]:
        return [(x + a, y + b, level) for a, b in points]

    surfaces: list[Surface] = [
        ("GroundSurface", [at(plan[::-1], z), at(hole, z)]),
        ("RoofSurface", [at(plan, z + h), at(hole[::-1], z + h)]),
    ]
    for i in range(len(plan)):
        a, b = plan[i], plan[(i + 1) % len(plan)]
        surfaces.append(("WallSurface", [at([a, b], z) + at([b, a], z + h)]))
    a, b = (x + 0.5, y, z + 1.0), (x + 1.5, y, z + 1.0)
    window = [a, b, (b[0], y, z + 2.0), (a[0], y, z + 2.0)]
    surfaces[2][1].append(window[::-1])
    surfaces.append(("Window", [window]))
    return surfaces


TOWN = [house(500000.0 + 40 * i, 5600000.0 + 30 * i, 4.0 + i, 5.0 + i) for i in range(3)]


def gml_polygon(surface: Surface, gml_id: str = "") -> str:
    return polygon(surface[1][0], surface[1][1:], gml_id)


def citygml(version: str) -> str:
    """CityGML 1.0 or 2.0: surfaces in boundedBy, solids by forward XLinks."""
    members = []
    for n, surfaces in enumerate(TOWN):
        ids = [f"p{n}_{i}" for i in range(len(surfaces))]
        content = solid("".join(link(f"#{i}") for i in ids), 3)
        for gml_id, surface in zip(ids, surfaces, strict=True):
            text = multi_surface(surface_members([gml_polygon(surface, gml_id)]), 3)
            if surface[0] == "Window":
                window = f"<bldg:opening><bldg:Window>{text}</bldg:Window></bldg:opening>"
                content += bounded_by("WallSurface", window)
            else:
                content += bounded_by(surface[0], text)
        members.append(member(content, f"house-{n}"))
    return city("".join(members), version=version)


def citygml3() -> str:
    members = []
    for n, surfaces in enumerate(TOWN):
        content = ""
        for i, surface in enumerate(surfaces):
            text = surface_members([gml_polygon(surface, f"p{n}_{i}")])
            text = f"<lod3MultiSurface><gml:MultiSurface>{text}</gml:MultiSurface></lod3MultiSurface>"
            name = surface[0]
            if name == "Window":
                text = (
                    f"<con:fillingSurface><con:WindowSurface>{text}</con:WindowSurface></con:fillingSurface>"
                )
                name = "WallSurface"
            content += f"<boundary><con:{name}>{text}</con:{name}></boundary>"
        links = "".join(link(f"#p{n}_{i}") for i in range(len(surfaces)))
        content += (
            f"<lod3Solid><gml:Solid><gml:exterior><gml:Shell>{links}</gml:Shell></gml:exterior></gml:Solid>"
            "</lod3Solid>"
        )
        building = f'<bldg:Building gml:id="house-{n}">{content}</bldg:Building>'
        members.append(f"<cityObjectMember>{building}</cityObjectMember>")
    return _GML3 + "".join(members) + "</CityModel>"


def _object(surfaces: list[Surface], vertices: list[Point], kind: str, lod: Any) -> dict[str, Any]:
    numbers: dict[Point, int] = {point: i for i, point in enumerate(vertices)}
    boundaries = []
    for _, rings in surfaces:
        boundaries.append([[numbers.setdefault(point, len(numbers)) for point in ring] for ring in rings])
    vertices[:] = list(numbers)
    names = sorted({name for name, _ in surfaces})
    values = [names.index(name) for name, _ in surfaces]
    is_solid = kind == "Solid"
    return {
        "type": "Building",
        "geometry": [
            {
                "type": kind,
                "lod": lod,
                "boundaries": [boundaries] if is_solid else boundaries,
                "semantics": {
                    "surfaces": [{"type": name} for name in names],
                    "values": [values] if is_solid else values,
                },
            }
        ],
    }


TRANSFORM = {"scale": [0.001, 0.001, 0.001], "translate": [500000.0, 5600000.0, 100.0]}


def _quantised(vertices: list[Point]) -> list[list[int]]:
    shifted = (np.array(vertices) - TRANSFORM["translate"]) / TRANSFORM["scale"]
    return np.rint(shifted).astype(int).tolist()  # type: ignore[no-any-return]


def cityjson(version: str, kind: str = "Solid") -> dict[str, Any]:
    vertices: list[Point] = []
    lod = 3 if version == "1.0" else "3"
    objects = {f"house-{n}": _object(surfaces, vertices, kind, lod) for n, surfaces in enumerate(TOWN)}
    crs = (
        "urn:ogc:def:crs:EPSG::25832" if version == "1.0" else "https://www.opengis.net/def/crs/EPSG/0/25832"
    )
    document: dict[str, Any] = {
        "type": "CityJSON",
        "version": version,
        "metadata": {"referenceSystem": crs},
        "CityObjects": objects,
    }
    if version == "1.0":
        document["vertices"] = [list(point) for point in vertices]
    else:
        document |= {"transform": TRANSFORM, "vertices": _quantised(vertices)}
    return document


def cityjsonseq() -> str:
    header = cityjson("2.0") | {"CityObjects": {}, "vertices": []}
    lines = [json.dumps(header)]
    for n, surfaces in enumerate(TOWN):
        vertices: list[Point] = []
        item = _object(surfaces, vertices, "MultiSurface", "3.0")
        feature = {"type": "CityJSONFeature", "id": f"house-{n}", "CityObjects": {f"house-{n}": item}}
        lines.append(json.dumps(feature | {"vertices": _quantised(vertices)}))
    return "\n".join(lines) + "\n"


def documents() -> dict[str, str]:
    """File name to content, the same town in each."""
    return {
        "v1.gml": citygml("1.0"),
        "v2.gml": citygml("2.0"),
        "v3.gml": citygml3(),
        "v10.json": json.dumps(cityjson("1.0")),
        "v11.json": json.dumps(cityjson("1.1", "MultiSurface")),
        "v20.city.json": json.dumps(cityjson("2.0"), indent=1),
        "seq.city.jsonl": cityjsonseq(),
    }
