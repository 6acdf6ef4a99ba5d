"""CityJSON written: by the rules of the specification, for another program, and the same city read again."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lodbench.citymodel import ReadOptions, mesh_model, read_city_model
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.options import LAYERS

from .cityjson_rules import FEATURE, assert_keeps_the_rules
from .gml_text import box_rings, city, member, multi_surface, polygon, surface_members, write
from .published_schemas import assert_valid
from .test_layers import twin

DETAILS = ReadOptions(has_details=True, is_strict=False)
# Text for numbers, several functions, rooms, LoD4, parts of several solids, refined levels, doors.
REAL = (
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


@pytest.mark.parametrize("name", REAL)
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
@pytest.mark.parametrize("name", REAL)
def test_valid_by_the_published_schemas(name: str, ending: str, shared_data: Path, tmp_path: Path) -> None:
    target = tmp_path / f"a{ending}"
    convert_city(read_city_model(shared_data / name, options=replace(DETAILS, layers=tuple(LAYERS))), target)
    for line in target.read_text().splitlines():
        assert_valid(json.loads(line))


@pytest.mark.parametrize("name", REAL)
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
    model = read_city_model(shared_data / REAL[0], options=DETAILS)
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
