"""Which reference system exported poses are in, and what an export may replace."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from lodbench.cli import main
from tests.town import write_dataset

CRS = "EPSG:25832"


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run over a city whose reference system is told, by the priors alone."""
    folder = tmp_path_factory.mktemp("placed")
    root, city = write_dataset(folder / "town", count=2)
    words = [
        "run",
        "dataset=folder",
        f"dataset.root={root}",
        f"dataset.city_model={city}",
        f"dataset.crs={CRS}",
    ]
    assert main([*words, "method=prior_only", f"paths.runs={folder / 'runs'}"]) == 0
    (found,) = (folder / "runs/folder/prior_only").iterdir()
    return found


def _crs_of_first_feature(file: Path) -> str:
    return str(json.loads(file.read_text())["features"][0]["properties"]["crs"])


@pytest.mark.parametrize(("asked", "stated"), [(None, CRS), (CRS, CRS), (f"{CRS}+7837", f"{CRS}+7837")])
def test_a_run_keeps_its_reference_system(capsys, monkeypatch, tmp_path, run, asked, stated):
    monkeypatch.setattr("lodbench.cli.export.reopen_dataset", None)  # the data may be gone
    words = ["export", str(run), "--format", "geojson", "--out", str(tmp_path / "poses.geojson")]
    assert main([*words, *([] if asked is None else ["--crs", asked])]) == 0
    assert _crs_of_first_feature(tmp_path / "poses.geojson") == stated


@pytest.mark.parametrize("name", ["geojson", "odm", "metashape"])
@pytest.mark.parametrize("is_kept", [True, False])
def test_another_reference_system_is_refused(capsys, tmp_path, run, name, is_kept):
    file = run / "provenance.json"
    whole = file.read_text()
    try:
        if not is_kept:  # as older versions wrote it: the city tells
            file.write_text(re.sub(r' *"crs".*\n', "", whole))
        words = ["export", str(run), "--format", name, "--crs", "EPSG:25833", "--out", str(tmp_path / "out")]
        assert main(words) == 2
    finally:
        file.write_text(whole)
    told = capsys.readouterr().err
    assert f"poses are in {CRS}, not in EPSG:25833" in told
    assert "Leave --crs out" in told
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("csv", "<CityModel/>\n"),
        ("csv", "photo,mine\n1,2\n"),
        ("geojson", '{\n "type": "FeatureCollection",\n "features": []\n}\n'),
        ("visuallocalization", "view_00.png 1 0 0 0 0 0 0\n"),
        ("tum", "1 2 3 4 5 6 7 8\n"),
    ],
)
def test_no_export_replaces_what_is_none(capsys, tmp_path, run, name, content):
    out = tmp_path / "there"
    out.write_text(content)
    words = ["export", str(run), "--format", name, "--out", str(out)]
    assert main(words) == 2
    told = capsys.readouterr().err
    assert f"{out} is there already, and is no such export" in told
    assert "--out" in told
    assert (out.read_text(), list(tmp_path.iterdir())) == (content, [out])
    out.unlink()
    assert [main(words), main(words)] == [0, 0]


def test_no_file_of_a_folder_is_replaced_where_one_is_no_export(capsys, tmp_path, run):
    """COLMAP's own model: its points would be lost."""
    (tmp_path / "points3D.txt").write_text("# 3D point list with one line of data per point:\n")
    words = ["export", str(run), "--format", "colmap", "--out", str(tmp_path)]
    assert main(words) == 2
    assert "points3D.txt is there already" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["points3D.txt"]


def test_no_text_is_written_beside_a_binary_model(capsys, tmp_path, run):
    (tmp_path / "images.bin").write_bytes(b"\0" * 8)
    assert main(["export", str(run), "--format", "colmap", "--out", str(tmp_path)]) == 2
    assert "images.bin would be read before" in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["images.bin"]


@pytest.mark.parametrize(
    "words", [["report"], ["compare", "--format", "csv"], ["compare", "--format", "html"], ["compare"]]
)
def test_no_page_or_table_replaces_a_city(capsys, tmp_path, run, words):
    out = tmp_path / "city.gml"
    out.write_text("<CityModel/>")
    command, *more = words
    assert main([command, str(run), *more, "--out", str(out)]) == 2
    told = capsys.readouterr().err
    assert "city.gml is there already, and is none of ." in told
    assert "Name another file with --out" in told
    assert [out.read_text()] == [file.read_text() for file in tmp_path.iterdir()]


def test_the_run_s_own_exports_are_written_anew(capsys, run):
    (run / "export").mkdir(exist_ok=True)
    (run / "export/poses.tum").write_text("by an older version\n")
    assert main(["export", str(run), "--format", "tum"]) == 0
    assert (run / "export/poses.tum").read_text().startswith("# timestamp")
