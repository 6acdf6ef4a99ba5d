"""LoD1 from LoD2 beside blocks that the tests raise themselves, from the ground surfaces in the file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from lxml import etree
from numpy.typing import NDArray

from lodbench.citymodel import read_city_model
from lodbench.citymodel.derive import derive_lod1
from lodbench.citymodel.model import CityModel, Polygons
from lodbench.findings import Findings

_GML = "{http://www.opengis.net/gml}"
_BUILDING = "{http://www.opengis.net/citygml/building/1.0}"

Plans = dict[str, list[shapely.Polygon]]


def gml_plans(path: Path) -> Plans:
    """Returns the ground surfaces of each building or part, by gml:id."""
    plans: Plans = {}
    for ground in etree.parse(path).iter(f"{_BUILDING}GroundSurface"):
        owner = next(ground.iterancestors(f"{_BUILDING}BuildingPart", f"{_BUILDING}Building"))
        for polygon in ground.iter(f"{_GML}Polygon"):
            rings = [_ring(node) for node in polygon.iter(f"{_GML}LinearRing")]
            plans.setdefault(str(owner.get(f"{_GML}id")), []).append(shapely.Polygon(rings[0], rings[1:]))
    return plans


def _ring(node: Any) -> NDArray[np.float64]:
    text = " ".join(child.text for child in node if child.tag in (f"{_GML}posList", f"{_GML}pos"))
    return np.array(text.split(), float).reshape(-1, 3)[:, :2]


def cityjson_plans(path: Path) -> Plans:
    """Returns the ground surfaces of each object of a CityJSON file or sequence, by id."""
    lines = path.read_text().splitlines() if path.suffix == ".jsonl" else [path.read_text()]
    first = json.loads(lines[0])
    plans: Plans = {}
    for document in map(json.loads, lines):
        place = document.get("transform", first["transform"])
        points = np.array(document["vertices"]).reshape(-1, 3) * place["scale"] + place["translate"]
        for name, told in document["CityObjects"].items():
            labelled = [one for one in told.get("geometry", []) if "semantics" in one]
            for geometry in labelled:
                for face in _ground_faces(geometry["boundaries"], geometry["semantics"]):
                    rings = [points[ring, :2] for ring in face]
                    plans.setdefault(name, []).append(shapely.Polygon(rings[0], rings[1:]))
    return plans


def _ground_faces(boundaries: list[Any], semantics: dict[str, Any]) -> Iterator[list[list[int]]]:
    def walk(faces: list[Any], labels: list[Any]) -> Iterator[list[list[int]]]:
        for face, label in zip(faces, labels, strict=True):
            if isinstance(label, list):
                yield from walk(face, label)
            elif label is not None and semantics["surfaces"][label]["type"] == "GroundSurface":
                yield face

    return walk(boundaries, semantics["values"])


def by_owner(model: CityModel, blocks: Polygons) -> Iterator[tuple[str, NDArray[np.float64], float]]:
    """Yields name, points and area of all faces of each block."""
    owners = blocks.building if blocks.part is None else blocks.part
    names = model.building_ids if blocks.part is None or model.objects is None else model.objects.ids
    areas = np.zeros(len(names))
    points: dict[int, list[NDArray[np.float64]]] = {}
    for n, owner in enumerate(owners.tolist()):
        starts = blocks.ring_starts[blocks.polygon_starts[n] : blocks.polygon_starts[n + 1] + 1]
        rings = [blocks.points[a:b] for a, b in pairwise(starts)]
        vectors = [0.5 * np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0) for ring in rings]
        areas[owner] += np.linalg.norm(np.sum(vectors, axis=0))
        points.setdefault(owner, []).extend(rings)
    for owner, rings in points.items():
        yield names[owner], np.concatenate(rings), areas[owner]


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("germany_lod2/LoD2_576_5950_1_HH_2016.xml", 94),
        ("vienna/vienna20_wrongcrs.jsonl", 72),
        ("netherlands_other/3-20-DELFSHAVEN.city.json", 853),
    ],
)
def test_blocks_are_dissolved_footprints(shared_data: Path, name: str, count: int) -> None:
    """Floor, ceiling and outer walls of the union of a part's ground surfaces, and no wall between them."""
    path = shared_data / "city" / name
    plans = gml_plans(path) if path.suffix == ".xml" else cityjson_plans(path)
    model = read_city_model(path)
    blocks = list(by_owner(model, derive_lod1(model, "median", Findings())))
    assert len(blocks) == len(plans) == count
    for owner, points, area in blocks:
        plan = shapely.union_all([shapely.make_valid(one) for one in plans[owner]], grid_size=1e-3)
        height = float(np.ptp(points[:, 2]))
        assert area == pytest.approx(2.0 * plan.area + plan.length * height, rel=1e-6), owner
