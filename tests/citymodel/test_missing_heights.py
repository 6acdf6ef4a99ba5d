"""Heights: none known, of footprints above or below the ground, LoD1 derived from LoD2."""

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

from lodbench.citymodel import ReadOptions, city_info, mesh_model, read_city_model
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.derive import derive_lod1
from lodbench.citymodel.model import CityModel, Polygons
from lodbench.errors import CityModelError
from lodbench.findings import Findings

from .gml_text import (
    box_area,
    box_city,
    box_rings,
    city,
    codes,
    member,
    multi_surface,
    polygon,
    solid_of,
    surface_members,
    write,
)
from .test_cityjson import building, document, read, surface


def row_of_houses(
    tmp_path: Path, base: float, top: float, count: int = 5, ground: float = 512.0
) -> CityModel:
    """Houses 8 m high on the ground, 20 m apart; the middle one has other heights."""
    rings = [box_rings(x=500000.0 + 20.0 * n, z=ground, height=8.0) for n in range(count)]
    heights = {ground: base, ground + 8.0: top}
    hurt = count // 2
    rings[hurt] = [[(x, y, heights[z]) for x, y, z in ring] for ring in rings[hurt]]
    text = "".join(member(solid_of(each), f"h{n}") for n, each in enumerate(rings))
    return read_city_model(write(tmp_path / "a.gml", city(text)))


@pytest.mark.parametrize("lost", [-9999.0, -2147483.648, -32768.0, -3.4e38, -1e20, 9999.0, -999.0, 99999.0])
def test_a_base_at_no_data_is_reported_with_its_height_and_stands_on_the_ground(tmp_path, lost):
    """A block of Paris was 2,147,629 m high, without a word."""
    model = row_of_houses(tmp_path, base=lost, top=520.0)
    (found,) = model.findings.items
    assert (found.code.code, found.object_id) == ("LB415", "h2")
    assert f"{lost:.10g} m" in found.detail
    sound = read_city_model(write(tmp_path / "b.gml", box_city(z=512.0, height=8.0)))
    assert np.ptp(model.polygons.points[:, 2]) == np.ptp(sound.polygons.points[:, 2]) == 8.0
    assert mesh_model(model).area_m2 == pytest.approx(5 * box_area(height=8.0))


def test_a_roof_at_no_data_leaves_its_house_flat_and_is_told(tmp_path):
    model = row_of_houses(tmp_path, base=512.0, top=-9999.0)
    assert codes(model)["LB415"] == 1
    assert np.ptp(model.polygons.points[:, 2]) == 8.0


def test_a_lone_building_ends_at_the_lowest_height_it_has(tmp_path):
    model = row_of_houses(tmp_path, base=-9999.0, top=520.0, count=1)
    assert codes(model)["LB415"] == 1
    assert set(model.polygons.points[:, 2].tolist()) == {520.0}


@pytest.mark.parametrize(
    ("base", "top", "ground"),
    [(-430.0, -420.0, -428.0), (4000.0, 4828.0, 4000.0), (0.0, 8.0, 0.0), (20000.0, 20010.0, 20000.0)],
)
def test_high_and_low_towns_and_other_units_are_left_alone(tmp_path, base, top, ground):
    assert "LB415" not in codes(row_of_houses(tmp_path, base, top, ground=ground))


def test_a_footprint_at_zero_under_a_mountain_house_is_none(tmp_path):
    """Level 0 has often no heights: the building is not 1600 m tall."""
    flat = multi_surface(surface_members([polygon(box_rings(z=0.0)[0])]), lod=0).replace(
        "lod0MultiSurface", "lod0FootPrint"
    )
    walls = solid_of(box_rings(z=1600.0), lod=2)
    assert codes(read_city_model(write(tmp_path / "a.gml", city(member(flat + walls))))) == {}


def test_terrain_may_be_taller_than_any_building(tmp_path):
    hill = [(500000.0, 5600000.0, 200.0), (500900.0, 5600000.0, 200.0), (500900.0, 5600900.0, 2200.0)]
    text = box_city(z=200.0).replace(
        "</core:CityModel>",
        "<core:cityObjectMember><dem:ReliefFeature xmlns:dem='http://www.opengis.net/citygml/relief/2.0'>"
        "<dem:reliefComponent><dem:TINRelief><dem:lod>1</dem:lod><dem:tin><gml:TriangulatedSurface>"
        f"<gml:trianglePatches>{polygon(hill).replace('Polygon', 'Triangle')}</gml:trianglePatches>"
        "</gml:TriangulatedSurface></dem:tin></dem:TINRelief></dem:reliefComponent></dem:ReliefFeature>"
        "</core:cityObjectMember></core:CityModel>",
    )
    model = read_city_model(write(tmp_path / "a.gml", text), options=ReadOptions(layers=("relief",)))
    assert (len(model.building_ids), codes(model)) == (2, {})


def test_a_mesh_in_millimetres_is_left_alone(tmp_path):
    path = write(tmp_path / "a.obj", "v 0 0 0\nv 9000 0 0\nv 0 0 12000\nf 1 2 3\n")
    assert codes(read_city_model(path)) == {}


def footprints(tmp_path: Path, *rows: dict[str, object]) -> Path:
    pytest.importorskip("pyogrio")
    names, y = dict.fromkeys(name for row in rows for name in row), 5600000
    features = [
        {
            "type": "Feature",
            "properties": {name: row.get(name) for name in names},
            "geometry": {
                "type": "Polygon",
                "coordinates": [[[x, y], [x + 10, y], [x + 10, y + 10], [x, y + 10], [x, y]]],
            },
        }
        for x, row in zip(range(500000, 600000, 20), rows, strict=False)
    ]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    text = json.dumps({"type": "FeatureCollection", "crs": crs, "features": features})
    return write(tmp_path / "a.geojson", text)


def spans(model: CityModel) -> list[tuple[float, float]]:
    """Returns the lowest and highest point of each building."""
    points = np.repeat(
        model.polygons.building, np.diff(model.polygons.ring_starts[model.polygons.polygon_starts])
    )
    z = [model.polygons.points[points == n, 2] for n in range(len(model.building_ids))]
    return [(float(own.min()), float(own.max())) for own in z]


@pytest.mark.parametrize(
    ("row", "span"),
    [
        ({"height": 20.0, "min_height": 12.0}, (12.0, 20.0)),
        ({"height": 20.0, "building:min_height": "12,5 m"}, (12.5, 20.0)),
        ({"height": 20.0, "min_level": 4}, (12.0, 20.0)),
        ({"levels": 6, "building:min_level": 4}, (12.0, 18.0)),
        ({"height": 20.0, "min_floor": 2, "min_height": 5.0}, (5.0, 20.0)),
        ({"height": 20.0, "min_height": -3.0}, (0.0, 20.0)),
        ({"height": 20.0, "min_height": None}, (0.0, 20.0)),
    ],
)
def test_a_footprint_begins_where_it_is_told_to(tmp_path, row, span):
    model = read_city_model(footprints(tmp_path, row, {"height": 9.0, "levels": 3}))
    assert spans(model)[0] == span


def test_what_begins_above_its_top_has_no_height(tmp_path):
    model = read_city_model(footprints(tmp_path, {"height": 5.0, "min_height": 9.0}, {"height": 9.0}))
    (found,) = [item for item in model.findings.items if item.code.code == "LB405"]
    assert "min_height is 9.0" in found.detail
    assert spans(model) == [(0.0, 9.0)]


@pytest.mark.parametrize(
    "columns",
    [{"underground": "yes"}, {"is_underground": True}, {"location": "underground"}, {"underground": 1}],
)
def test_what_lies_underground_is_left_out_and_reported(tmp_path, columns):
    path = footprints(tmp_path, {"height": 5.0, **columns}, {"height": 9.0, **dict.fromkeys(columns, None)})
    model = read_city_model(path)
    assert codes(model) == {"LB410": 1, "LB416": 1}
    assert spans(model) == [(0.0, 9.0)]


def test_numbers_of_storeys_underground_say_nothing_of_the_rest(tmp_path):
    model = read_city_model(
        footprints(tmp_path, {"height": 5.0, "underground": 2}, {"height": 9.0, "underground": 1})
    )
    assert "LB416" not in codes(model)


def test_footprints_below_the_ground_alone_are_no_city(tmp_path):
    with pytest.raises(CityModelError, match="below the ground"):
        read_city_model(footprints(tmp_path, {"height": 5.0, "underground": "yes"}))


def outline(prop: str, height: str, z: float = 500.0) -> str:
    ring = polygon(box_rings(z=z)[0])
    surfaces = f"<gml:MultiSurface>{surface_members([ring])}</gml:MultiSurface>"
    return city(member(f"{height}<bldg:{prop}>{surfaces}</bldg:{prop}>"))


MEASURED = '<bldg:measuredHeight uom="m">12</bldg:measuredHeight>'
CON = "xmlns:con='http://www.opengis.net/citygml/construction/3.0'"


@pytest.mark.parametrize(
    ("prop", "height", "span"),
    [
        ("lod0FootPrint", MEASURED, (500.0, 512.0)),
        ("lod0RoofEdge", MEASURED, (488.0, 500.0)),
        ("lod0FootPrint", MEASURED.replace('"m">12', '"cm">1200'), (500.0, 512.0)),
        (
            "lod0FootPrint",
            '<bldg:storeyHeightsAboveGround uom="m">4 4 4</bldg:storeyHeightsAboveGround>',
            (500.0, 512.0),
        ),
        (
            "lod0FootPrint",
            f"<con:height {CON}><con:Height><con:status>measured</con:status>"
            "<con:value uom='m'>12</con:value></con:Height></con:height>",
            (500.0, 512.0),
        ),
    ],
)
@pytest.mark.parametrize("rule", ["median", "max", "eave"])
def test_a_footprint_of_known_height_is_reported_and_a_block_on_request(tmp_path, prop, height, span, rule):
    model = read_city_model(write(tmp_path / "a.gml", outline(prop, height)))
    assert city_info(model)["findings"] == {"LB414 STAYS_FLAT": 1}
    block = mesh_model(model, "1", roof_height=rule)
    low, high = block.scene.extent_m
    assert (low[2], high[2]) == span
    assert block.area_m2 == pytest.approx(box_area(height=12.0))


def test_it_stands_beside_buildings_with_roofs_and_in_cityjson(tmp_path):
    flat = building(surface([0, 1, 2, 3], lod="0"), attributes={"measuredHeight": 7.5})
    upright = [[4000, 0, 3000], [4000, 4000, 3000]]
    roof = surface([0, 4, 5, 3], lod="2")
    vertices = [[0, 0, 0], [4000, 0, 0], [4000, 4000, 0], [0, 4000, 0], *upright]
    model = read(tmp_path, document({"flat": flat, "house": building(roof)}, vertices=vertices))
    block = mesh_model(model, "1", roof_height="max")
    assert block.scene.extent_m[1][2] == 7.5
    assert "LB409 LOD_UNDERIVABLE" not in block.findings.counts()
    with pytest.raises(CityModelError, match="level of detail 1") as raised:
        mesh_model(model, "1")
    assert "roof_height=" in raised.value.hint


def test_without_a_height_nothing_is_told_and_nothing_derived(tmp_path):
    model = read_city_model(write(tmp_path / "a.gml", outline("lod0FootPrint", "")))
    assert city_info(model)["findings"] == {}
    with pytest.raises(CityModelError, match="no level of detail 2 or finer"):
        mesh_model(model, "1", roof_height="max")


def test_the_edge_of_a_roof_stays_one_in_citygml(tmp_path):
    model = read_city_model(
        write(tmp_path / "a.gml", outline("lod0RoofEdge", MEASURED)), options=ReadOptions(has_details=True)
    )
    done = convert_city(model, tmp_path / "b.gml")
    assert done.left_out == ()
    assert "<bldg:lod0RoofEdge>" in (tmp_path / "b.gml").read_text()


_GML = "{http://www.opengis.net/gml}"
_BUILDING = "{http://www.opengis.net/citygml/building/1.0}"

Plans = dict[str, list[shapely.Polygon]]


def gml_plans(path: Path) -> Plans:
    """Returns the ground surfaces of each building or part, by gml:id."""
    plans: Plans = {}
    for ground in etree.parse(path).iter(f"{_BUILDING}GroundSurface"):
        owner = next(ground.iterancestors(f"{_BUILDING}BuildingPart", f"{_BUILDING}Building"))
        for shape in ground.iter(f"{_GML}Polygon"):
            rings = [_ring(node) for node in shape.iter(f"{_GML}LinearRing")]
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
    for line in map(json.loads, lines):
        place = line.get("transform", first["transform"])
        points = np.array(line["vertices"]).reshape(-1, 3) * place["scale"] + place["translate"]
        for name, told in line["CityObjects"].items():
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
