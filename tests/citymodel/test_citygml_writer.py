"""CityGML written: valid by the official schemas, and the same city when it is read again."""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import CityModel, ReadOptions, mesh_model, read_city_model
from lodbench.citymodel.convert import Conversion, convert_city
from lodbench.citymodel.gml.writer import srs_name

from .gml_text import box_rings, city, member, solid_of, write
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


def assert_valid(path: Path) -> None:
    """By the official schemas of CityGML 2.0, GML 3.1.1 and xAL 2.0."""
    schema = pytest.importorskip("citysmith.schema", reason="it brings the official schemas")
    report = schema.validate_schema(str(path))
    assert report.valid, report.messages[:3]


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
        assert_valid(tmp_path / "a.gml")


@pytest.mark.parametrize("name", documents())
def test_what_a_town_of_every_format_becomes(name: str, tmp_path: Path) -> None:
    model = read_city_model(write(tmp_path / name, documents()[name]), options=DETAILS)
    again, _ = written(model, tmp_path / "a.gml", "2.0")
    assert again.building_ids == model.building_ids
    assert areas(again) == pytest.approx(areas(model), rel=1e-6)
    assert_valid(tmp_path / "a.gml")


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
    assert_valid(tmp_path / "b.gml")


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
