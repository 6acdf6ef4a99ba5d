from __future__ import annotations

import gzip
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from lodbench.citymodel import mesh_city, read_city_model
from lodbench.citymodel.checks.report import check_city, findings_geojson
from lodbench.datasets.exchange.geojson import write_geojson
from lodbench.errors import CityModelError

from .gml_text import box_city, box_rings, city, member, polygon, solid, surface_members, write
from .twins import cityjson, cityjsonseq

BOX = box_city().encode()


def second_box() -> bytes:
    rings = box_rings(x=500100.0)
    return city(member(solid(surface_members(map(polygon, rings))), "b2")).encode()


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
        text = city(member(solid(surface_members(map(polygon, faces)))), srs="EPSG:6697")
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
