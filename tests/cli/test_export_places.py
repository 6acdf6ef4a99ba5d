"""`lodbench export` of localised photos, and which reference system exported poses are in."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lodbench.cli import main
from lodbench.datasets.pose_files import read_pose_file
from lodbench.datasets.pose_text import format_pose
from lodbench.geometry import Camera, Pose
from lodbench.geometry.angles import rotation_from_dji
from tests.town import box_obj, write_dataset

CAMERA = "PINHOLE 64 48 60 60 32 24"
POSES = {
    "a.jpg": Pose.from_center(rotation_from_dji(40.0, -50.0, 0.0), (-30.0, -40.0, 60.0)),
    "b.jpg": Pose.from_center(rotation_from_dji(173.8, -63.25, -120.6), (5.0, 44.0, 80.0)),
}


def write_photo(path: Path, seed: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 255, (48, 64, 3), np.uint8)
    Image.fromarray(pixels).save(path)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number, name in enumerate((*POSES, "c.jpg")):
        write_photo(tmp_path / "photos" / name, number)
    (tmp_path / "city.obj").write_text(box_obj())
    (tmp_path / "rough.txt").write_text("".join(f"{format_pose(*each)}\n" for each in POSES.items()))
    return tmp_path


def localize(folder: Path, *words: str, start: str = "rough.txt") -> int:
    """Localises by what gives the rough poses back; c.jpg has none."""
    own = ("localize", "--city", str(folder / "city.obj"), "--method", "prior_only", "--camera", CAMERA)
    return main([*own, "--start", str(folder / start), "--out", str(folder / "found"), *words])


def exported(folder: Path, name: str, *words: str) -> Path:
    out = folder / "out" / name
    assert main(["export", str(folder / "found"), "--format", name, "--out", str(out), *words]) == 0
    return out


@pytest.mark.parametrize("name", ["colmap", "kapture", "metashape", "pix4d", "tum", "visuallocalization"])
def test_poses_and_cameras_are_read_back(capsys, folder, name):
    assert localize(folder, str(folder / "photos")) == 3
    capsys.readouterr()
    path = exported(folder, name)
    told = capsys.readouterr().out
    assert "2 poses" in told
    assert "without a pose: 1 query: c.jpg" in told
    _, found = read_pose_file(path, "lines" if name == "visuallocalization" else name)
    for image, (expected, pose) in zip(found, POSES.items(), strict=True):
        assert name == "tum" or image.name == expected
        np.testing.assert_allclose(image.pose.cam_from_world, pose.cam_from_world, atol=1e-9)
        assert image.camera == (
            Camera(64, 48, 60.0, 60.0, 32.0, 24.0) if name in ("colmap", "kapture") else None
        )


def test_the_table_is_that_of_localize(folder):
    assert localize(folder, str(folder / "photos")) == 3
    with (folder / "found" / "localized.csv").open() as stream:
        theirs = list(csv.DictReader(stream))
    with exported(folder, "csv").open() as stream:
        ours = list(csv.DictReader(stream))
    assert [row["photo"] for row in ours] == ["a.jpg", "b.jpg", "c.jpg"]
    for mine, their in zip(ours, theirs, strict=True):
        names = ("easting_m", "heading_deg", "pitch_deg", "roll_deg", "trust", "failure", "probability")
        assert [mine[name] for name in names] == [their[name] for name in names]


def test_one_photo_alone_and_a_map_of_a_named_system(capsys, folder):
    assert localize(folder, str(folder / "photos" / "b.jpg")) == 0
    assert main(["export", str(folder / "found"), "--format", "geojson"]) == 2
    assert "no reference system" in capsys.readouterr().err
    features = json.loads(exported(folder, "geojson", "--crs", "EPSG:25832").read_text())["features"]
    assert [each["properties"]["name"] for each in features] == ["b.jpg"]
    assert features[0]["properties"]["pitch_deg"] == pytest.approx(-63.25)


def test_photos_of_one_name_are_told_apart_by_their_folders(capsys, folder):
    for number, (part, name) in enumerate((("x", "a.jpg"), ("y", "b.jpg"))):
        write_photo(folder / "photos" / part / "DJI_1.jpg", number + 10)
        line = format_pose(f"{part}/DJI_1.jpg", POSES[name])
        (folder / "two.txt").open("a").write(line + "\n")
    assert localize(folder, *(str(folder / "photos" / part) for part in "xy"), start="two.txt") == 0
    _, found = read_pose_file(exported(folder, "visuallocalization"), "lines")
    centers = {image.name: image.pose.center for image in found}
    np.testing.assert_allclose(centers["x/DJI_1.jpg"], POSES["a.jpg"].center, atol=1e-9)
    np.testing.assert_allclose(centers["y/DJI_1.jpg"], POSES["b.jpg"].center, atol=1e-9)
    (folder / "photos" / "y" / "DJI_1.jpg").unlink()
    capsys.readouterr()
    assert main(["export", str(folder / "found"), "--format", "tum"]) == 2
    assert "2 answers for DJI_1.jpg" in capsys.readouterr().err


def test_what_is_no_longer_found_is_not_exported(folder):
    assert localize(folder, str(folder / "photos")) == 3
    (folder / "less.txt").write_text(format_pose("a.jpg", POSES["a.jpg"]) + "\n")
    assert localize(folder, str(folder / "photos"), start="less.txt") == 3
    assert (folder / "found" / "b.json").is_file()
    _, found = read_pose_file(exported(folder, "visuallocalization"), "lines")
    assert [image.name for image in found] == ["a.jpg"]


def test_what_cannot_be_is_one_line(capsys, folder, monkeypatch):
    assert localize(folder, str(folder / "photos")) == 3
    found = folder / "found"
    capsys.readouterr()
    words = ["export", str(found), "--format", "metashape"]
    assert main([*words, "--city", str(folder / "city.obj")]) == 2
    assert "has cameras and reference system itself" in capsys.readouterr().err
    assert main([*words, str(found), "--out", str(folder / "m.txt")]) == 2
    assert "for 2 folders" in capsys.readouterr().err
    with monkeypatch.context() as patched:
        patched.setattr("lodbench.harness.export.Metashape.requires", ("city",))
        assert main(words) == 2
    assert "lodbench dataset init" in capsys.readouterr().err
    values = json.loads((found / "a.json").read_text())
    (found / "a.json").write_text(json.dumps({**values, "crs": "EPSG:25832"}))
    assert main(words) == 2
    assert "poses in EPSG:25832 (a.jpg) and in a local frame (b.jpg)" in capsys.readouterr().err
    (found / "a.json").write_text(json.dumps({**values, "covariance": [1.0]}))
    assert main(words) == 2
    assert "a.json is no answer that can be read" in capsys.readouterr().err
    for name in ("a", "b"):
        (found / f"{name}.json").unlink()
    assert main(words) == 2
    assert "holds no poses" in capsys.readouterr().err


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
    monkeypatch.setattr("lodbench.cli.stored_runs.reopen_dataset", None)  # the data may be gone
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
