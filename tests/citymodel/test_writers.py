"""Cities written as CityGML and CityJSON: valid, complete, and read back as they were."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lodbench.citymodel import CityModel, ReadOptions, mesh_model, read_city_model
from lodbench.citymodel.convert import Conversion, convert_city
from lodbench.citymodel.gml.writer import srs_name
from lodbench.citymodel.options import LAYERS

from .gml_text import box_rings, city, member, multi_surface, polygon, solid_of, surface_members, write
from .schemas import FEATURE, assert_keeps_the_rules, assert_valid, assert_valid_gml
from .test_layers import twin
from .twins import documents

DETAILS = ReadOptions(has_details=True, is_strict=False)
# Parts and terrain lines; windows, doors and an address; rooms and furniture; ids and names in Japanese.
REAL = (
    "city/germany_lod2/LoD2_32_280_5657_1_NW.gml",
    "city/lod3_reference/fzk_haus_lod3_v2.gml",
    "city/lod3_reference/lod4_building_v2.gml",
    "city/plateau/52397519_bldg_6697_op.gml",
    "city/ingolstadt_lod3/4018155.xml",
    "city/vienna/vienna20_wrongcrs.jsonl",
)
_MILLIMETRE = 1e-3


def written(model: CityModel, path: Path, version: str) -> tuple[CityModel, Conversion]:
    done = convert_city(model, path, citygml=version)
    return read_city_model(path, options=DETAILS), done


def areas(model: CityModel) -> list[float]:
    return [mesh_model(model, lod).area_m2 for lod in model.lods]


def told_by(model: CityModel) -> list[str]:
    """Returns what is told of each object, as any version of CityGML gives it back: truth as text."""
    assert model.objects is not None
    kept = [{k: v for k, v in told.items() if k != "externalReference"} for told in model.objects.attributes]
    texts = [{k: str(v).lower() if isinstance(v, bool) else v for k, v in told.items()} for told in kept]
    return sorted(json.dumps(told, sort_keys=True) for told in texts)


@pytest.mark.parametrize("version", ["2.0", "3.0"])
@pytest.mark.parametrize("name", REAL)
def test_there_and_back(name: str, version: str, shared_data: Path, tmp_path: Path) -> None:
    model = read_city_model(shared_data / name, options=DETAILS)
    again, done = written(model, tmp_path / "a.gml", version)
    assert again.version == version
    assert len(again.building_ids) == len(model.building_ids)
    assert (again.num_parts, len(again.polygons)) == (model.num_parts, len(model.polygons))
    assert Counter(again.polygons.kind.tolist()) == Counter(model.polygons.kind.tolist())
    low = [np.min(one.polygons.points + one.origin, axis=0) for one in (model, again)]
    np.testing.assert_allclose(low[1], low[0], atol=_MILLIMETRE)
    assert areas(again) == pytest.approx(areas(model), rel=5e-6)
    if model.solids is not None and again.solids is not None:
        assert len(again.solids.part) == len(model.solids.part)
    assert model.objects is not None
    assert again.objects is not None
    assert Counter(again.objects.types) == Counter(model.objects.types)
    assert told_by(again) == told_by(model)
    assert not any("LoD" in line for line in done.left_out) or "lod4" in name
    if version == "2.0":
        assert_valid_gml(tmp_path / "a.gml")


@pytest.mark.parametrize("name", documents())
def test_what_a_town_of_every_format_becomes(name: str, tmp_path: Path) -> None:
    model = read_city_model(write(tmp_path / name, documents()[name]), options=DETAILS)
    again, _ = written(model, tmp_path / "a.gml", "2.0")
    assert again.building_ids == model.building_ids
    assert areas(again) == pytest.approx(areas(model), rel=1e-6)
    assert_valid_gml(tmp_path / "a.gml")


def test_attributes_of_every_shape(tmp_path: Path) -> None:
    told = {
        "name": "A & B < C", "function": ["1000", "1010"], "measuredHeight": 9.5, "storeysAboveGround": 3,
        "creationDate": "2020-01-31", "yearOfConstruction": "about 1900", "roofType": "1030",
        "count": 7, "ratio": 0.125, "odd name \"'é": "x", "set": {"inner": "1", "deeper": {"n": 2}},
        "list": ["a", "b"], "address": [{"CountryName": "D", "LocalityName": "Köln", "Floor": "2"}],
    }  # fmt: skip
    text = city(member(solid_of(box_rings())))
    model = read_city_model(write(tmp_path / "a.gml", text), options=DETAILS)
    assert model.objects is not None
    model.objects.attributes[0].update(told)
    for version in ("2.0", "3.0"):
        again, _ = written(model, tmp_path / "b.gml", version)
        assert again.objects is not None
        assert again.objects.attributes == (told,)
    written(model, tmp_path / "b.gml", "2.0")
    assert_valid_gml(tmp_path / "b.gml")


def test_what_cannot_be_said_is_told(tmp_path: Path) -> None:
    town = json.loads(twin())
    town["CityObjects"]["house"]["children"] = ["storey"]
    town["CityObjects"]["storey"] = {"type": "BuildingStorey", "parents": ["house"]}
    (tmp_path / "town.city.json").write_text(json.dumps(town))
    model = read_city_model(tmp_path / "town.city.json", options=DETAILS)
    again, done = written(model, tmp_path / "a.gml", "2.0")
    assert again.building_ids == ("house",)
    assert "BuildingStorey, which lodbench does not write as CityGML 2.0" in done.left_out


def test_storeys_and_units_of_citygml_3_come_back(tmp_path: Path) -> None:
    """Their names and attributes were gone without a word."""
    town, inside = json.loads(twin()), {"BuildingStorey": "first floor", "BuildingUnit": "flat 7"}
    town["CityObjects"]["house"]["children"] = list(inside)
    for type_, name in inside.items():
        town["CityObjects"][type_] = {"type": type_, "parents": ["house"], "attributes": {"name": name}}
    model = read_city_model(write(tmp_path / "town.json", json.dumps(town)), options=DETAILS)
    again, done = written(model, tmp_path / "a.gml", "3.0")
    assert again.objects is not None
    told = zip(again.objects.types, again.objects.attributes, strict=True)
    assert {type_: each["name"] for type_, each in told if type_ in inside} == inside
    assert done.left_out == ()


def test_names_of_reference_systems() -> None:
    assert srs_name(None) is None
    assert srs_name("EPSG:25832") == "http://www.opengis.net/def/crs/EPSG/0/25832"
    assert srs_name("EPSG:6677") == "EPSG:6677"  # north first, by its authority


# Text for numbers, several functions, rooms, LoD4, parts of several solids, refined levels, doors.
OF_CITYJSON = (
    "city/germany_lod2/LoD2_32_280_5657_1_NW.gml",
    "city/germany_lod2/LoD2_576_5950_1_HH_2016.xml",
    "city/lod3_reference/fzk_haus_lod3_v2.gml",
    "city/lod3_reference/lod4_building_v2.gml",
    "city/lod3_reference/lod2_buildings_v3.gml",
    "city/plateau/52397519_bldg_6697_op.gml",
    "city/ingolstadt_lod3/4018155.xml",
    "city/3dbag/tile_901_trimmed.jsonl",
    "city/vienna/vienna20_wrongcrs.jsonl",
    "city/switzerland/zurich-lod2-citygml1.xml",
)


@pytest.mark.parametrize("name", OF_CITYJSON)
def test_rules_and_there_and_back(name: str, shared_data: Path, tmp_path: Path) -> None:
    model = read_city_model(shared_data / name, options=DETAILS)
    target = tmp_path / "a.city.json"
    convert_city(model, target)
    document = json.loads(target.read_text())
    assert_keeps_the_rules(document)
    again = read_city_model(target, options=DETAILS)
    assert again.building_ids == model.building_ids
    assert model.objects is not None
    assert again.objects is not None
    assert Counter(again.objects.types) == Counter(model.objects.types)
    low = [np.min(one.polygons.points + one.origin, axis=0) for one in (model, again)]
    np.testing.assert_allclose(low[1], low[0], atol=1e-3)
    areas = [sum(mesh_model(one, lod).area_m2 for lod in one.lods) for one in (model, again)]
    assert areas[1] == pytest.approx(areas[0], rel=3e-5)  # corners are rounded to the millimetre


@pytest.mark.parametrize("ending", [".city.json", ".city.jsonl"])
@pytest.mark.parametrize("name", OF_CITYJSON)
def test_valid_by_the_published_schemas(name: str, ending: str, shared_data: Path, tmp_path: Path) -> None:
    target = tmp_path / f"a{ending}"
    convert_city(read_city_model(shared_data / name, options=replace(DETAILS, layers=tuple(LAYERS))), target)
    for line in target.read_text().splitlines():
        assert_valid(json.loads(line))


@pytest.mark.parametrize("name", OF_CITYJSON)
def test_another_program_reads_it(name: str, shared_data: Path, tmp_path: Path) -> None:
    other: Any = pytest.importorskip("cityjson_lib")
    model = read_city_model(shared_data / name, options=DETAILS)
    target = tmp_path / "a.city.json"
    convert_city(model, target)
    summary = other.CityModel.parse_document_bytes(target.read_bytes()).summary()
    assert model.objects is not None
    assert summary.cityobject_count == len(model.objects)


@pytest.mark.slow
def test_features_keep_the_rules(shared_data: Path, tmp_path: Path) -> None:
    model = read_city_model(shared_data / OF_CITYJSON[0], options=DETAILS)
    convert_city(model, tmp_path / "a.city.jsonl")
    head, *features = map(json.loads, (tmp_path / "a.city.jsonl").read_text().splitlines())
    assert_keeps_the_rules(head)
    for feature in features:
        assert_keeps_the_rules(feature, FEATURE)
    assert len(features) == len(model.building_ids)


def test_layers_keep_their_types(tmp_path: Path) -> None:
    (tmp_path / "town.city.json").write_text(twin())
    options = ReadOptions(has_details=True, layers=("bridges", "vegetation", "relief", "furniture"))
    model = read_city_model(tmp_path / "town.city.json", options=options)
    convert_city(model, tmp_path / "a.city.json")
    document = json.loads((tmp_path / "a.city.json").read_text())
    assert_keeps_the_rules(document)
    types = {name: item["type"] for name, item in document["CityObjects"].items()}
    assert types == {name: item["type"] for name, item in json.loads(twin())["CityObjects"].items()}


def test_planarity_is_told_as_when_meshed(tmp_path: Path) -> None:
    low, high, *walls = box_rings()
    bent = [(x, y, z + 0.2 * (n == 0)) for n, (x, y, z) in enumerate(high)]
    text = city(member(multi_surface(surface_members(map(polygon, [low, bent, *walls])))))
    model = read_city_model(write(tmp_path / "a.gml", text), options=DETAILS)
    for name in ("a.city.json", "b.gml", "a.obj"):
        found = convert_city(model, tmp_path / name).findings.counts()
        assert found["LB105 NOT_PLANAR"] == 1


def test_two_buildings_of_one_key(tmp_path: Path) -> None:
    text = twin().replace('"lamp": {"type": "CityFurniture"', '"house": {"type": "Building"')
    (tmp_path / "town.city.json").write_text(text)
    model = read_city_model(tmp_path / "town.city.json")
    assert model.building_ids == ("house", "house~2")
    assert model.findings.counts()["LB205 DUPLICATE_ID"] == 1
    assert mesh_model(model).area_m2 == pytest.approx(2 * (2 * 10 * 10 + 4 * 10 * 6))


def test_several_functions_are_told(tmp_path: Path) -> None:
    functions = "".join(f"<bldg:function>{code}</bldg:function>" for code in (1000, 2000))
    text = city(member(functions + multi_surface(surface_members(map(polygon, box_rings())))))
    model = read_city_model(write(tmp_path / "a.gml", text), options=DETAILS)
    done = convert_city(model, tmp_path / "a.city.json")
    assert done.left_out == ("several values of 'function' joined to one text, as CityJSON asks for",)
    told = json.loads((tmp_path / "a.city.json").read_text())["CityObjects"]["b1"]["attributes"]
    assert told["function"] == "1000, 2000"
