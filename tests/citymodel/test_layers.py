"""Layers and levels: bridges, trees, terrain and rooms counted or read; parts with levels of their own."""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import (
    CityModel,
    ReadOptions,
    city_info,
    mesh_model,
    parse_city_model,
    read_city_model,
)
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.options import LAYERS
from lodbench.citymodel.read import CityMesh
from lodbench.citymodel.source import open_sources
from lodbench.errors import ConfigError

from .gml_text import (
    box_area,
    box_rings,
    city,
    member,
    model_of,
    polygon,
    solid,
    solid_of,
    surface_members,
    write,
)
from .schemas import assert_valid_gml

_MODULES = {"brid": "bridge", "veg": "vegetation", "dem": "relief", "frn": "cityfurniture", "b": "building"}
_SPACES = " ".join(
    f'xmlns:{prefix}="http://www.opengis.net/citygml/{name}/{{version}}"' for prefix, name in _MODULES.items()
)


def _faces(x: float) -> str:
    return surface_members(map(polygon, box_rings(x=500000.0 + x)))


def _surfaces(name: str, x: float) -> str:
    return f"<{name}><gml:MultiSurface>{_faces(x)}</gml:MultiSurface></{name}>"


def town(version: str = "2.0") -> str:
    """A house at level 1 with a room, a bridge with a part and a railing, a tree, terrain, a lamp post."""
    spaces = _SPACES.format(version=version)
    inside = _surfaces("b:lod4MultiSurface", 0)
    room = f'<b:interiorRoom><b:Room gml:id="room">{inside}</b:Room></b:interiorRoom>'
    bridge = (
        '<brid:Bridge gml:id="bridge"><brid:consistsOfBridgePart><brid:BridgePart gml:id="span">'
        f"{_surfaces('brid:lod2MultiSurface', 100)}"
        '<brid:outerBridgeInstallation><brid:BridgeInstallation gml:id="rail">'
        f"{_surfaces('brid:lod2Geometry', 120)}"
        "</brid:BridgeInstallation></brid:outerBridgeInstallation></brid:BridgePart></brid:consistsOfBridgePart></brid:Bridge>"
    )
    tree = (
        '<veg:SolitaryVegetationObject gml:id="tree"><veg:lod1ImplicitRepresentation><core:ImplicitGeometry>'
        "<core:transformationMatrix>2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1</core:transformationMatrix>"
        f"<core:relativeGMLGeometry><gml:MultiSurface>{surface_members(map(polygon, box_rings(0, 0, 0)))}"
        "</gml:MultiSurface></core:relativeGMLGeometry><core:referencePoint><gml:Point>"
        "<gml:pos>500200 5600000 50</gml:pos></gml:Point></core:referencePoint></core:ImplicitGeometry>"
        "</veg:lod1ImplicitRepresentation></veg:SolitaryVegetationObject>"
    )
    triangle = "500000 5600000 49 500300 5600000 49 500000 5600200 49 500000 5600000 49"
    relief = (
        '<dem:ReliefFeature gml:id="ground"><dem:lod>3</dem:lod><dem:reliefComponent>'
        '<dem:TINRelief gml:id="tin">'
        "<dem:lod>3</dem:lod><dem:tin><gml:TriangulatedSurface><gml:trianglePatches><gml:Triangle><gml:exterior>"
        f"<gml:LinearRing><gml:posList>{triangle}</gml:posList></gml:LinearRing></gml:exterior></gml:Triangle>"
        "</gml:trianglePatches></gml:TriangulatedSurface></dem:tin></dem:TINRelief></dem:reliefComponent></dem:ReliefFeature>"
    )
    lamp = f'<frn:CityFurniture gml:id="lamp">{_surfaces("frn:lod1Geometry", 150)}</frn:CityFurniture>'
    others = "".join(
        f"<core:cityObjectMember>{text}</core:cityObjectMember>" for text in (bridge, tree, relief, lamp)
    )
    return city(member(solid(_faces(0)) + room, "house") + others, version=version).replace(
        "xmlns:uro=", f"{spaces} xmlns:uro=", 1
    )


def twin() -> str:
    """The same in CityJSON, without the room."""
    vertices: list[list[float]] = []

    def faces(
        x: float, y: float = 5600000.0, z: float = 50.0, size: float = 10.0, height: float = 6.0
    ) -> list[list[list[int]]]:
        found = []
        for ring in box_rings(500000.0 + x, y, z, size, height):
            found.append([list(range(len(vertices), len(vertices) + len(ring)))])
            vertices.extend([list(point) for point in ring])
        return found

    def thing(type_: str, lod: str, boundaries: list[list[list[int]]], **more: object) -> dict[str, object]:
        shape = {"type": "MultiSurface", "lod": lod, "boundaries": boundaries}
        return {"type": type_, "geometry": [shape], **more}

    vertices += [[500000.0, 5600000.0, 49.0], [500300.0, 5600000.0, 49.0], [500000.0, 5600200.0, 49.0]]
    tin = thing("TINRelief", "3", [[[0, 1, 2]]])
    tin["geometry"][0]["type"] = "CompositeSurface"  # type: ignore[index]
    objects = {
        "house": thing("Building", "1", faces(0)),
        "bridge": {"type": "Bridge", "children": ["span"]},
        "span": thing("BridgePart", "2", faces(100), parents=["bridge"], children=["rail"]),
        "rail": thing("BridgeInstallation", "2", faces(120), parents=["span"]),
        "tree": thing("SolitaryVegetationObject", "1", faces(200, size=20.0, height=12.0)),
        "ground": tin,
        "lamp": thing("CityFurniture", "1", faces(150)),
    }
    scale = {"scale": [0.001] * 3, "translate": [500000.0, 5600000.0, 0.0]}
    whole = np.rint((np.array(vertices) - scale["translate"]) / 0.001).astype(int).tolist()
    metadata = {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/25832"}
    return json.dumps(
        {
            "type": "CityJSON",
            "version": "2.0",
            "transform": scale,
            "metadata": metadata,
            "CityObjects": objects,
            "vertices": whole,
        }
    )


_ALL = ("bridges", "vegetation", "relief", "furniture")
_TREE = box_area(20.0, 12.0)
_GROUND = 300.0 * 200.0 / 2


@pytest.mark.parametrize("text", [town("2.0"), town("3.0"), twin()], ids=["2.0", "3.0", "cityjson"])
def test_layers_are_opted_in(text: str) -> None:
    plain = parse_city_model(text.encode(), "town.gml")
    assert plain.building_ids == ("house",)
    assert "LB209 NOT_A_BUILDING" in plain.findings.counts()
    assert mesh_model(plain).area_m2 == pytest.approx(box_area())

    bridge = parse_city_model(text.encode(), "town.gml", ReadOptions(layers=("bridges",)))
    assert (bridge.building_ids, bridge.types()) == (("house", "bridge"), ("Building", "Bridge"))
    # The house has level 1 only, the bridge level 2 only: both are there whichever is asked for.
    mesh = mesh_model(bridge)
    assert (mesh.scene.lod, mesh.area_m2) == ("1", pytest.approx(3 * box_area()))
    assert mesh.scene.building_ids == ("house", "bridge")

    full = parse_city_model(text.encode(), "town.gml", ReadOptions(layers=_ALL))
    assert sorted(full.types()) == "Bridge Building CityFurniture SolitaryVegetationObject TINRelief".split()
    assert mesh_model(full).area_m2 == pytest.approx(4 * box_area() + _TREE + _GROUND)
    info = city_info(full)
    assert (info["buildings"], info["objects"]["Bridge"], info["objects"]["TINRelief"]) == (1, 1, 1)
    assert info["lods"]["1"]["area_m2"] == pytest.approx(2 * box_area() + _TREE)  # each level by itself


def test_control_points_of_terrain_are_in_no_triangle() -> None:
    points = "<gml:posList>500000 5600000 49 500300 5600000 49</gml:posList>"
    points = f"<gml:controlPoint>{points}</gml:controlPoint>"
    text = town().replace("TriangulatedSurface", "Tin").replace("</gml:Tin>", points + "</gml:Tin>")
    model = parse_city_model(text.encode(), "town.gml", ReadOptions(layers=("relief",)))
    is_ground = ~model.is_building()[model.polygons.building]
    assert np.diff(model.polygons.ring_starts)[is_ground].tolist() == [3]


def test_surfaces_of_water() -> None:
    top = polygon(box_rings(x=500300.0)[1])
    water = (
        '<core:cityObjectMember><wtr:WaterBody gml:id="pond" '
        'xmlns:wtr="http://www.opengis.net/citygml/waterbody/2.0">'
        f"<wtr:boundedBy><wtr:WaterSurface><wtr:lod2Surface>{top}</wtr:lod2Surface></wtr:WaterSurface>"
        "</wtr:boundedBy></wtr:WaterBody></core:cityObjectMember>"
    )
    text = city(member(solid(_faces(0)), "house") + water)
    model = parse_city_model(text.encode(), "town.gml", ReadOptions(layers=("water",)))
    assert mesh_model(model).area_m2 == pytest.approx(box_area() + 100.0)


def test_rooms_are_a_layer() -> None:
    text = town().encode()
    inside = parse_city_model(text, "a.gml", ReadOptions(layers=("interiors",)))
    assert mesh_model(inside, "4").area_m2 == pytest.approx(box_area())
    with pytest.raises(ConfigError, match="no layer 'bridge'"):
        ReadOptions(layers=("bridge",))


def test_a_delivery_has_a_folder_per_layer(tmp_path: Path) -> None:
    for name in ("bldg", "brid", "tran"):
        (tmp_path / "udx" / name).mkdir(parents=True)
        write(tmp_path / "udx" / name / f"1_{name}.gml", town())
    assert len(open_sources(tmp_path)) == 1
    names = [source.path.name for source in open_sources(tmp_path, ("bridges",))]
    assert names == ["1_bldg.gml", "1_brid.gml"]


def test_real_interiors(shared_data: Path) -> None:
    path = shared_data / "city/lod3_reference/lod4_building_v2.gml"
    outside, inside = (
        mesh_model(read_city_model(path, options=ReadOptions(layers=layers)), "4").area_m2
        for layers in ((), ("interiors",))
    )
    assert inside > 1.5 * outside


AREA = box_area()


def box(k: int, lod: int) -> str:
    return solid_of(box_rings(x=500000.0 + 40 * k), lod)


def part(name: str, content: str) -> str:
    inner = f'<bldg:BuildingPart gml:id="{name}">{content}</bldg:BuildingPart>'
    return f"<bldg:consistsOfBuildingPart>{inner}</bldg:consistsOfBuildingPart>"


def chimney(k: int, lod: int) -> str:
    shape = box(k, lod).replace(f"lod{lod}Solid", f"lod{lod}Geometry")
    inner = f'<bldg:BuildingInstallation gml:id="chimney">{shape}</bldg:BuildingInstallation>'
    return f"<bldg:outerBuildingInstallation>{inner}</bldg:outerBuildingInstallation>"


@pytest.mark.parametrize(
    ("content", "lod", "boxes", "absent"),
    [
        (box(0, 2) + chimney(1, 3), "finest", 2, []),
        (box(0, 2) + chimney(1, 3), "coarsest", 1, []),
        (box(0, 1) + box(0, 2) + chimney(1, 2), "coarsest", 1, []),
        (box(0, 1) + box(0, 2) + chimney(1, 2), "finest", 2, []),
        (chimney(1, 2) + chimney(2, 3), "finest", 2, []),
        (part("p", box(0, 1) + box(0, 2)) + part("q", box(1, 1)), "finest", 2, []),
        (part("p", box(0, 1) + box(0, 2)) + part("q", box(1, 1)), "2", 1, ["q"]),
        (part("p", box(0, 1) + box(0, 2)) + part("q", box(1, 2)), "coarsest", 2, []),
        # The building's own block stands for its parts, and they for it.
        (box(0, 1) + part("p", box(0, 2)) + part("q", box(1, 2)), "finest", 2, []),
        (box(0, 1) + part("p", box(0, 2)) + part("q", box(1, 2)), "coarsest", 1, []),
        (box(0, 1) + part("p", box(0, 2)) + part("q", box(1, 2)), "1", 1, []),
    ],
)
def test_what_is_meshed(tmp_path: Path, content: str, lod: str, boxes: int, absent: list[str]) -> None:
    mesh: CityMesh = mesh_model(model_of(tmp_path, city(member(content))), lod)
    assert mesh.meshed_m2 == pytest.approx(boxes * AREA)
    assert [item.object_id for item in mesh.findings.items] == absent


OPTIONS = ReadOptions(has_details=True, layers=tuple(LAYERS))
_GML_MODULES = (
    "bridge",
    "tunnel",
    "vegetation",
    "cityfurniture",
    "transportation",
    "waterbody",
    "landuse",
    "generics",
)


def multi(name: str, x: float) -> str:
    faces = surface_members(map(polygon, box_rings(500000.0 + 2 * x)))
    return f"<{name}><gml:MultiSurface>{faces}</gml:MultiSurface></{name}>"


def one_solid(name: str, x: float, around: str = "{}") -> str:
    faces = surface_members(map(polygon, box_rings(500000.0 + 2 * x)))
    shell = f"<gml:CompositeSurface>{faces}</gml:CompositeSurface>"
    shape = f"<gml:Solid><gml:exterior>{shell}</gml:exterior></gml:Solid>"
    return f"<{name}>{around.format(shape)}</{name}>"


def country() -> str:
    """A house, and one object or more of every module, at the levels that each of them has."""
    spaces = " ".join(f'xmlns:{n[:4]}="http://www.opengis.net/citygml/{n}/2.0"' for n in _GML_MODULES)
    wall = f"<brid:WallSurface>{multi('brid:lod2MultiSurface', 40)}</brid:WallSurface>"
    rail = (
        f"<brid:BridgeInstallation gml:id='rail'>{multi('brid:lod2Geometry', 30)}</brid:BridgeInstallation>"
    )
    span = f"<brid:BridgePart gml:id='span'>{one_solid('brid:lod1Solid', 50)}</brid:BridgePart>"
    tube = f"<tunn:HollowSpace gml:id='tube'>{multi('tunn:lod4MultiSurface', 70)}</tunn:HollowSpace>"
    tall = "<vege:species>1070</vege:species><vege:height uom='m'>12.5</vege:height>"
    objects = {
        "brid:Bridge": f"<brid:class>1000</brid:class>{one_solid('brid:lod1Solid', 20)}"
        f"<brid:outerBridgeInstallation>{rail}</brid:outerBridgeInstallation><brid:boundedBy>{wall}</brid:boundedBy>"
        f"<brid:consistsOfBridgePart>{span}</brid:consistsOfBridgePart>",
        "tunn:Tunnel": f"{multi('tunn:lod2MultiSurface', 60)}<tunn:interiorHollowSpace>{tube}"
        "</tunn:interiorHollowSpace>",
        "vege:SolitaryVegetationObject": tall + multi("vege:lod2Geometry", 80),
        "vege:PlantCover": multi("vege:lod1MultiSurface", 90),
        "city:CityFurniture": multi("city:lod1Geometry", 100),
        "tran:Road": multi("tran:lod1MultiSurface", 110),
        "tran:Square": multi("tran:lod2MultiSurface", 120),
        "wate:WaterBody": multi("wate:lod1MultiSurface", 130) + one_solid("wate:lod1Solid", 140),
        "land:LandUse": multi("land:lod0MultiSurface", 150),
        "gene:GenericCityObject": multi("gene:lod3Geometry", 160),
    }
    members = "".join(
        f"<core:cityObjectMember {spaces}><{name} gml:id='{name[5:]}'>{text}</{name}></core:cityObjectMember>"
        for name, text in objects.items()
    )
    return city(member(one_solid("bldg:lod1Solid", 0), "house") + members)


def shapes_of(model: CityModel) -> dict[str, tuple[str, int, float]]:
    """Type, polygons and the sum of all corners of every object, by id."""
    assert model.objects is not None
    polygons, found = model.polygons, {}
    owner = polygons.building if polygons.part is None else polygons.part
    points = np.diff(polygons.ring_starts[polygons.polygon_starts])
    sums = np.bincount(
        np.repeat(owner, points), (polygons.points + model.origin).sum(axis=1), len(model.objects)
    )
    counts = Counter(owner.tolist())
    for n, (name, type_) in enumerate(zip(model.objects.ids, model.objects.types, strict=True)):
        found[name] = (type_, counts[n], round(float(sums[n]), 2))
    return found


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_there_and_back(version: str, tmp_path: Path) -> None:
    model = parse_city_model(country().encode(), "a.gml", OPTIONS)
    done = convert_city(model, tmp_path / "b.gml", citygml=version)
    again = read_city_model(tmp_path / "b.gml", options=OPTIONS)
    assert shapes_of(again) == shapes_of(model)
    assert len(model.building_ids) == 11
    assert again.objects is not None
    named = zip(again.objects.ids, again.objects.attributes, strict=True)
    told = {name: values for name, values in named if values}
    assert told == {
        "Bridge": {"class": "1000"},
        "SolitaryVegetationObject": {"species": "1070", "height": 12.5},
    }
    left_out = "\n".join(done.left_out)
    assert "does not write" not in left_out
    if version == "2.0":
        assert_valid_gml(tmp_path / "b.gml")


@pytest.mark.parametrize("text", [town("2.0"), twin()], ids=["gml", "json"])
@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_every_layer_of_a_town(text: str, version: str, tmp_path: Path) -> None:
    model = parse_city_model(text.encode(), "a", OPTIONS)
    convert_city(model, tmp_path / "b.gml", citygml=version)
    again = read_city_model(tmp_path / "b.gml", options=OPTIONS)
    assert shapes_of(again) == shapes_of(model)
    if version == "2.0":
        assert_valid_gml(tmp_path / "b.gml")


def test_from_citygml_to_cityjson_and_back(tmp_path: Path) -> None:
    model = parse_city_model(country().encode(), "a.gml", OPTIONS)
    convert_city(model, tmp_path / "b.city.json")
    convert_city(read_city_model(tmp_path / "b.city.json", options=OPTIONS), tmp_path / "c.gml")
    assert shapes_of(read_city_model(tmp_path / "c.gml", options=OPTIONS)) == shapes_of(model)
    assert_valid_gml(tmp_path / "c.gml")
