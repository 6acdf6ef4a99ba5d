"""The demo town as a whole, and its CityGML."""

import re
from collections import Counter

import numpy as np
import pytest
from lxml import etree
from solid_checks import assert_sound, volume_m3

from lodbench.citymodel import mesh_model, open_scene, read_city_model
from lodbench.citymodel.model import SurfaceKind
from lodbench.synthesis.town.build import citygml_text
from lodbench.synthesis.town.buildings import LOD1_GRID_M, LOD1_HEIGHT_SIGMA_M, Age
from lodbench.synthesis.town.shapes import area
from lodbench.synthesis.town.town import ORIGIN_M, grow_town


@pytest.mark.nightly
@pytest.mark.parametrize(("seed", "step"), [(0, 6), pytest.param(1, 2, marks=pytest.mark.nightly)])
def test_every_solid_is_sound(town_of, seed, step):
    for building in town_of(seed).buildings[seed::step]:
        assert_sound(building.lod1)
        assert_sound(building.lod2)


@pytest.mark.nightly
@pytest.mark.parametrize(("seed", "step"), [(0, 9), pytest.param(1, 3, marks=pytest.mark.nightly)])
def test_every_fine_solid_is_closed_with_its_openings(town_of, seed, step):
    for building in town_of(seed).buildings[::step]:
        assert_sound(building.lod3)
        for installation in building.installations:
            assert_sound(installation)


def test_openings_lie_in_walls_above_the_ground_and_dormers_in_fine_roofs_only(town):
    windows = doors = 0
    for building in town.buildings:
        solid = building.lod3
        for face in solid.faces:
            if face.host is None:
                assert face.kind != SurfaceKind.OPENING
                continue
            host = solid.faces[face.host]
            assert host.kind == SurfaceKind.WALL
            # The opening fills a hole of its wall, corner for corner.
            assert set(face.rings[0]) in [set(ring) for ring in host.rings[1:]]
            corners = solid.points[list(face.rings[0])]
            ground = town.terrain.height(corners[:, :2])
            # Doors have a step; no opening is buried by more than what the ground varies along it.
            assert (corners[:, 2] > ground - 0.6).all()
            doors += face.is_door
            windows += not face.is_door
        coarse = {face.kind for face in building.lod2.faces}
        assert coarse <= {SurfaceKind.GROUND, SurfaceKind.WALL, SurfaceKind.ROOF}
    assert windows > 8 * len(town.buildings)
    assert 0.8 * len(town.buildings) < doors <= len(town.buildings)


def test_no_window_looks_into_a_neighbour(town):
    for number, building in enumerate(town.buildings[::7]):
        for face in building.lod3.faces:
            if face.host is None or face.is_door:
                continue
            corners = building.lod3.points[list(face.rings[0])]
            if corners[2, 2] > building.lod3.points[:, 2].min() + building.plan.roof.eave_m:
                continue  # a dormer's
            along = (corners[1] - corners[0])[:2] / np.linalg.norm((corners[1] - corners[0])[:2])
            out = np.array([along[1], -along[0]])
            before = town.occupancy.at(corners.mean(axis=0)[None, :2] + 0.9 * out)
            assert before[0] in (0, 7 * number + 1)


def test_eaves_stand_out_over_walls(town):
    for building in town.buildings:
        if building.plan.roof.name == "gabled" and len(building.plan.strip.wings) == 1:
            grown = np.ptp(building.lod3.points[:, :2], axis=0) - np.ptp(building.lod2.points[:, :2], axis=0)
            assert grown.max() > 0.15
            assert grown.max() < 1.3


def test_the_coarse_map_is_older_than_the_fine_one(town):
    ages = Counter(building.age for building in town.buildings)
    assert set(ages) == set(Age)
    assert 0.75 * len(town.buildings) < ages[Age.KNOWN] < 0.95 * len(town.buildings)
    assert len(town.standing) == len(town.buildings) - ages[Age.GONE]
    assert len(town.mapped) == len(town.buildings) - ages[Age.NEW]
    raised = [b for b in town.buildings if b.age is Age.RAISED]
    assert all(np.ptp(b.lod3.points[:, 2]) > np.ptp(b.lod2.points[:, 2]) + 2.5 for b in raised)


def samples_in(piece: np.ndarray) -> np.ndarray:
    """Returns 81 points spread over a convex quadrilateral, 1 % away from its edges."""
    u, v = (axis.ravel()[:, None] for axis in np.meshgrid(*[np.linspace(0.01, 0.99, 9)] * 2))
    a, b, c, d = piece
    return (1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * d


def inside(piece: np.ndarray, points: np.ndarray) -> np.ndarray:
    edge = np.roll(piece, -1, axis=0) - piece
    off = points[:, None, :] - piece
    return (edge[:, 0] * off[..., 1] - edge[:, 1] * off[..., 0] > 1e-6).all(axis=1)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [0, 1])
def test_footprints_do_not_overlap(town_of, seed):
    buildings = town_of(seed).buildings
    owned = [(number, p) for number, b in enumerate(buildings) for p in b.plan.pieces]
    owners, pieces = [number for number, _ in owned], [piece for _, piece in owned]
    middles = np.stack([piece.mean(axis=0) for piece in pieces])
    reach = np.array([np.linalg.norm(p - m, axis=1).max() for p, m in zip(pieces, middles, strict=True)])
    for k, piece in enumerate(pieces):
        near = np.linalg.norm(middles - middles[k], axis=1) < reach + reach[k]
        for other in np.flatnonzero(near):
            if owners[other] != owners[k]:
                names = buildings[owners[k]].identifier, buildings[owners[other]].identifier
                assert not inside(piece, samples_in(pieces[other])).any(), names


def test_it_is_a_town_of_many_kinds(town):
    assert 500 <= len(town.buildings) <= 1100
    roofs = Counter(building.plan.roof.name for building in town.buildings)
    assert {"flat", "gabled", "hipped", "half-hipped", "mansard", "pavilion", "shed"} <= set(roofs)
    assert roofs["gabled"] > 0.4 * len(town.buildings)
    wings = Counter(len(b.plan.strip.wings) for b in town.buildings)
    assert wings[1] > wings[2] > 20
    districts = {building.plan.district for building in town.buildings}
    assert districts == {"old town", "inner town", "garden suburb", "estate", "works"}
    assert max(b.plan.roof.eave_m for b in town.buildings) > 30.0


@pytest.mark.nightly
def test_courtyards_and_u_shapes_exist_somewhere(town_of):
    strips = [b.plan.strip for seed in (0, 1) for b in town_of(seed).buildings]
    assert any(strip.closed for strip in strips)
    assert any(len(strip.wings) == 3 and not strip.closed for strip in strips)


def test_the_ground_has_relief(town):
    bases = np.array([building.lod2.points[:, 2].min() for building in town.buildings])
    assert 20.0 < np.ptp(bases) < 50.0
    assert bases.min() > town.terrain.water_m + 1.0


def test_buildings_stand_on_their_ground(town):
    for building in town.buildings:
        outline = np.concatenate(building.plan.strip.rings)
        for solid in (building.lod1, building.lod2, building.lod3):
            base = solid.points[:, 2].min()
            assert base == pytest.approx(town.terrain.height(outline).min(), abs=0.006)


def test_the_river_lies_in_a_valley(town):
    river = town.streets.river
    middle = river[np.linalg.norm(river, axis=1) < 600]
    assert (town.terrain.height(middle) < town.terrain.water_m - 1.0).all()
    for block in town.streets.blocks:
        assert town.terrain.river_distance(block.ring).min() > 14.0
        assert (town.terrain.height(block.ring) > town.terrain.water_m + 0.4).all()


def test_identifiers_are_unique(town):
    names = [building.identifier for building in town.buildings]
    assert len(set(names)) == len(names)


def test_lod1_stands_on_the_same_ground_and_differs_as_in_life(town):
    ratio, wrong_m = [], []
    for building in town.buildings:
        if building.age is Age.RAISED:
            continue
        low, fine = building.lod1.points, building.lod2.points
        assert low[:, 2].min() == pytest.approx(fine[:, 2].min(), abs=0.002)
        roof = building.plan.roof
        expected = 0.5 * (roof.eave_m + roof.ridge_m)
        wrong_m.append(np.ptp(low[:, 2]) - expected)
        np.testing.assert_allclose(np.round(low[:, :2] / LOD1_GRID_M) * LOD1_GRID_M, low[:, :2])
        ratio.append(volume_m3(building.lod1) / volume_m3(building.lod2))
    assert 0.97 < np.median(ratio) < 1.03
    assert np.std(ratio) > 0.02
    assert abs(np.mean(wrong_m)) < 0.06
    assert np.std(wrong_m) == pytest.approx(LOD1_HEIGHT_SIGMA_M, rel=0.15)


def test_no_block_is_a_rectangle_on_a_grid(town):
    angles = []
    for block in town.streets.blocks:
        edge = np.roll(block.ring, -1, axis=0) - block.ring
        assert area(block.ring) > 0
        angles += list(np.degrees(np.arctan2(edge[:, 1], edge[:, 0])) % 90.0)
    counts, _ = np.histogram(angles, bins=18, range=(0.0, 90.0))
    assert counts.max() < 0.25 * counts.sum()


def test_another_seed_is_another_town(town, town_of):
    assert len(town_of(1).buildings) != len(town.buildings)


@pytest.mark.nightly
def test_the_two_looks_differ_in_more_than_chance(town):
    other = grow_town(0, "train")
    roofs = [Counter(b.plan.roof.name for b in some.buildings) for some in (town, other)]
    assert roofs[1]["shed"] > 2 * roofs[0]["shed"]
    for name in ("walls", "tiles"):
        one, another = (set(map(tuple, getattr(some.look, name))) for some in (town, other))
        assert one
        assert not one & another
    assert len(other.buildings) > 500


@pytest.mark.parametrize("seed", [0, 1])
def test_every_town_has_its_church(town_of, seed):
    churches = [b.plan for b in town_of(seed).buildings if b.plan.function == "church"]
    assert [plan.roof.name for plan in churches] == ["hipped", "pavilion"]


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
