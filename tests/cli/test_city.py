"""`lodbench city` in a subprocess: what it prints, what it writes, and what it refuses."""

import gzip
import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.citymodel.gml_text import box_city, city, member, multi_surface, polygon, surface_members, write
from tests.town import box_obj

from .test_faults import is_clear

NRW = "city/germany_lod2/LoD2_32_280_5657_1_NW.gml"
PLATEAU = "city/plateau/64412288_bldg_6697_op.gml"
TOWER = "city/plateau/Issue32_13101-bldg-365.gml"
UNDECLARED = "city/plateau/53392642_bldg_6697_op2.gml"


class TestInfo:
    def test_for_people(self, lodbench, shared_data):
        done = lodbench("city", "info", str(shared_data / NRW))
        assert (done.returncode, done.stderr) == (0, "")
        for words in (
            "CityGML 1.0",
            "EPSG:25832+7837 (ETRS89 / UTM zone 32N",
            "83, and 50 building parts",
            "157.0 m x 613.0 m",
            "1,144",
        ):
            assert words in done.stdout
        assert "LB306 CRS_MAPPED" in done.stdout

    def test_for_machines(self, lodbench, shared_data):
        done = lodbench("city", "info", str(shared_data / PLATEAU), "--json")
        info = json.loads(done.stdout)
        assert {"format", "version", "crs", "buildings", "parts", "extent_m", "lods", "findings"} <= set(info)
        assert (info["buildings"], list(info["lods"])) == (10, ["0", "1"])
        assert {"polygons", "triangles", "area_m2"} <= set(info["lods"]["1"])
        latitude, longitude = info["center_lat_lon"]
        assert 42 < latitude < 44  # Sapporo
        assert 141 < longitude < 142

    def test_a_source_and_options_say_how_to_read(self, lodbench, tmp_path):
        path = write(tmp_path / "zero.gml", box_city(z=0.0))
        words = ["city", "info", str(path), "--json", "--source", "open_city_model"]
        info = json.loads(lodbench(*words, "--crs", "EPSG:25832", "--option", "ground_m=12").stdout)
        assert info["findings"] == {"LB407 BASE_MOVED": 1}

    def test_archives_and_folders(self, lodbench, tmp_path, shared_data):
        (tmp_path / "a.gml.gz").write_bytes(gzip.compress((shared_data / PLATEAU).read_bytes()))
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
            archive.write(shared_data / PLATEAU, "udx/bldg/a.gml")
        folder = tmp_path / "Kacheln (1), alt=neu" / "udx" / "bldg"
        folder.mkdir(parents=True)
        shutil.copy(shared_data / PLATEAU, folder / "a.gml")
        infos = [
            json.loads(lodbench("city", "info", name, "--json").stdout)
            for name in ("a.gml.gz", "a.zip", "Kacheln (1), alt=neu")
        ]
        assert infos[0] == infos[1] == infos[2]
        assert infos[0]["buildings"] == 10


class TestCheck:
    def test_a_clean_city(self, lodbench, tmp_path):
        done = lodbench("city", "check", str(write(tmp_path / "a.gml", box_city())))
        assert (done.returncode, done.stderr) == (0, "")
        assert "no findings" in done.stdout
        assert "LoD1: 440.00 m2 in, 440.00 m2 meshed, 0.00 m2 lost" in done.stdout

    def test_rings_without_area_lose_nothing(self, lodbench, shared_data):
        path = shared_data / "city/netherlands_other/3-20-DELFSHAVEN.city.json"
        done = lodbench("city", "check", str(path))
        assert (done.returncode, done.stderr) == (0, "")
        assert "LB101  RING_TOO_SHORT" in done.stdout
        assert "LoD2: 627077.07 m2 in, 627077.13 m2 meshed, 0.00 m2 lost" in done.stdout
        report = json.loads(lodbench("city", "check", str(path), "--json").stdout)
        counts = {row["name"]: row["count"] for row in report["findings"]}
        # data/README.md: 822 rings with repeated points, 642 polygons without area.
        assert counts["DUPLICATE_POINTS"] == 822
        assert counts["RING_TOO_SHORT"] + counts["ZERO_AREA"] == 642

    def test_a_real_tile_with_an_undeclared_prefix(self, lodbench, shared_data):
        done = lodbench("city", "check", str(shared_data / UNDECLARED), "--json")
        report = json.loads(done.stdout)
        found = {row["name"]: row for row in report["findings"]}
        assert "energy" in found["UNDECLARED_PREFIX"]["example"]

    @pytest.mark.parametrize(
        ("numbers", "name"),
        [
            ("0 0 0 1 0 NaN 1 1 0 0 0 0", "BAD_COORDINATE"),
            ("0 0 0 1 0 inf 1 1 0 0 0 0", "BAD_COORDINATE"),
            ("0 0 0 1 0 1e400 1 1 0 0 0 0", "BAD_COORDINATE"),
            ("0 0 0 1 0 0 1 1 0 0 0", "BAD_COUNT"),
        ],
    )
    def test_bad_numbers_are_findings_with_the_building(self, lodbench, tmp_path, numbers, name):
        good = polygon([(500000.0, 5600000.0, 0.0), (500004.0, 5600000.0, 0.0), (500004.0, 5600004.0, 0.0)])
        bad = polygon(f"<gml:posList srsDimension='3'>{numbers}</gml:posList>")
        text = city(member(multi_surface(surface_members([good, bad])), "house-7"))
        path = write(tmp_path / "a.gml", text)
        done = lodbench("city", "check", str(path), "--json")
        assert done.returncode == 1
        found = {row["name"]: row for row in json.loads(done.stdout)["findings"]}
        assert found[name]["objects"] == ["house-7"]
        # What would go on with the city refuses it instead.
        is_clear(lodbench("city", "convert", str(path), "a.obj"), "house-7")
        assert not (tmp_path / "a.obj").exists()

    def test_findings_never_replace_the_city(self, lodbench, tmp_path):
        path = write(tmp_path / "a.gml", box_city())
        before = path.read_bytes()
        is_clear(lodbench("city", "check", "a.gml", "--geojson", "./a.gml"), "a.gml is the city itself")
        assert path.read_bytes() == before

    @pytest.mark.parametrize("name", [".", "nowhere/a.geojson"])
    def test_findings_go_to_a_file(self, lodbench, tmp_path, name):
        write(tmp_path / "a.gml", box_city())
        is_clear(
            lodbench("city", "check", "a.gml", "--geojson", name), "is not a file in a folder that is there"
        )

    @pytest.mark.parametrize(
        "words", [["check", "tiles", "--geojson"], ["convert", "tiles"], ["convert", "tiles", "--tiles", "9"]]
    )
    def test_nothing_is_written_among_the_tiles_that_are_read(self, lodbench, tmp_path, words):
        """It would replace one of them, or be a tile the next time."""
        (tmp_path / "tiles").mkdir()
        path = write(tmp_path / "tiles" / "a.gml", box_city())
        out = [] if "convert" not in words else ["-o"]
        done = lodbench("city", *words, *out, "tiles/a.gml")
        is_clear(done, "tiles/a.gml lies in the folder that is read", "outside of tiles")
        assert path.read_text() == box_city()

    def test_findings_may_lie_beside_tiles_and_replace_none(self, lodbench, tmp_path):
        write(tmp_path / "a.gml", box_city())
        words = ["city", "check", ".", "--geojson"]
        assert [lodbench(*words, "findings.geojson").returncode for _ in range(2)] == [0, 0]
        (tmp_path / "houses.geojson").write_text('{"type": "FeatureCollection", "features": []}')
        is_clear(lodbench(*words, "houses.geojson"), "lies in the folder that is read")


class TestConvert:
    @pytest.mark.parametrize("suffix", ["obj", "ply", "glb", "json", "scene"])
    def test_writes_and_reads_again(self, lodbench, tmp_path, shared_data, suffix):
        target = f"Stadt, neu (1).{suffix}"
        done = lodbench("city", "convert", str(shared_data / NRW), target, "--json")
        assert (done.returncode, done.stderr) == (0, "")
        assert json.loads(done.stdout)["buildings"] == 83
        info = json.loads(lodbench("city", "info", target, "--json").stdout)
        if suffix == "scene":
            assert (info["format"], info["buildings"], info["lod"]) == ("scene", 83, "2")
            assert info["area_m2"] == pytest.approx(24156.8, abs=0.5)
        else:
            assert sum(level["area_m2"] for level in info["lods"].values()) == pytest.approx(24156.8, abs=0.5)

    def test_a_level_by_a_rule(self, lodbench, tmp_path, shared_data):
        words = ["city", "convert", str(shared_data / NRW), "blocks.obj", "--lod", "1"]
        is_clear(lodbench(*words), "level of detail 1", "--roof-height")
        done = lodbench(*words, "--roof-height", "median")
        assert "LoD1, 83 buildings" in done.stdout
        assert "m2 lost" in done.stdout
        assert "LB408 LOD_DERIVED" in done.stdout
        is_clear(lodbench(*words, "--roof-height", "meidan"), "meidan", "median")

    def test_the_profile_chooses_the_level(self, lodbench, tmp_path, shared_data):
        words = ["city", "convert", str(shared_data / TOWER), "a.ply", "--json", "--source"]
        assert json.loads(lodbench(*words, "plateau").stdout)["lod"] == "1"
        assert json.loads(lodbench(*words, "adv_lod2").stdout)["lod"] == "2"
        assert json.loads(lodbench(*words, "plateau", "--lod", "2").stdout)["lod"] == "2"

    @pytest.mark.parametrize(
        ("target", "words"),
        [("a.dwg", ["a.dwg", ".glb"]), ("nowhere/a.obj", ["nowhere"]), ("a.gml", ["a.gml"])],
    )
    def test_refused_targets(self, lodbench, tmp_path, target, words):
        path = write(tmp_path / "a.gml", box_city())
        is_clear(lodbench("city", "convert", str(path), target), *words)
        assert path.read_text() == box_city()
        assert [file.name for file in tmp_path.iterdir()] == ["a.gml"]

    @pytest.mark.parametrize("words", [["a.gml", "b.gml"], ["a.gml", "b.gml", "c.obj"]])
    def test_the_last_of_many_tiles_is_not_taken_for_what_to_write(self, lodbench, tmp_path, words):
        for name in ("a.gml", "b.gml", "c.obj"):
            write(tmp_path / name, box_city())
        done = lodbench("city", "convert", *words)
        is_clear(done, f"{words[-1]} is there already")
        assert "-o OUT" in done.stderr
        assert (tmp_path / words[-1]).read_text() == (tmp_path / "a.gml").read_text()
        assert lodbench("city", "convert", "a.gml", "-o", words[-1]).returncode == 0

    @pytest.mark.parametrize("words", [["b.json"], ["b.gml"], ["b.glb", "--bbox", "-9", "-9", "99", "99"]])
    def test_pictures_of_a_mesh_are_not_lost_without_a_word(self, lodbench, tmp_path, words):
        write(tmp_path / "a.obj", box_obj())
        is_clear(lodbench("city", "convert", "a.obj", *words, "--textures"), "Of a.obj no pictures")
        assert [file.name for file in tmp_path.iterdir()] == ["a.obj"]

    def test_what_one_city_became_is_written_again(self, lodbench, tmp_path):
        write(tmp_path / "a.gml", box_city())
        assert [lodbench("city", "convert", "a.gml", "a.obj").returncode for _ in range(2)] == [0, 0]

    def test_a_folder_that_is_no_scene_is_left_alone(self, lodbench, tmp_path):
        write(tmp_path / "a.gml", box_city())
        (tmp_path / "mine.scene").mkdir()
        (tmp_path / "mine.scene" / "thesis.txt").write_text("years")
        is_clear(lodbench("city", "convert", "a.gml", "mine.scene"), "mine.scene")
        assert (tmp_path / "mine.scene" / "thesis.txt").read_text() == "years"


def _doctype(path: Path) -> None:
    path.write_text("<!DOCTYPE x [<!ENTITY e SYSTEM 'file:///etc/passwd'>]>" + box_city())


def _entities(path: Path) -> None:
    bomb = "".join(f"<!ENTITY e{i} '{f'&e{i - 1};' * 10}'>" for i in range(1, 10))
    path.write_text(f"<!DOCTYPE x [<!ENTITY e0 'ha'>{bomb}]><x>&e9;</x>")


def _deep(path: Path) -> None:
    path.write_text(box_city().replace("</core:CityModel>", "<a>" * 100_000))


def _truncated(path: Path) -> None:
    path.write_text(box_city()[:-200])


def _truncated_gz(path: Path) -> None:
    path.write_bytes(gzip.compress(box_city().encode())[:-40])


def _gz_bomb(path: Path) -> None:
    head = box_city().partition("<core:cityObjectMember>")[0].encode()
    path.write_bytes(gzip.compress(head + b" " * 400_000_000, 9))


def _encoding(path: Path) -> None:
    text = box_city().replace('encoding="UTF-8"', "").replace("<core:", "<!-- Ä --><core:", 1)
    path.write_bytes(b'<?xml version="1.0" encoding="UTF-8"?>' + text.partition("?>")[2].encode("latin-1"))


def _traversal(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("../../evil.gml", box_city())


def _nested(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("inner.zip", b"PK\x05\x06" + bytes(18))


def _lone_feature(path: Path) -> None:
    path.write_text('{"type":"CityJSONFeature","id":"a","CityObjects":{},"vertices":[]}\n')


def _index(path: Path, index: int) -> None:
    surface = {"type": "MultiSurface", "lod": "2", "boundaries": [[[0, 1, index]]]}
    document = {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [1, 1, 1], "translate": [0, 0, 0]},
        "CityObjects": {"a": {"type": "Building", "geometry": [surface]}},
        "vertices": [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
    }
    path.write_text(json.dumps(document))


def _deep_json(path: Path) -> None:
    path.write_text('{"type":"CityJSON","version":"2.0","x":' + "[" * 200_000)


REFUSED: list[tuple[str, Callable[[Path], object], str]] = [
    ("xxe.gml", _doctype, "DOCTYPE"),
    ("bomb.gml", _entities, "DOCTYPE"),
    ("deep.gml", _deep, "deep.gml"),
    ("cut.gml", _truncated, "cut.gml"),
    ("cut.gml.gz", _truncated_gz, "cut.gml.gz"),
    ("bomb.gml.gz", _gz_bomb, "bomb.gml.gz"),
    ("latin.gml", _encoding, "latin.gml"),
    ("up.zip", _traversal, "evil.gml"),
    ("nested.zip", _nested, "nested.zip"),
    ("lone.city.jsonl", _lone_feature, "lone.city.jsonl"),
    ("deep.json", _deep_json, "deep.json"),
    ("empty.gml", Path.touch, "empty"),
    ("text.txt", lambda path: path.write_text("hello\n"), "text.txt"),
]


@pytest.mark.parametrize(("name", "make", "expected"), REFUSED, ids=[case[0] for case in REFUSED])
def test_refused_with_one_line_and_a_hint(lodbench, tmp_path, name, make, expected):
    make(tmp_path / name)
    for words in (["info", name], ["check", name], ["convert", name, "out.obj"]):
        done = lodbench("city", *words)
        is_clear(done, expected)
        assert "hint: " in done.stderr
        assert done.stdout == ""
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("index", [3, -1])
def test_an_index_that_names_no_point(lodbench, tmp_path, index):
    _index(tmp_path / "a.json", index)
    done = lodbench("city", "check", "a.json")
    assert "Traceback" not in done.stderr
    assert done.returncode in (1, 2)
    is_clear(lodbench("city", "convert", "a.json", "a.obj"))


def test_help_teaches_by_example(lodbench):
    for words in (["city", "--help"], ["city", "info", "--help"], ["city", "convert", "--help"]):
        text = lodbench(*words).stdout
        for part in ("--source open_city_model", "height_column=", "--roof-height median", ".parquet"):
            assert part in text


def test_bench_for_machines(lodbench, tmp_path):
    write(tmp_path / "a.gml", box_city())
    done = lodbench("bench", "city", "--city", "a.gml", "--repeats", "1", "--large-mb", "0", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    figures = [json.loads(line) for line in done.stdout.splitlines()]
    assert all(set(row) == {"figure", "value", "unit", "peer", "peer_value", "ratio"} for row in figures)
    assert figures[0]["figure"] == "read and mesh LoD1"
    assert figures[0]["ratio"] > 0


def test_a_mesh_that_keeps_no_names_of_buildings_is_told(lodbench, tmp_path):
    (tmp_path / "town.obj").write_text(box_obj())
    for name, is_told in (("a.obj", True), ("a.ply", True), ("a.glb", False), ("a.scene", False)):
        values = json.loads(lodbench("city", "convert", "town.obj", name, "--json").stdout)
        assert bool(values["left_out"]) == is_told, name
    assert "left out: names of buildings" in lodbench("city", "convert", "town.obj", "a.ply").stdout


def test_a_converted_scene_is_told_from_a_city(lodbench, tmp_path):
    (tmp_path / "town.obj").write_text(box_obj())
    assert lodbench("city", "convert", "town.obj", "town.scene").returncode == 0
    done = lodbench("city", "check", "town.scene")
    assert done.returncode == 2
    assert "holds triangles only" in done.stderr
    assert len(done.stderr.splitlines()) == 2
