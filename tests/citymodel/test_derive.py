"""Parts of a city: buildings by id, place and attribute; another reference system."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from lodbench.citymodel import ReadOptions, mesh_model, read_city_model
from lodbench.citymodel.convert import cut_into_tiles
from lodbench.citymodel.derive import choose_buildings, reproject
from lodbench.citymodel.model import CityModel
from lodbench.cli import main
from lodbench.errors import CityModelError

from .gml_text import box_area, box_city, box_rings, city, member, solid_of, write


@pytest.fixture
def row(tmp_path: Path) -> CityModel:
    """Three boxes 20 m apart; the second is a church."""
    members = "".join(
        member(
            f"<bldg:function>{'church' if n == 1 else 'house'}</bldg:function>"
            + solid_of(box_rings(x=500000.0 + 20 * n)),
            f"b{n}",
        )
        for n in range(3)
    )
    text = city(members, srs="EPSG:25832+7837")
    return read_city_model(write(tmp_path / "a.gml", text), options=ReadOptions(has_details=True))


def test_by_id_place_and_attribute(row: CityModel) -> None:
    assert choose_buildings(row, ids=["b2", "b0"]).building_ids == ("b0", "b2")
    box = (500015.0, 5600000.0, 500100.0, 5600010.0)
    assert choose_buildings(row, bbox=box).building_ids == ("b1", "b2")
    church = choose_buildings(row, where=[("function", "church")], bbox=box)
    assert church.building_ids == ("b1",)
    assert mesh_model(church).area_m2 == pytest.approx(box_area())
    assert church.solids is not None
    assert church.solids.faces.tolist() == list(range(6))
    assert church.objects is not None
    assert church.objects.attributes == ({"function": "church"},)


def test_what_is_not_there(row: CityModel) -> None:
    with pytest.raises(CityModelError, match="no building 'b9'"):
        choose_buildings(row, ids=["b9"])
    with pytest.raises(CityModelError, match="No building fulfils"):
        choose_buildings(row, where=[("function", "mill")])
    with pytest.raises(CityModelError, match="No building fulfils") as fault:
        choose_buildings(row, bbox=(5.87, 51.02, 5.88, 51.03))
    # Whoever gave degrees sees what is wanted.
    assert re.search(r"lie in 5000\d\d 56000\d\d 5000\d\d 56000\d\d, in EPSG:25832\+7837", fault.value.hint)
    # The rectangle is not at fault where buildings lie in it.
    with pytest.raises(CityModelError, match="No building fulfils") as fault:
        choose_buildings(row, where=[("function", "mill")], bbox=(499000.0, 5600000.0, 501000.0, 5601000.0))
    assert fault.value.hint == "See what there is: lodbench city info FILE."
    with pytest.raises(CityModelError, match="No building has an attribute 'use'"):
        choose_buildings(row, where=[("use", "mill")])


def test_reprojection(row: CityModel) -> None:
    other = reproject(row, "EPSG:31467")
    assert other.crs == "EPSG:31467+7837"
    placed, before = other.polygons.points + other.origin, row.polygons.points + row.origin
    transformer = Transformer.from_crs(25832, 31467, always_xy=True)
    expected = np.stack(transformer.transform(before[:, 0], before[:, 1]), axis=1)
    assert np.allclose(placed[:, :2], expected, atol=1e-6)
    assert np.array_equal(placed[:, 2], before[:, 2])
    assert not other.findings.counts()
    with pytest.raises(CityModelError, match="is not in metres"):
        reproject(row, "EPSG:4326")


def test_a_target_that_is_not_made_for_the_place_is_told_or_refused(row: CityModel) -> None:
    other = reproject(row, "EPSG:25834")
    assert list(other.findings.counts()) == ["LB303 CRS_IMPLAUSIBLE", "LB309 SCALE_OFF"]
    assert not row.findings.counts()
    # Mercator of the whole world: a metre on the ground is 1.6 of its metres there.
    with pytest.raises(CityModelError, match="A metre of EPSG:3857 is off") as caught:
        reproject(row, "EPSG:3857")
    assert "EPSG:32632" in caught.value.hint


NRW = "city/germany_lod2/LoD2_32_280_5657_1_NW.gml"


@pytest.mark.parametrize("ending", [".gml", ".city.json"])
def test_tiles_hold_all_and_read_as_one(ending: str, shared_data: Path, tmp_path: Path) -> None:
    words = [
        "city",
        "convert",
        str(shared_data / NRW),
        str(tmp_path / f"tiles/town{ending}"),
        "--tiles",
        "200",
    ]
    assert main(words) == 0
    index = json.loads((tmp_path / "tiles/town.geojson").read_text())
    files = [feature["properties"]["file"] for feature in index["features"]]
    assert sorted(files) == sorted(p.name for p in (tmp_path / "tiles").iterdir() if p.suffix != ".geojson")
    whole = read_city_model(shared_data / NRW)
    again = read_city_model([tmp_path / "tiles" / name for name in files])
    assert set(again.building_ids) == set(whole.building_ids)
    assert sum(f["properties"]["buildings"] for f in index["features"]) == len(whole.building_ids)
    assert mesh_model(again).area_m2 == pytest.approx(mesh_model(whole).area_m2, rel=1e-5)
    for feature in index["features"]:
        assert 50 < feature["geometry"]["coordinates"][0][0][1] < 52  # latitudes
        west, south, east, north = feature["properties"]["bbox"]
        tile = read_city_model(tmp_path / "tiles" / feature["properties"]["file"])
        middle = np.median(tile.polygons.points, axis=0) + tile.origin
        assert west - 50 < middle[0] < east + 50
        assert south - 50 < middle[1] < north + 50


def test_tiles_are_read_by_their_folder_or_its_archive_whose_index_is_no_footprints(tmp_path: Path) -> None:
    town = write(tmp_path / "town.gml", box_city())
    assert main(["city", "convert", str(town), str(tmp_path / "tiles/t.gml"), "--tiles", "100"]) == 0
    assert json.loads((tmp_path / "tiles/t.geojson").read_text())["lodbench"] == "tile index"
    packed = shutil.make_archive(str(tmp_path / "packed"), "zip", tmp_path / "tiles")
    for place in (tmp_path / "tiles", packed):
        model = read_city_model(place)
        assert model.building_ids == ("b1",)
        assert model.findings.counts() == {}


def test_files_become_one(tmp_path: Path) -> None:
    first = write(tmp_path / "a.gml", box_city())
    second = write(tmp_path / "b.gml", box_city(x=500100.0).replace('"b1"', '"b2"'))
    target = tmp_path / "both.city.json"
    assert main(["city", "convert", str(first), str(second), "-o", str(target)]) == 0
    assert read_city_model(target).building_ids == ("b1", "b2")
    assert (
        main(["city", "convert", str(first), str(second), str(tmp_path / "c.gml"), "--citygml", "3.0"]) == 0
    )
    assert read_city_model(tmp_path / "c.gml").version == "3.0"


def test_a_side_of_nothing(tmp_path: Path) -> None:
    model = read_city_model(write(tmp_path / "a.gml", box_city()))
    for side in (0.0, -5.0, 0.5):
        with pytest.raises(CityModelError, match="is none"):
            cut_into_tiles(model, side)


def test_tiles_of_an_earlier_cut_are_not_left_among_new_ones(shared_data, tmp_path, capsys):
    """Buildings stood twice in the folder, which is read as one city."""
    words = ["city", "convert", str(shared_data / NRW), str(tmp_path / "town.gml"), "--tiles"]
    assert [main([*words, "300"]) for _ in range(2)] == [0, 0]
    before = sorted(tmp_path.iterdir())
    assert main([*words, "200"]) == 2
    assert "tiles of an earlier cut lie beside" in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def test_the_index_replaces_no_footprints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "town.gml", box_city())
    houses = tmp_path / "t.geojson"
    houses.write_text('{"type": "FeatureCollection", "features": []}')
    words = ["city", "convert", str(tmp_path / "town.gml"), str(tmp_path / "t.json"), "--tiles", "100"]
    assert main(words) == 2
    assert "t.geojson is there already, and is no index" in capsys.readouterr().err
    assert houses.read_text() == '{"type": "FeatureCollection", "features": []}'
    assert len(list(tmp_path.iterdir())) == 2
