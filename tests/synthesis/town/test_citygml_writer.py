import re

import numpy as np
import pytest
from lxml import etree
from solid_checks import volume_m3

from lodbench.citymodel import mesh_model, open_scene, read_city_model
from lodbench.citymodel.model import SurfaceKind
from lodbench.synthesis.town.build import citygml_text
from lodbench.synthesis.town.buildings import Age
from lodbench.synthesis.town.town import ORIGIN_M

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
def fine_text(town):
    return citygml_text(town, is_fine=True)


@pytest.fixture(scope="module")
def root(text):
    return etree.fromstring(text.encode())


@pytest.fixture(scope="module")
def city_file(text, tmp_path_factory):
    path = tmp_path_factory.mktemp("city") / "town.gml"
    path.write_text(text, encoding="utf-8")
    return path


def test_identifiers_are_unique_and_links_resolve(root):
    identifiers = [element.get(GML_ID) for element in root.iter() if element.get(GML_ID)]
    known = set(identifiers)
    assert len(known) == len(identifiers)
    links = [element.get(HREF) for element in root.iter() if element.get(HREF)]
    assert links
    assert all(link.startswith("#") and link[1:] in known for link in links)


def test_every_building_has_both_solids_and_named_surfaces(root, town):
    buildings = root.findall("c:cityObjectMember/b:Building", NAMES)
    assert len(buildings) == len(town.mapped)
    for building in buildings:
        order = [etree.QName(child).localname for child in building]
        assert order[:6] == "stringAttribute function roofType measuredHeight lod1Solid lod2Solid".split()
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
    assert len(model.building_ids) == len(town.mapped)
    assert not model.findings.items


@pytest.mark.parametrize("lod", ["1", "2"])
def test_scenes_are_the_town(city_file, town, lod):
    scene = open_scene(city_file, lod=lod)
    assert scene.num_buildings == len(town.mapped)
    for number in range(0, scene.num_buildings, 50):
        building = next(b for b in town.mapped if b.identifier == scene.building_ids[number])
        solid = building.lod1 if lod == "1" else building.lod2
        vertices = scene.vertices[scene.vertex_starts[number] : scene.vertex_starts[number + 1]]
        first, last = scene.triangle_starts[number : number + 2]
        corners = scene.vertices[scene.triangles[first:last]].astype(np.float64)
        corners -= vertices.mean(axis=0)
        volume = np.sum(np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]) / 6.0
        assert volume == pytest.approx(volume_m3(solid), rel=1e-3)
        low = solid.points.min(axis=0) + ORIGIN_M - scene.origin
        np.testing.assert_allclose(vertices.min(axis=0), low, atol=2e-3)


@pytest.fixture(scope="module")
def fine(fine_text, tmp_path_factory):
    path = tmp_path_factory.mktemp("fine") / "town_lod3.gml"
    path.write_text(fine_text, encoding="utf-8")
    return read_city_model(path)


@pytest.mark.slow
def test_our_reader_gives_back_every_fine_surface(fine, town, city_file):
    standing = [b for b in town.buildings if b.age is not Age.GONE]
    assert fine.lods == ("3",)
    assert fine.building_ids == tuple(b.identifier for b in standing)
    assert not fine.findings.items
    counts = np.bincount(fine.polygons.kind, minlength=max(SurfaceKind) + 1)
    # The town's openings are windows and doors, its floors outer ceilings.
    counts[SurfaceKind.OPENING] += counts[SurfaceKind.DOOR]
    counts[SurfaceKind.FLOOR] += counts[SurfaceKind.CEILING]
    faces = [face for b in standing for face in b.lod3.faces]
    for kind in (
        SurfaceKind.WALL,
        SurfaceKind.ROOF,
        SurfaceKind.GROUND,
        SurfaceKind.OPENING,
        SurfaceKind.FLOOR,
    ):
        assert counts[kind] == sum(face.kind == kind for face in faces), kind
    installed = sum(len(solid.faces) for b in standing for solid in b.installations)
    assert counts[SurfaceKind.INSTALLATION] == installed > 1000
    np.testing.assert_array_equal(fine.origin, read_city_model(city_file).origin)


@pytest.mark.slow
def test_what_was_read_is_closed_and_loses_no_area(fine, town):
    mesh = mesh_model(fine, "3")
    assert not mesh.findings.items
    assert mesh.lost_m2 < 1e-6 * mesh.area_m2
    polygons = fine.polygons
    keys = np.round(polygons.points * 1e4).astype(np.int64)
    for number in range(0, len(town.standing), 25):
        edges = set()
        for polygon in np.flatnonzero(polygons.building == number):
            for ring in range(*polygons.polygon_starts[polygon : polygon + 2]):
                first, last = polygons.ring_starts[ring : ring + 2]
                corners = [tuple(key) for key in keys[first:last].tolist()]
                edges |= set(zip(corners, corners[1:] + corners[:1], strict=True))
        assert edges
        # Every edge is met once each way: walls, openings, roofs, eaves, chimneys leave no gap.
        assert all((end, start) in edges for start, end in edges)


def test_openings_hang_on_the_surfaces_they_open(fine_text):
    root = etree.fromstring(fine_text.encode())
    openings = root.findall(".//b:opening/*", NAMES)
    names = {etree.QName(element).localname for element in openings}
    assert names == {"Window", "Door"}
    assert {etree.QName(element.getparent().getparent()).localname for element in openings} == {"WallSurface"}
    assert all(element.find("b:lod3MultiSurface//g:Polygon", NAMES) is not None for element in openings)
    building = root.find("c:cityObjectMember/b:Building", NAMES)
    order = [etree.QName(child).localname for child in building]
    # The order of the schema: installations, surfaces, then the solid they make up.
    assert order[-1] == "lod3Solid"
    assert order == sorted(
        order,
        key="""
            stringAttribute function roofType measuredHeight outerBuildingInstallation boundedBy lod3Solid
        """.split().index,
    )
