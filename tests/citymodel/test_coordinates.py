"""Coordinates: digits, order of axes where reference system and place leave it open, heights in feet."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS, Transformer

from lodbench.citymodel import ReadOptions, read_city_model
from lodbench.citymodel.cleaning import clean_polygons
from lodbench.citymodel.convert import convert_city
from lodbench.citymodel.crs import require_crs
from lodbench.citymodel.derive import reproject
from lodbench.citymodel.gml.folding import parse_rings
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.polygons import faces_tell_north_first
from lodbench.citymodel.read import read_source
from lodbench.citymodel.source import open_sources
from lodbench.cli import main

from .gml_text import (
    Ring,
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

decimals = st.from_regex(r"\A[+-]?(\d{1,25}(\.\d{0,25})?|\.\d{1,20})([eE][+-]?\d{1,2})?\Z").filter(
    str.isascii
)


@pytest.mark.slow
@given(st.lists(st.lists(decimals, max_size=6), max_size=6))
def test_equals_float_to_the_last_bit(rings: list[list[str]]) -> None:
    values, counts, is_bad = parse_rings([" ".join(ring).encode() for ring in rings])
    assert counts.tolist() == [len(ring) for ring in rings]
    assert not is_bad.any()
    assert values.tolist() == [float(text) for ring in rings for text in ring]


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_repr_round_trip(value: float) -> None:
    assert parse_rings([repr(value).encode()])[0].tolist() == [value]


@given(st.lists(st.text(max_size=30), min_size=1, max_size=5))
def test_never_raises_and_counts_texts(texts: list[str]) -> None:
    values, counts, is_bad = parse_rings([text.encode("utf-8", "surrogatepass") for text in texts])
    assert len(counts) == len(is_bad) == len(texts)
    assert counts.sum() == len(values)


@pytest.mark.parametrize(
    "text",
    ["nan", "inf", "-Infinity", "1e400", "1_000", "٣", "1.2.3", "1,5", "--1", "1e", ".", "0x10", "1;2", "+"],
)
def test_refuses_what_is_no_plain_finite_decimal(text: str) -> None:
    values, _, is_bad = parse_rings([b"1 2 3", text.encode(), b"4 5"])
    assert is_bad.tolist() == [False, True, False]
    assert values[:3].tolist() == [1, 2, 3]
    assert values[-2:].tolist() == [4, 5]


def test_white_space_of_every_kind() -> None:
    assert parse_rings([b" 1\t2\r\n3 ", b"", b"\n"])[0].tolist() == [1, 2, 3]
    assert parse_rings([])[1].tolist() == []
    assert np.isclose(parse_rings([b"35.75599827822895"])[0][0], 35.75599827822895, rtol=0, atol=0)


# Longitude and latitude, and a system that declares northings first, in whose area both orders lie.
PLACES = {"EPSG:4326": (31.24, 30.04), "EPSG:2180": (21.01, 52.23), "EPSG:2326": (114.16, 22.28)}


def read_box(
    folder: Path, code: str, is_north_first: bool, rings: list[Ring], options: ReadOptions | None = None
) -> tuple[CityModel, np.ndarray, list[str]]:
    """Returns a city of some faces of a box, where it lies (longitude, latitude), and what was found."""
    longitude, latitude = PLACES[code]
    utm = CRS(f"EPSG:{32601 + int((longitude + 180) // 6)}")
    east, north = Transformer.from_crs(4326, utm, always_xy=True).transform(longitude, latitude)
    to_file = Transformer.from_crs(utm, code, always_xy=True)
    placed = []
    for ring in rings:
        x, y = to_file.transform(*np.transpose([(east + p[0], north + p[1]) for p in ring]))
        columns = (y, x) if is_north_first else (x, y)
        placed.append([(float(a), float(b), p[2]) for a, b, p in zip(*columns, ring, strict=True)])
    text = city(member(solid_of(placed)), srs=code)
    model = read_city_model(write(folder / "a.gml", text), options=options)
    middle = model.polygons.points[:, :2].mean(axis=0) + model.origin[:2]
    found = Transformer.from_crs(model.crs, 4326, always_xy=True).transform(*middle)
    return model, np.array(found), [item.code.name for item in model.findings.items]


BOX = box_rings(x=0.0, y=0.0, z=20.0)


@pytest.mark.parametrize("is_north_first", [False, True])
@pytest.mark.parametrize("code", PLACES)
@pytest.mark.parametrize("faces", [BOX, BOX[1:], BOX[2:]], ids=["closed", "no floor", "walls"])
def test_either_order_is_found(tmp_path: Path, code: str, is_north_first: bool, faces: list[Ring]) -> None:
    _, found, codes = read_box(tmp_path, code, is_north_first, faces)
    assert found == pytest.approx(PLACES[code], abs=2e-3)
    assert ("AXES_SWAPPED" in codes) is not is_north_first
    assert "AXES_AMBIGUOUS" not in codes


def test_faces_that_tell_nothing_leave_it_open(tmp_path: Path) -> None:
    mixed = [ring if n % 2 else ring[::-1] for n, ring in enumerate(BOX)]
    _, found, codes = read_box(tmp_path, "EPSG:2180", False, mixed)
    assert found == pytest.approx(PLACES["EPSG:2180"], abs=2e-3)
    assert "AXES_AMBIGUOUS" in codes


@pytest.mark.parametrize("slope", [0.0, 0.2])
@pytest.mark.parametrize("is_clockwise", [False, True])
def test_footprints_and_roofs_alone_leave_it_open(tmp_path, is_clockwise, slope):
    # As outlines of a Shapefile, which run clockwise, or draped over a slope.
    flat = [[(x, y, z + slope * x) for x, y, z in ring] for ring in BOX[:2]]
    faces = [ring[::-1] for ring in flat] if is_clockwise else flat
    for kinds in (faces, faces[1:]):
        _, found, codes = read_box(tmp_path, "EPSG:2180", False, kinds)
        assert found == pytest.approx(PLACES["EPSG:2180"], abs=2e-3)
        assert "AXES_AMBIGUOUS" in codes


def test_what_the_user_says_goes_before_the_faces(tmp_path: Path) -> None:
    inside_out = [ring[::-1] for ring in BOX]
    _, found, _ = read_box(tmp_path, "EPSG:4326", True, inside_out, ReadOptions(axis_order="north_first"))
    assert found == pytest.approx(PLACES["EPSG:4326"], abs=2e-3)


@pytest.mark.parametrize("name", ["urn:ogc:def:crs:EPSG::{}", "http://www.opengis.net/def/crs/EPSG/0/{}"])
@pytest.mark.parametrize(("count", "told"), [(1, [637000.0, 486000.0]), (12, [486000.0, 637000.0])])
def test_a_name_that_promises_an_order_yields_to_many_houses(tmp_path, name, count, told):
    # Northing first as EPSG:2180 has it, and all faces inside: one house is drawn badly, many are mirrored.
    boxes = [box_rings(x=637000.0 + 20 * n, y=486000.0) for n in range(count)]
    text = "".join(
        member(
            solid(surface_members(polygon([(y, x, z) for x, y, z in ring[::-1]]) for ring in box)), f"b{n}"
        )
        for n, box in enumerate(boxes)
    )
    model = read_city_model(write(tmp_path / "a.gml", city(text, srs=name.format(2180))))
    assert model.origin[:2].tolist() == told
    (found,) = [item for item in model.findings.items if item.code.name == "AXES_AMBIGUOUS"]
    assert found.detail.endswith("say axis_order")


def test_a_system_that_declares_eastings_first_asks_no_faces(tmp_path: Path) -> None:
    inside_out = [[(p[0] + 5e5, p[1] + 6e5, p[2]) for p in ring[::-1]] for ring in BOX]
    text = city(member(solid_of(inside_out)), srs="EPSG:2157")
    model = read_city_model(write(tmp_path / "a.gml", text))
    assert model.origin[:2].tolist() == [500000.0, 600000.0]


@pytest.mark.parametrize(
    ("path", "is_north_first"),
    [
        ("plateau/52397519_bldg_6697_op.gml", True),
        ("plateau/64413325_bldg_6697_op.gml", True),
        ("germany_lod2/LoD2_32_280_5657_1_NW.gml", False),
        ("germany_lod2/berlin_open_data_sample_data.citygml", False),
        ("3dbag/tile_901_trimmed.jsonl", False),
        ("netherlands_other/3-20-DELFSHAVEN.city.json", False),
        ("switzerland/zurich-lod2-citygml1.xml", False),
        ("vienna/vienna20_wrongcrs.jsonl", False),
        ("misc/montreal_b4.city.jsonl", False),
    ],
)
def test_published_files_tell(shared_data: Path, path: str, is_north_first: bool) -> None:
    (source,) = open_sources(shared_data / "city" / path, ())
    polygons, _ = clean_polygons(read_source(source, ReadOptions(is_strict=False)))
    assert faces_tell_north_first(polygons) is is_north_first


US_FOOT_M = 1200 / 3937


@pytest.mark.parametrize(
    ("crs", "corner", "label"),
    [
        ("EPSG:26918+6360", (585000.0, 4511000.0, 30.0), "EPSG:26918+5703"),
        ("EPSG:2263+6360", (983000.0, 199000.0, 30.0), "EPSG:26918+5703"),
        ("EPSG:2263+5702", (983000.0, 199000.0, 30.0), "EPSG:26918+7968"),
    ],
)
@pytest.mark.parametrize("suffix", [".gml", ".obj", ".json"])
def test_there_and_back(tmp_path, crs, corner, label, suffix):
    shift = np.subtract(corner, box_rings()[0][0])
    faces = [[tuple((shift + point).tolist()) for point in ring] for ring in box_rings()]
    text = city(member(solid(surface_members(polygon(face) for face in faces))), srs=crs)
    model = model_of(tmp_path, text)
    heights = np.unique([p[2] for face in faces for p in face]) * US_FOOT_M
    target = tmp_path / f"back{suffix}"
    convert_city(model, target)
    back = read_city_model(target)
    for each in (model, back):
        z = each.polygons.points[:, 2] + each.origin[2]
        assert np.unique(z.round(3)) == pytest.approx(heights, abs=2e-3)
    assert model.crs == label
    assert back.crs == (label.partition("+")[0] if suffix == ".json" else label)


def test_a_target_in_feet_is_named_by_its_metres(tmp_path: Path) -> None:
    text = city(member(solid(surface_members(polygon(face) for face in box_rings()))), srs="EPSG:25832+7837")
    assert reproject(model_of(tmp_path, text), "EPSG:32632+8228").crs == "EPSG:32632+5703"


def test_heights_in_feet_without_a_name_in_metres_lose_theirs() -> None:
    assert require_crs("EPSG:26918+6130").metric_label == "EPSG:26918"
    assert require_crs("EPSG:25832+7837").metric_label == "EPSG:25832+7837"


def test_heights_that_stay_are_given_no_other_name(tmp_path, capsys):
    text = city(member(solid(surface_members(polygon(face) for face in box_rings()))), srs="EPSG:25832+7837")
    source, target = write(tmp_path / "a.gml", text), tmp_path / "b.gml"
    assert main(["city", "convert", str(source), str(target), "--to-crs", "EPSG:25833+5783"]) == 2
    assert "--to-crs EPSG:25833." in capsys.readouterr().err
    assert not target.exists()
    for crs in ("EPSG:25833", "EPSG:25833+7837"):
        assert main(["city", "convert", str(source), "-o", str(target), "--to-crs", crs]) == 0
        assert read_city_model(target).crs == "EPSG:25833+7837"
