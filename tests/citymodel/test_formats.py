"""The table of formats, one of another package's too, and the codes of findings."""

import json
import re
import sys
import zipfile
from pathlib import Path

import pytest

from lodbench.citymodel.codes import VAL3DITY, finding_catalogue
from lodbench.citymodel.formats import city_formats, formats_in_words, identify
from lodbench.citymodel.read import read_city_model
from lodbench.citymodel.source import is_city_file, open_sources
from lodbench.cli import main
from lodbench.datasets.faults import CATALOGUE as DATASET_CODES
from tests.cli.photo_case import make_case
from tests.site_packages import write_package

DOCS = Path(__file__).resolve().parents[2] / "docs"
# CityGML behind a first line of its own.
TOY = """
import io

class Toy:
    label = "Toy"
    suffixes = (".toy", ".gml")

    @staticmethod
    def identify(head, suffix):
        return head.startswith(b"TOY")

    @staticmethod
    def read(source, options):
        from lodbench.citymodel.gml.reader import read_citygml

        with source.open() as stream:
            data = stream.read().partition(b"\\n")[2]
        city = read_citygml(lambda: io.BytesIO(data), source.name, options)
        city.format = "Toy"
        return city

class Broken:
    suffixes = "toy2"
    identify = read = None
"""


@pytest.fixture
def toy(tmp_path, monkeypatch):
    site = tmp_path / "site"
    monkeypatch.syspath_prepend(site)
    monkeypatch.delitem(sys.modules, "toy_parts", raising=False)
    points = {"toy": "toy_parts:Toy", "broken": "toy_parts:Broken", "lost": "toy_parts:Lost"}
    write_package(site, "toy", {"city_readers": points}, {"toy_parts.py": TOY})


@pytest.fixture
def toy_city(tmp_path, shared_data):
    source = shared_data / "city/germany_lod2/LoD2_32_280_5657_1_NW.gml"
    path = tmp_path / "tiles" / "town.toy"
    path.parent.mkdir()
    path.write_bytes(b"TOY\n" + source.read_bytes())
    return path


def test_ours_are_told_by_content_and_ending():
    found = {
        suffix: each and each.name
        for suffix, each in {
            ".gml": identify(b"\xef\xbb\xbf<?xml ", ".gml"),
            ".xml": identify(b'{"type": "CityJSON"', ".xml"),
            ".json": identify(b"<CityModel", ".json"),
            ".ply": identify(b"ply\n", ".ply"),
            ".txt": identify(b"v 1 2 3\n", ".txt"),
            ".obj": identify(b"# nothing yet\n", ".obj"),
            ".dat": identify(b"what", ".dat"),
        }.items()
    }
    names = {".gml": "citygml", ".xml": "cityjson", ".json": "citygml", ".ply": "mesh", ".txt": "obj"}
    assert found == {**names, ".obj": "obj", ".dat": None}


def test_the_table_stands_in_help_and_guide(capsys):
    with pytest.raises(SystemExit):
        main(["city", "--help"])
    told = " ".join(capsys.readouterr().out.split())
    guide = (DOCS / "your-own-city.md").read_text()
    for each in city_formats():
        assert f"{each.label} (" in told
        for suffix in each.suffixes:
            assert suffix in told
            assert f"`{suffix}`" in guide, suffix


def test_a_format_of_a_package_is_read_as_file_folder_archive_and_in_memory_of_its_name(
    toy, toy_city, capsys
):
    plain = read_city_model(toy_city)
    assert plain.format == "Toy"
    assert is_city_file(toy_city)
    archive = toy_city.with_name("town.zip")
    with zipfile.ZipFile(archive, "w") as packed:
        packed.write(toy_city, "a/town.toy")
    for path in (toy_city.parent, archive):
        assert read_city_model(path).building_ids[: len(plain.building_ids)] == plain.building_ids
    assert main(["city", "info", str(toy_city), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["format"] == "Toy"


def test_its_ending_stands_where_ours_do_and_does_not_take_ours(toy, toy_city, tmp_path, capsys):
    assert "Toy (.toy, .gml)" in formats_in_words()
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "notes.txt").write_text("nothing")
    assert main(["city", "info", str(empty)]) == 2
    assert ".toy" in capsys.readouterr().err
    (empty / "words.toy").write_text("neither here nor there")
    assert main(["city", "info", str(empty / "words.toy")]) == 2
    assert "Toy (.toy, .gml)" in capsys.readouterr().err
    gml = tmp_path / "plain.gml"
    gml.write_bytes(toy_city.read_bytes().partition(b"\n")[2])
    assert read_city_model(gml).format == "CityGML"
    gml.write_bytes(toy_city.read_bytes())
    assert read_city_model(gml).format == "Toy"  # what it is, under an ending of both
    assert len(open_sources(toy_city.parent)) == 1


def test_what_is_broken_harms_nobody(toy):
    names = [each.name for each in city_formats()]
    assert "toy" in names
    assert not {"broken", "lost"}.intersection(names)
    assert names[:6] == ["citygml", "cityjson", "footprints", "mesh", "obj", "surface"]


def test_a_photo_is_localised_in_a_city_of_it(toy, tmp_path, shared_data, capsys):
    case = make_case(tmp_path, shared_data, "nrw")
    city = tmp_path / "city.toy"
    city.write_bytes(b"TOY\n" + case.city.read_bytes())
    found = []
    for path in (city, case.city):
        words = ["--city", str(path), "--mask", str(case.mask), "--out", str(tmp_path / path.suffix[1:])]
        main(["localize", str(case.photo), *words, "--json"])
        found.append(json.loads(capsys.readouterr().out))
    assert found[0]["pose"] == found[1]["pose"]


_ROOT = Path(__file__).resolve().parents[2]


def test_codes_are_unique_and_grouped() -> None:
    catalogue = finding_catalogue()
    assert len({code.code for code in catalogue}) == len({code.name for code in catalogue}) == len(catalogue)
    assert all(re.fullmatch(r"LB[1-467]\d\d", code.code) for code in catalogue)
    assert all(code.meaning.endswith(".") for code in catalogue)
    assert not {code.code for code in catalogue} & set(DATASET_CODES)


def test_every_code_is_used_and_tested() -> None:
    source = "".join(
        path.read_text() for path in (_ROOT / "lodbench/citymodel").rglob("*.py") if path.name != "codes.py"
    )
    tests = "".join(path.read_text() for path in (_ROOT / "tests/citymodel").glob("test_*.py"))
    for code in finding_catalogue():
        assert re.search(rf"\b{code.name}\b", source), f"{code} is never added"
        assert code.code in tests, f"no test expects {code}"


def test_the_table_in_the_documentation() -> None:
    rows = [
        f"| {c.code} | {c.name} | {c.severity.value} | {VAL3DITY.get(c, '')} | {c.meaning} |"
        for c in finding_catalogue()
    ]
    page = (_ROOT / "docs" / "city-findings.md").read_text()
    assert [line for line in page.splitlines() if line.startswith("| LB")] == rows
