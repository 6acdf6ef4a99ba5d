"""Which axis stands first, where reference system and place leave it open: houses show their outside."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Transformer

from lodbench.citymodel import ReadOptions, read_city_model
from lodbench.citymodel.axis_order import faces_tell_north_first
from lodbench.citymodel.cleaning import clean_polygons
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.read import read_source
from lodbench.citymodel.source import open_sources

from .gml_text import Ring, box_rings, city, member, polygon, solid, surface_members, write

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
    text = city(member(solid(surface_members(map(polygon, placed)))), srs=code)
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
def test_footprints_and_roofs_alone_leave_it_open(tmp_path: Path, is_clockwise: bool, slope: float) -> None:
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
def test_a_name_that_promises_an_order_yields_to_many_houses(
    tmp_path: Path, name: str, count: int, told: list[float]
) -> None:
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
    text = city(member(solid(surface_members(map(polygon, inside_out)))), srs="EPSG:2157")
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
