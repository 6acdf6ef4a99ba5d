"""Bridges, tunnels, trees, roads, water and terrain as CityGML: valid, and the same when read again."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import CityModel, ReadOptions, parse_city_model, read_city_model
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.options import LAYERS

from .gml_text import box_rings, city, member, polygon, surface_members
from .test_citygml_writer import assert_valid
from .test_layers import town, twin

OPTIONS = ReadOptions(has_details=True, layers=tuple(LAYERS))
_MODULES = (
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


def solid(name: str, x: float, around: str = "{}") -> str:
    faces = surface_members(map(polygon, box_rings(500000.0 + 2 * x)))
    shell = f"<gml:CompositeSurface>{faces}</gml:CompositeSurface>"
    shape = f"<gml:Solid><gml:exterior>{shell}</gml:exterior></gml:Solid>"
    return f"<{name}>{around.format(shape)}</{name}>"


def country() -> str:
    """A house, and one object or more of every module, at the levels that each of them has."""
    spaces = " ".join(f'xmlns:{n[:4]}="http://www.opengis.net/citygml/{n}/2.0"' for n in _MODULES)
    wall = f"<brid:WallSurface>{multi('brid:lod2MultiSurface', 40)}</brid:WallSurface>"
    rail = (
        f"<brid:BridgeInstallation gml:id='rail'>{multi('brid:lod2Geometry', 30)}</brid:BridgeInstallation>"
    )
    span = f"<brid:BridgePart gml:id='span'>{solid('brid:lod1Solid', 50)}</brid:BridgePart>"
    tube = f"<tunn:HollowSpace gml:id='tube'>{multi('tunn:lod4MultiSurface', 70)}</tunn:HollowSpace>"
    tall = "<vege:species>1070</vege:species><vege:height uom='m'>12.5</vege:height>"
    objects = {
        "brid:Bridge": f"<brid:class>1000</brid:class>{solid('brid:lod1Solid', 20)}"
        f"<brid:outerBridgeInstallation>{rail}</brid:outerBridgeInstallation><brid:boundedBy>{wall}</brid:boundedBy>"
        f"<brid:consistsOfBridgePart>{span}</brid:consistsOfBridgePart>",
        "tunn:Tunnel": f"{multi('tunn:lod2MultiSurface', 60)}<tunn:interiorHollowSpace>{tube}"
        "</tunn:interiorHollowSpace>",
        "vege:SolitaryVegetationObject": tall + multi("vege:lod2Geometry", 80),
        "vege:PlantCover": multi("vege:lod1MultiSurface", 90),
        "city:CityFurniture": multi("city:lod1Geometry", 100),
        "tran:Road": multi("tran:lod1MultiSurface", 110),
        "tran:Square": multi("tran:lod2MultiSurface", 120),
        "wate:WaterBody": multi("wate:lod1MultiSurface", 130) + solid("wate:lod1Solid", 140),
        "land:LandUse": multi("land:lod0MultiSurface", 150),
        "gene:GenericCityObject": multi("gene:lod3Geometry", 160),
    }
    members = "".join(
        f"<core:cityObjectMember {spaces}><{name} gml:id='{name[5:]}'>{text}</{name}></core:cityObjectMember>"
        for name, text in objects.items()
    )
    return city(member(solid("bldg:lod1Solid", 0), "house") + members)


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
        assert_valid(tmp_path / "b.gml")


@pytest.mark.parametrize("text", [town("2.0"), twin()], ids=["gml", "json"])
@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_every_layer_of_a_town(text: str, version: str, tmp_path: Path) -> None:
    model = parse_city_model(text.encode(), "a", OPTIONS)
    convert_city(model, tmp_path / "b.gml", citygml=version)
    again = read_city_model(tmp_path / "b.gml", options=OPTIONS)
    assert shapes_of(again) == shapes_of(model)
    if version == "2.0":
        assert_valid(tmp_path / "b.gml")


def test_from_citygml_to_cityjson_and_back(tmp_path: Path) -> None:
    model = parse_city_model(country().encode(), "a.gml", OPTIONS)
    convert_city(model, tmp_path / "b.city.json")
    convert_city(read_city_model(tmp_path / "b.city.json", options=OPTIONS), tmp_path / "c.gml")
    assert shapes_of(read_city_model(tmp_path / "c.gml", options=OPTIONS)) == shapes_of(model)
    assert_valid(tmp_path / "c.gml")
