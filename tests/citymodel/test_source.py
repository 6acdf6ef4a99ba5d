"""Files, archives and folders as cities, and what is known of their publishers."""

import gzip
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from lodbench.citymodel import ReadOptions, mesh_city, read_city_model
from lodbench.citymodel.checks.report import check_city, findings_geojson
from lodbench.datasets.exchange.geojson import write_geojson
from lodbench.errors import CityModelError, ConfigError

from .gml_text import box_city, box_rings, city, member, polygon, solid, solid_of, surface_members, write
from .twins import cityjson, cityjsonseq

BOX = box_city().encode()


def second_box() -> bytes:
    rings = box_rings(x=500100.0)
    return city(member(solid_of(rings), "b2")).encode()


class TestGzip:
    def test_reads(self, tmp_path: Path) -> None:
        path = write(tmp_path / "city.gml.gz", gzip.compress(BOX))
        assert len(read_city_model(path).polygons) == 6

    def test_by_content_whatever_its_name(self, tmp_path: Path) -> None:
        path = write(tmp_path / "city", gzip.compress(json.dumps(cityjson("2.0")).encode()))
        assert read_city_model(path).format == "CityJSON"

    def test_truncated(self, tmp_path: Path) -> None:
        path = write(tmp_path / "city.gml.gz", gzip.compress(BOX * 50)[:-40])
        with pytest.raises(CityModelError, match=r"damaged or cut off|well-formed"):
            read_city_model(path)

    def test_damaged(self, tmp_path: Path) -> None:
        data = bytearray(gzip.compress(BOX))
        data[40:60] = bytes(20)
        with pytest.raises(CityModelError, match=r"damaged|well-formed"):
            read_city_model(write(tmp_path / "city.gml.gz", bytes(data)))

    def test_bomb(self, tmp_path: Path) -> None:
        text = BOX.replace(b"</core:CityModel>", b" " * (40 << 20) + b"</core:CityModel>")
        with pytest.raises(CityModelError, match="expands more than"):
            read_city_model(write(tmp_path / "city.gml.gz", gzip.compress(text)))


@pytest.mark.parametrize("name", ["a.gml", "a.json", "a.obj", "a.gml.gz"])
def test_progress_reaches_the_end(tmp_path: Path, name: str) -> None:
    content = {
        "a.gml": BOX,
        "a.json": cityjsonseq().encode(),
        "a.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        "a.gml.gz": gzip.compress(BOX),
    }[name]
    steps: list[tuple[int, int]] = []
    read_city_model(write(tmp_path / name, content), progress=lambda done, total: steps.append((done, total)))
    assert [done for done, _ in steps] == sorted(done for done, _ in steps)
    if name.endswith("gz"):
        assert steps[-1][0] >= len(BOX)
        assert steps[-1][1] == 0
    else:
        assert steps[-1] == (len(content), len(content))


class TestZip:
    def archive(self, tmp_path: Path, members: dict[str, bytes]) -> Path:
        path = tmp_path / "Stadt (1).zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, data in members.items():
                archive.writestr(name, data)
        return path

    def test_tiles_become_one_city(self, tmp_path: Path) -> None:
        model = read_city_model(
            self.archive(
                tmp_path,
                {"a/1.gml": BOX, "a/2.gml": second_box(), "readme.txt": b"x", "codelists/c.xml": b"<a/>"},
            )
        )
        assert model.building_ids == ("b1", "b2")
        assert model.polygons.points[:, 0].max() == 110

    def test_a_shared_building_is_told(self, tmp_path: Path) -> None:
        model = read_city_model(self.archive(tmp_path, {"1.gml": BOX, "2.gml": BOX}))
        assert model.findings.counts() == {"LB205 DUPLICATE_ID": 1}

    @pytest.mark.parametrize(
        "name", ["../evil.gml", "/etc/evil.gml", "a/../../b.gml", "..\\evil.gml", "C:/x.gml"]
    )
    def test_unsafe_paths(self, tmp_path: Path, name: str) -> None:
        with pytest.raises(CityModelError, match="unsafe path"):
            read_city_model(self.archive(tmp_path, {name: BOX}))

    def test_archives_inside_are_told(self, tmp_path: Path) -> None:
        """Publishers pack tiles twice: those were missing from the city without a word."""
        members = {"a.gml": BOX, "tiles/b.zip": b"PK", "__MACOSX/tiles/._b.zip": b"PK"}
        path = self.archive(tmp_path, members)
        model = read_city_model(path)
        told = [item for item in model.findings.items if item.code.number == 211]
        assert [item.object_id for item in told] == [f"{path}!tiles/b.zip"]
        assert "not read" in told[0].detail

    def test_nothing_inside(self, tmp_path: Path) -> None:
        with pytest.raises(CityModelError, match="no city file") as caught:
            read_city_model(self.archive(tmp_path, {"inner.zip": b"PK"}))
        assert "outer" in caught.value.hint

    def test_bomb(self, tmp_path: Path) -> None:
        text = BOX.replace(b"</core:CityModel>", b" " * (40 << 20) + b"</core:CityModel>")
        with pytest.raises(CityModelError, match="expands more than"):
            read_city_model(self.archive(tmp_path, {"a.gml": text}))

    def test_truncated(self, tmp_path: Path) -> None:
        path = self.archive(tmp_path, {"a.gml": BOX})
        path.write_bytes(path.read_bytes()[:-30])
        with pytest.raises(CityModelError, match="no readable zip"):
            read_city_model(path)

    def test_damaged_member(self, tmp_path: Path) -> None:
        path = self.archive(tmp_path, {"a.gml": BOX})
        data = bytearray(path.read_bytes())
        data[60:90] = bytes(30)
        path.write_bytes(bytes(data))
        with pytest.raises(CityModelError, match=r"damaged|well-formed"):
            read_city_model(path)


class TestFolder:
    def test_buildings_part_of_a_plateau_delivery(self, tmp_path: Path) -> None:
        for name, data in {
            "udx/bldg/1.gml": BOX,
            "udx/bldg/2.gml": second_box(),
            "udx/tran/3.gml": BOX,
        }.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        assert read_city_model(tmp_path).building_ids == ("b1", "b2")

    def test_other_files_are_passed_over_and_told(self, tmp_path: Path) -> None:
        write(tmp_path / "1.gml", BOX)
        write(tmp_path / "2.json", b'{"type": "FeatureCollection"}')
        write(tmp_path / "3.xml", city("").encode())
        write(tmp_path / "notes.txt", b"hello")
        model = read_city_model(tmp_path)
        assert model.findings.counts() == {"LB211 FILE_SKIPPED": 2}

    def test_results_of_one_s_own_are_no_footprints(self, tmp_path: Path) -> None:
        """``localize --city .`` wrote them beside the tiles, and could not read the city again."""
        write(tmp_path / "1.gml", BOX)
        (tmp_path / "localized").mkdir()
        square = {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]}
        feature = {"type": "Feature", "geometry": square, "properties": {}}
        write_geojson([feature], tmp_path / "localized" / "a.geojson")
        findings = findings_geojson(check_city(read_city_model(tmp_path)))
        write(tmp_path / "findings.geojson", json.dumps(findings).encode())
        assert read_city_model(tmp_path).findings.counts() == {}

    def test_footprints_of_nothing_are_passed_over_and_told(self, tmp_path: Path) -> None:
        """A tile of the woods has no houses; nor has it, often, any column."""
        pytest.importorskip("pyogrio")
        write(tmp_path / "1.gml", BOX)
        write(tmp_path / "2.geojson", b'{"type": "FeatureCollection", "features": []}')
        assert read_city_model(tmp_path).findings.counts() == {"LB211 FILE_SKIPPED": 1}
        with pytest.raises(CityModelError, match=r"2\.geojson has no footprints"):
            read_city_model(tmp_path / "2.geojson")

    def test_an_archive_of_other_things_is_passed_over_and_told(self, tmp_path: Path) -> None:
        write(tmp_path / "1.gml", BOX)
        with zipfile.ZipFile(tmp_path / "nothing.zip", "w") as archive:
            archive.writestr("readme.txt", "hello")
        model = read_city_model(tmp_path)
        assert model.building_ids == ("b1",)
        assert model.findings.counts() == {"LB211 FILE_SKIPPED": 1}
        (tmp_path / "1.gml").unlink()
        with pytest.raises(CityModelError, match=r"nothing\.zip holds no city file"):
            read_city_model(tmp_path)
        with zipfile.ZipFile(tmp_path / "outer.zip", "w") as archive:
            archive.writestr("tiles.zip", "PK")
        with pytest.raises(CityModelError, match=r"outer\.zip holds no city file"):
            read_city_model(tmp_path)

    def test_different_formats_and_levels_merge(self, tmp_path: Path) -> None:
        write(tmp_path / "1.gml", BOX)
        write(tmp_path / "2.json", json.dumps(cityjson("2.0")))
        model = read_city_model(tmp_path)
        assert model.lods == ("1", "3")
        assert len(model.building_ids) == 4
        # Rings that end with their first point are as right in one as rings that do not in the other.
        assert model.findings.counts() == {}

    @pytest.mark.parametrize("footprints", ["1.geojson", "3.geojson"])
    @pytest.mark.parametrize("crs", [None, "EPSG:6697"])
    def test_each_format_keeps_its_axis_order(self, tmp_path: Path, footprints: str, crs: str | None) -> None:
        """CityGML in degrees begins with the latitude, GeoJSON with the longitude, whichever is first."""
        pytest.importorskip("pyogrio")
        lon, lat, size = 139.55, 35.75, 1e-4
        faces = [
            [(lat + y / 10 * size, lon + x / 10 * size, z) for x, y, z in ring] for ring in box_rings(0, 0, 0)
        ]
        text = city(member(solid_of(faces)), srs="EPSG:6697")
        write(tmp_path / "2.gml", text)
        ring = [[lon, lat], [lon + size, lat], [lon + size, lat + size], [lon, lat + size], [lon, lat]]
        shape = {"type": "Polygon", "coordinates": [ring]}
        feature = {"type": "Feature", "properties": {"height": 6}, "geometry": shape}
        write(tmp_path / footprints, json.dumps({"type": "FeatureCollection", "features": [feature]}))
        model = read_city_model(tmp_path, crs=crs)
        low, high = mesh_city(model).extent_m
        assert np.abs(low[:2]).max() < 2
        assert np.abs(high - low - (9.0, 11.1, 6.0)).max() < 0.5  # grid north, two datums

    def test_empty(self, tmp_path: Path) -> None:
        with pytest.raises(CityModelError, match="holds no city file"):
            read_city_model(tmp_path)

    def test_only_others(self, tmp_path: Path) -> None:
        write(tmp_path / "1.json", b'{"a": 1}')
        with pytest.raises(CityModelError, match="not CityJSON"):
            read_city_model(tmp_path)


@pytest.mark.parametrize("suffix", [".gml", ".gpkg", ".ply", ".obj", ".shp"])
@pytest.mark.parametrize("is_packed", [True, False])
def test_what_macos_leaves_beside_tiles_is_passed_over(tmp_path: Path, suffix: str, is_packed: bool) -> None:
    files = {"tile.gml": BOX, f"__MACOSX/._tile{suffix}": b"\0\5\x16\7\0\2\0\0Mac OS X        "}
    path = tmp_path / "town"
    if is_packed:
        path = tmp_path / "town.zip"
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in files.items():
                archive.writestr(name, data)
    else:
        for name, data in files.items():
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_bytes(data)
    model = read_city_model(path)
    assert len(model.polygons) == 6
    assert model.findings.counts() == {}


_ROOT = Path(__file__).resolve().parents[2]
_PROFILES = sorted((_ROOT / "conf" / "source").glob("*.yaml"))


def profile(name: str) -> dict[str, Any]:
    return yaml.safe_load((_ROOT / "conf" / "source" / f"{name}.yaml").read_text())  # type: ignore[no-any-return]


def test_all_sources_are_there() -> None:
    assert {path.stem for path in _PROFILES} == {
        "plateau", "swissbuildings3d", "threedbag", "open_city_model", "adv_lod1", "adv_lod2", "clsm",
        "gable", "folder",
    }  # fmt: skip


@pytest.mark.parametrize("path", _PROFILES, ids=[path.stem for path in _PROFILES])
def test_profile_and_card(path: Path) -> None:
    values = yaml.safe_load(path.read_text())
    assert set(values) == {"name", "lod", "options"}
    assert values["name"] == path.stem
    assert values["lod"] is None or isinstance(values["lod"], str)
    ReadOptions.from_mapping(values["options"])
    card = (_ROOT / "data_cards" / f"{path.stem}.md").read_text()
    head = yaml.safe_load(card.split("---")[1])
    assert set(head) == {"id", "kind", "title", "publisher", "licence", "format", "lods", "crs"}
    assert head["id"] == path.stem
    assert all(head[key] for key in ("title", "publisher", "licence", "format", "crs"))
    assert "## How to get it" in card
    assert "## What to know" in card


class TestFromMapping:
    def test_unknown_names_get_a_hint(self) -> None:
        with pytest.raises(ConfigError, match="heigth_column") as caught:
            ReadOptions.from_mapping({"heigth_column": "h"})
        assert "height_column" in caught.value.hint

    @pytest.mark.parametrize(
        "values",
        [
            {"sunk_m": "3"},
            {"is_strict": 1},
            {"origin": [1, 2]},
            {"origin": ["a", 1, 2]},
            {"ground_m": math.nan},
        ],
    )
    def test_wrong_types(self, values: dict[str, Any]) -> None:
        with pytest.raises(ConfigError, match="wrong type"):
            ReadOptions.from_mapping(values)

    def test_unknown_words(self) -> None:
        with pytest.raises(ConfigError, match="axis_order=east is unknown") as caught:
            ReadOptions.from_mapping({"axis_order": "east"})
        assert "east_first" in caught.value.hint

    def test_a_column_may_be_called_by_a_number(self) -> None:
        assert ReadOptions.from_mapping({"height_column": 2020}).height_column == "2020"

    def test_values(self) -> None:
        options = ReadOptions.from_mapping({"origin": [1, 2, 3], "ground_m": 4, "terrain": "a.asc"})
        assert (options.origin, options.ground_m, options.terrain) == ((1.0, 2.0, 3.0), 4.0, "a.asc")


def test_open_city_model_as_published(tmp_path: Path) -> None:
    """Longitude first under EPSG:4979, zero base, walls of four points, roof a turned footprint."""
    west, south, step, height = -71.0601, 42.3555, 0.0001, 7.5
    plan = [(west, south), (west + step, south), (west + step, south + step), (west, south + step)]
    rings = [[(*p, 0.0) for p in plan], [(*p, height) for p in plan[::-1]]]
    walls = [
        polygon("<gml:posList>" + " ".join(f"{x} {y} {z}" for x, y, z in wall) + "</gml:posList>")
        for a, b in zip(plan, plan[1:] + plan[:1], strict=True)
        for wall in [[(*a, 0.0), (*a, height), (*b, height), (*b, 0.0)]]
    ]
    members = surface_members([polygon(ring) for ring in rings] + walls)
    path = write(tmp_path / "Massachusetts-25-000.gml", city(member(solid(members)), srs="EPSG:4979"))
    values = profile("open_city_model")
    model = read_city_model(path, options=ReadOptions.from_mapping(values["options"] | {"ground_m": 12.0}))
    assert model.crs == "EPSG:32619"
    assert model.findings.counts() == {
        "LB103 RING_NOT_CLOSED": 4,
        "LB305 CRS_PROJECTED": 1,
        "LB310 HEIGHTS_ELLIPSOIDAL": 1,
        "LB407 BASE_MOVED": 1,
    }
    points = model.polygons.points
    assert (points[:, 2].min(), points[:, 2].max()) == (12.0, 19.5)
    assert points[:, 0].max() == pytest.approx(9, abs=1)
    assert points[:, 1].max() == pytest.approx(11.5, abs=1)


def test_swissbuildings3d_as_published(tmp_path: Path) -> None:
    rings = [[(2600000.0 + x, 1200000.0 + y, z) for x, y, z in ring] for ring in _box()]
    text = city(member(solid_of(rings, 2)), srs="CH1903")
    path = write(tmp_path / "SWISSBUILDINGS3D_2_0_CHLV95LN02_1047-32.gml", text)
    values = profile("swissbuildings3d")
    model = read_city_model(path, options=ReadOptions.from_mapping(values["options"]))
    assert model.crs == "EPSG:2056+5728"
    assert model.polygons.points[:, 2].min() == 453.0


def _box() -> list[list[tuple[float, float, float]]]:
    low, high = 450.0, 462.0
    plan = [(0.0, 0.0), (8.0, 0.0), (8.0, 6.0), (0.0, 6.0)]
    walls = [
        [(*a, low), (*b, low), (*b, high), (*a, high)] for a, b in zip(plan, plan[1:] + plan[:1], strict=True)
    ]
    return [[(*p, low) for p in plan[::-1]], [(*p, high) for p in plan], *walls]


@pytest.mark.parametrize(
    ("words", "count"),
    [
        ({"ground_m": 400.0, "terrain": "nowhere.tif"}, 2),
        ({"height_column": "H", "default_height_m": 9.0, "layer": "houses"}, 3),
        ({"base": "ground", "ground_m": 400.0}, 0),
        ({"up_axis": "y"}, 1),
        ({"storey_height_m": 3.0, "axis_order": "east_first"}, 0),
    ],
)
def test_options_that_say_nothing_to_citygml_are_told(tmp_path, words, count):
    model = read_city_model(write(tmp_path / "a.gml", box_city()), options=ReadOptions.from_mapping(words))
    assert model.findings.counts().get("LB411 OPTION_UNUSED", 0) == count
