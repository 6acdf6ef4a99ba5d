"""A run's poses in every format, read back by the readers that import them."""

import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pyproj
import pytest
import shapely

from lodbench.citymodel.cache import open_cached_scene
from lodbench.cli import main
from lodbench.datasets.pose_files import read_pose_file
from lodbench.datasets.pose_text import read_poses
from lodbench.evaluation.metrics import NO_TRUTH, queries_frame
from lodbench.harness.export import queries_with_poses
from tests.site_packages import write_package
from tests.town import CAMERA, write_dataset

# Where the boxes could stand: export needs a reference system, and boxes have none.
CRS = "EPSG:25832"


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run of three queries, the last of which has no mask and so no pose."""
    folder = tmp_path_factory.mktemp("export")
    root, city = write_dataset(folder / "town", count=3)
    (root / "masks" / "view_02.png").unlink()
    words = ["run", "dataset=folder", f"dataset.root={root}", f"dataset.city_model={city}", "method.steps=2"]
    assert main([*words, f"paths.runs={folder / 'runs'}"]) == 0
    (found,) = (folder / "runs/folder/lodlocv2").iterdir()
    return found


@pytest.mark.parametrize(
    "name", ["colmap", "kapture", "metashape", "nerfstudio", "odm", "pix4d", "tum", "visuallocalization"]
)
def test_every_format_is_read_back(capsys, tmp_path, run, name):
    # Where the poses are only ODM's file must say; angles in degrees cost a digit or two.
    place = ["--crs", "EPSG:25832"] if name == "odm" else []
    tolerance = 1e-12 if name in ("metashape", "pix4d", "odm") else 1e-14
    assert main(["export", str(run), "--format", name, "--out", str(tmp_path / "out"), *place]) == 0
    told = capsys.readouterr().out
    assert "2 poses" in told
    assert "without a pose: 1 query: view_02.png" in told
    # Where angles are not those of the CSV, it says so.
    angles = {"metashape": "yaw from grid north", "pix4d": "omega, phi, kappa", "odm": "omega, phi, kappa"}
    assert ("  angles: " in told) == (name in angles)
    assert f"  angles: {angles.get(name)}" in told or name not in angles
    kind = "lines" if name == "visuallocalization" else name
    path = tmp_path / "out"
    if name == "nerfstudio":
        path = path.rename(tmp_path / "transforms.json")
    _, found = read_pose_file(path, kind)
    expected = read_poses(run / "poses.txt")
    assert [image.name for image in found] == list(expected)
    for image in found:
        np.testing.assert_allclose(image.pose.rotation, expected[image.name].rotation, atol=tolerance)
        np.testing.assert_allclose(image.pose.center, expected[image.name].center, rtol=0, atol=1e-10)
        assert image.camera == (CAMERA if name in ("colmap", "kapture", "nerfstudio") else None)


def test_the_same_file_scores_the_same(capsys, tmp_path, run):
    assert main(["export", str(run), "--format", "tum", "--out", str(tmp_path / "poses.tum")]) == 0
    provenance = json.loads((run / "provenance.json").read_text())
    root = provenance["dataset_root"]
    words = ["evaluate", f"poses={tmp_path / 'poses.tum'}", "dataset=folder", f"dataset.root={root}"]
    assert main([*words, f"paths.runs={tmp_path / 'runs'}"]) == 0
    (folder,) = (tmp_path / "runs/folder/poses").iterdir()
    ours, again = (
        json.loads((path / "summary.json").read_text())["splits"]["data"] for path in (run, folder)
    )
    assert again["recall"] == ours["recall"]
    assert again["median_translation_m"] == pytest.approx(ours["median_translation_m"], abs=1e-9)


def test_a_map_of_every_query(capsys, tmp_path, run):
    assert main(["export", str(run), "--format", "geojson", "--crs", CRS]) == 0
    features = json.loads((run / "export/poses.geojson").read_text())["features"]
    assert [f["properties"]["name"] for f in features] == ["view_00.png", "view_01.png", "view_02.png"]
    assert [f["geometry"] is None for f in features] == [False, False, True]
    assert "translation_error_m" in features[0]["properties"]
    assert features[2]["properties"]["failure"] == "no mask in the masks folder"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--format", "kaptur"], ["kaptur", "kapture"]),
        (["--format", "geojson"], ["reference system", "--crs"]),
        (["--format", "geojson", "--crs", "EPSG:4326"], ["degrees"]),
        (["--format", "geojson", "--crs", "EPSG:1"], ["EPSG:1"]),
        (["--format", "metashape", "--crs", "EPSG:4326"], ["degrees"]),
        (["--format", "tum", "--crs", "EPSG:25832"], ["tum states no reference system", "--crs out"]),
        (["--format", "geojson", "--city-model", "nowhere.gml"], ["nowhere.gml"]),
    ],
)
def test_faults(capsys, tmp_path, run, words, expected):
    assert main(["export", str(run), *words, "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    for word in expected:
        assert word in told
    assert not (tmp_path / "out").exists()


def test_no_run(capsys, tmp_path):
    assert main(["export", str(tmp_path), "--format", "tum"]) == 2
    assert "run" in capsys.readouterr().err


class TestRerun:
    def test_without_the_package(self, capsys, monkeypatch, tmp_path, run):
        monkeypatch.setitem(sys.modules, "rerun", None)
        assert main(["export", str(run), "--format", "rerun", "--out", str(tmp_path / "a.rrd")]) == 2
        told = capsys.readouterr().err
        assert "--format rerun needs rerun" in told
        assert "lodbench[rerun]" in told
        assert not (tmp_path / "a.rrd").exists()

    def test_rerun_itself_reads_it(self, capsys, tmp_path, run):
        pytest.importorskip("rerun", reason="rerun-sdk, 170 MB, is not among the tests' packages")
        path = tmp_path / "a.rrd"
        assert main(["export", str(run), "--format", "rerun", "--out", str(path)]) == 0
        told = capsys.readouterr().out
        assert "2 poses" in told
        assert "view_02.png" in told
        subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", str(path)], check=True)
        words = [sys.executable, "-m", "rerun", "rrd", "print", "-vvv", str(path)]
        text = subprocess.run(words, check=True, capture_output=True, text=True).stdout
        told = [line for line in text.splitlines() if "┆" in line]
        origin = open_cached_scene(
            Path(json.loads((run / "provenance.json").read_text())["city_model"])
        ).origin
        for pose in read_poses(run / "poses.txt").values():
            local = pose.shifted(-origin)
            # Its matrices run down the columns: of R.T those are the rows of R. The last is cut off.
            numbers = [*local.rotation.ravel()[:8], *local.center]
            assert any(np.allclose(found, numbers, atol=1e-4) for found in map(_numbers, told) if found)
        assert "no mask in the masks folder" in text
        for entity in ("city", "cameras/prior", "cameras/truth", "cameras/estimate/mask"):
            assert f"entity_path: /{entity} " in text


def _numbers(line: str) -> list[float]:
    """Returns the eleven numbers of a printed row that holds a transform, or none."""
    found = [float(text) for text in re.findall(r"-?\d+\.\d+(?:e-\d+)?", line.split("┆", 3)[-1])]
    return found if len(found) == 11 else []


@pytest.mark.parametrize("name", ["queries", "parquet"])
def test_the_table_of_queries_holds_the_poses(capsys, tmp_path, run, name):
    path = tmp_path / f"queries.{name}"
    if name == "parquet":
        pytest.importorskip("pyarrow")
    assert main(["export", str(run), "--format", name, "--out", str(path)]) == 0
    assert "2 poses" in capsys.readouterr().out
    frame = pd.read_csv(path) if name == "queries" else pd.read_parquet(path)
    expected = read_poses(run / "poses.txt")
    found = frame.set_index("query")[["tx", "ty", "tz"]]
    assert found.isna().any(axis=1).to_dict() == {
        "view_00.png": False,
        "view_01.png": False,
        "view_02.png": True,
    }
    for key, pose in expected.items():
        np.testing.assert_allclose(found.loc[key], pose.translation, atol=1e-9)


PLACE = ["easting_m", "northing_m", "height_m"]


@pytest.mark.parametrize("crs", [None, CRS])
def test_the_surveyors_table(capsys, tmp_path, run, crs):
    """Coordinates, compass heading and gimbal pitch, by formulas written down here again."""
    path, place = tmp_path / "poses.csv", [] if crs is None else ["--crs", crs]
    assert main(["export", str(run), "--format", "csv", "--out", str(path), *place]) == 0
    table = pd.read_csv(path).set_index("photo")
    assert list(table)[1:9] == [
        "easting_m", "northing_m", "height_m", "latitude_deg", "longitude_deg", "heading_deg", "pitch_deg",
        "roll_deg",
    ]  # fmt: skip
    for name, pose in read_poses(run / "poses.txt").items():
        row, ahead = table.loc[name], pose.rotation[2]
        np.testing.assert_allclose(row[PLACE].astype(float), pose.center, atol=6e-4)
        assert row["pitch_deg"] == pytest.approx(np.degrees(np.arcsin(ahead[2])), abs=6e-4)
        heading = np.degrees(np.arctan2(ahead[0], ahead[1]))
        if crs is None:
            assert np.isnan(row["latitude_deg"])
        else:
            projection = pyproj.Proj(crs)
            longitude, latitude = projection(*pose.center[:2], inverse=True)
            assert row["longitude_deg"] == pytest.approx(longitude, abs=1e-7)
            assert row["latitude_deg"] == pytest.approx(latitude, abs=1e-7)
            heading += projection.get_factors(longitude, latitude).meridian_convergence
        assert (row["heading_deg"] - heading + 180) % 360 == pytest.approx(180, abs=2e-3)
    assert table.loc["view_02.png", ["easting_m", "trust", "failure"]].fillna("").tolist() == [
        "", "failed", "no mask in the masks folder",
    ]  # fmt: skip


def test_a_geopackage_is_read_by_gdal_and_replaces_no_other(capsys, tmp_path, run):
    pyogrio = pytest.importorskip("pyogrio", reason="GDAL reads what was written")
    path = tmp_path / "poses.gpkg"
    words = ["export", str(run), "--format", "gpkg", "--crs", CRS, "--out", str(path)]
    assert main(words) == 0
    first = path.read_bytes()
    assert main(words) == 0
    assert path.read_bytes() == first
    assert pyogrio.read_info(path)["crs"] == "EPSG:4326"
    meta, _, geometries, values = pyogrio.raw.read(path)
    rows = dict(zip(meta["fields"], values, strict=True))
    points = shapely.from_wkb(geometries)
    assert points[2] is None
    assert [point.x for point in points[:2]] == rows["longitude_deg"][:2].tolist()
    assert [point.y for point in points[:2]] == rows["latitude_deg"][:2].tolist()
    assert rows["height_m"].dtype == np.float64
    pyogrio.raw.write(
        tmp_path / "theirs.gpkg", geometries[:2], [rows["height_m"][:2]], ["h"], geometry_type="Point",
        crs="EPSG:4326",
    )  # fmt: skip
    whole = (tmp_path / "theirs.gpkg").read_bytes()
    assert main([*words[:-1], str(tmp_path / "theirs.gpkg")]) == 2
    assert "is there already, and is no such export" in capsys.readouterr().err
    assert (tmp_path / "theirs.gpkg").read_bytes() == whole


def test_an_answer_without_a_truth_has_not_failed():
    failures = {"1.jpg": NO_TRUTH, "2.jpg": f"{NO_TRUTH}; no mask", "3.jpg": "no mask", "4.jpg": ""}
    rows = [{"query": name, "split": "a", "failure": failure} for name, failure in failures.items()]
    table = queries_with_poses(SimpleNamespace(queries=queries_frame(rows), poses={}))
    assert list(table["failure"]) == ["", "no mask", "no mask", ""]


FORMAT = """
class Part:
    file_name, requires = "kit.txt", ()

    def write(self, export, path):
        path.write_text("half")
        %s
"""


@pytest.mark.parametrize("fault", ["exit()", "1 / 0", "open(path / 'x')"])
def test_a_format_of_another_package_that_fails_leaves_what_was_there(
    capsys, tmp_path, monkeypatch, run, fault
):
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.delitem(sys.modules, "kit_format", raising=False)
    points, files = {"export_formats": {"kit": "kit_format:Part"}}, {"kit_format.py": FORMAT % fault}
    write_package(tmp_path / "site", "kit", points, files)
    out = tmp_path / "out" / "poses.txt"
    out.parent.mkdir()
    out.write_text("former")
    assert main(["export", str(run), "--format", "kit", "--out", str(out)]) == 2
    told = capsys.readouterr().err
    blamed = f"lodbench: {out}: Not a directory" if "open" in fault else "of the package kit 1.0 cannot write"
    assert blamed in told
    assert "Traceback" not in told
    assert (out.read_text(), list(out.parent.iterdir())) == ("former", [out])
