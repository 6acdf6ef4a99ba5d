from __future__ import annotations

import re

import numpy as np
import pytest
from lxml import etree

from lodbench.citymodel import open_scene, read_city_model
from lodbench.datasets.demo.citygml_writer import ORIGIN_M, citygml_text
from lodbench.datasets.demo.town import grow_town

NAMES = {
    "c": "http://www.opengis.net/citygml/2.0",
    "b": "http://www.opengis.net/citygml/building/2.0",
    "g": "http://www.opengis.net/gml",
}
GML_ID = "{http://www.opengis.net/gml}id"
HREF = "{http://www.w3.org/1999/xlink}href"


@pytest.fixture(scope="module")
def text(town):
    return citygml_text(town)


@pytest.fixture(scope="module")
def root(text):
    return etree.fromstring(text.encode())


@pytest.fixture(scope="module")
def city_file(text, tmp_path_factory):
    path = tmp_path_factory.mktemp("city") / "town.gml"
    path.write_text(text, encoding="utf-8")
    return path


def test_bytes_follow_from_the_seed(text, town_of):
    assert citygml_text(grow_town(0)) == text
    assert citygml_text(town_of(1)) != text


def test_identifiers_are_unique_and_links_resolve(root):
    identifiers = [element.get(GML_ID) for element in root.iter() if element.get(GML_ID)]
    known = set(identifiers)
    assert len(known) == len(identifiers)
    links = [element.get(HREF) for element in root.iter() if element.get(HREF)]
    assert links
    assert all(link.startswith("#") and link[1:] in known for link in links)


def test_every_building_has_both_solids_and_named_surfaces(root, town):
    buildings = root.findall("c:cityObjectMember/b:Building", NAMES)
    assert len(buildings) == len(town.buildings)
    for building in buildings:
        order = [etree.QName(child).localname for child in building]
        assert order[:6] == [
            "stringAttribute",
            "function",
            "roofType",
            "measuredHeight",
            "lod1Solid",
            "lod2Solid",
        ]
        assert set(order[6:]) == {"boundedBy"}
        assert len(building.findall("b:boundedBy/b:GroundSurface", NAMES)) == 1
        assert building.findall("b:boundedBy/b:RoofSurface", NAMES)
        assert len(building.findall("b:lod2Solid//g:surfaceMember", NAMES)) == len(order) - 6


def test_rings_close_and_have_millimetres(text):
    rings = re.findall(r'<gml:posList srsDimension="3">([^<]*)</gml:posList>', text)
    assert len(rings) > 10_000
    for ring in rings[::97]:
        numbers = ring.split()
        assert len(numbers) % 3 == 0
        assert numbers[:3] == numbers[-3:]
        assert all(re.fullmatch(r"\d+\.\d{3}", number) for number in numbers)


def test_the_reader_takes_it_without_a_finding(city_file, town):
    model = read_city_model(city_file)
    assert model.format == "CityGML"
    assert model.version == "2.0"
    assert model.crs == "EPSG:25832+7837"
    assert model.lods == ("1", "2")
    assert len(model.building_ids) == len(town.buildings)
    assert not model.findings.items


@pytest.mark.parametrize("lod", ["1", "2"])
def test_scenes_are_the_town(city_file, town, lod):
    scene = open_scene(city_file, lod=lod)
    assert scene.num_buildings == len(town.buildings)
    for number in range(0, scene.num_buildings, 50):
        building = town.buildings[scene_index(town, scene.building_ids[number])]
        solid = building.lod1 if lod == "1" else building.lod2
        vertices = scene.vertices[scene.vertex_starts[number] : scene.vertex_starts[number + 1]]
        first, last = scene.triangle_starts[number : number + 2]
        corners = scene.vertices[scene.triangles[first:last]].astype(np.float64)
        corners -= vertices.mean(axis=0)
        volume = np.sum(np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]) / 6.0
        assert volume == pytest.approx(solid.volume_m3(), rel=1e-3)
        low = solid.points.min(axis=0) + ORIGIN_M - scene.origin
        np.testing.assert_allclose(vertices.min(axis=0), low, atol=2e-3)


def scene_index(town, identifier: str) -> int:
    names = [building.identifier for building in town.buildings]
    return names.index(identifier)
