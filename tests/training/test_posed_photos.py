"""Posed photos over a map as a training set: labels are silhouettes, the rest is as for any set."""

import json
import math
import shutil

import cv2
import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.cli import main
from lodbench.cli.training import report_trained
from lodbench.datasets.pose_text import read_cameras, read_poses
from lodbench.errors import DatasetError
from lodbench.rendering.raster import RasterRenderer
from lodbench.segmentation.masks import read_mask
from lodbench.training.photo_sets import is_posed, posed_samples
from lodbench.training.train import Trained
from tests.town import write_dataset


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Three photos of a town of boxes, red roofs on green ground, with poses and a map; no masks."""
    root, city = write_dataset(tmp_path_factory.mktemp("town"))
    (root / "Query_image").mkdir(exist_ok=True)
    for path in (root / "masks").iterdir():
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 0
        photo = np.where(mask[..., None], (40, 40, 200), (60, 150, 60)).astype(np.uint8)
        cv2.imwrite(str(root / "Query_image" / path.name), photo)
        path.unlink()
    shutil.copy(city, root / "map.obj")
    (root / "dataset.json").write_text(json.dumps({"city_model": "map.obj"}))
    return root, city


def test_labels_are_what_the_map_shows_from_the_true_poses(flight, tmp_path):
    root, city = flight
    assert is_posed(root)
    assert not is_posed(tmp_path)
    samples = posed_samples(root, tmp_path / "silhouettes")
    assert len(samples) == 3
    scene, cameras = open_scene(city), read_cameras(root / "intrinsic.txt")
    truth = read_poses(root / "GT_pose.txt")
    for sample in samples:
        name = sample.photo.name
        expected = RasterRenderer(scene, 1).draw(cameras[name], truth[name].shifted(-scene.origin)).mask
        # Another way to draw may decide otherwise where an outline cuts a pixel.
        assert ((read_mask(sample.mask) >= 0.5) != expected).mean() < 0.01
        assert expected.mean() > 0.02


def test_a_map_that_lies_elsewhere_teaches_nothing(flight, tmp_path):
    """All labels were empty, and a network learnt that roofs are ground."""
    root = tmp_path / "flight"
    shutil.copytree(flight[0], root)
    words = [line.split() for line in flight[1].read_text().splitlines()]
    moved = [["v", str(float(w[1]) + 9000.0), *w[2:]] if w and w[0] == "v" else w for w in words]
    (root / "map.obj").write_text("\n".join(map(" ".join, moved)) + "\n")
    with pytest.raises(DatasetError, match="shows no building from any true pose"):
        posed_samples(root, tmp_path / "silhouettes")
    about = {"city_model": "map.json", "crs": "EPSG:25833"}
    (root / "dataset.json").write_text(json.dumps(about))
    assert main(["city", "convert", str(flight[1]), str(root / "map.json"), "--crs", "EPSG:25832"]) == 0
    with pytest.raises(DatasetError, match=r"in EPSG:25833, its map .* in EPSG:25832"):
        posed_samples(root, tmp_path / "silhouettes")


def test_photos_that_are_missing_are_told(flight, tmp_path, caplog):
    root = tmp_path / "flight"
    shutil.copytree(flight[0], root)
    (root / "Query_image" / "view_01.png").unlink()
    samples = posed_samples(root, tmp_path / "silhouettes")
    assert [sample.photo.name for sample in samples] == ["view_00.png", "view_02.png"]
    (line,) = caplog.messages
    assert line.startswith("1 of 3 photos of ")
    assert line.endswith("cannot be learnt from: flight/view_01.png has no photo")


@pytest.mark.slow
def test_a_network_is_trained_on_them(flight, tmp_path, capsys):
    pytest.importorskip("torch", reason="torch is not installed (extra [torch])")
    pytest.importorskip("onnx", reason="onnx is not installed (extra [torch])")
    words = ["schedule.epochs=1", "schedule.batch=2", "schedule.crop=64", "threads=1"]
    assert main(["train", f"data={flight[0]}", f"out={tmp_path / 'net'}", *words]) == 0
    told = capsys.readouterr()
    assert "2 views to train on, 1 to validate on" in told.err
    assert (tmp_path / "net" / "compact.onnx").is_file()
    assert "val IoU: mean per view" in told.out


def test_views_with_few_buildings_leave_no_iou_and_the_reason_is_told(tmp_path):
    row = {"loss": 0.5, "mean_iou": math.nan, "pooled_iou": math.nan, "views": 0}
    told = report_trained(Trained(tmp_path / "compact.onnx", [row], "val views", 7, 0, {}))
    assert "val IoU: none, for no view to validate on has 5 % buildings or more\n" in told
    assert "nan" not in told


def test_without_a_map_or_photos_there_is_nothing_to_learn(tmp_path):
    root, city = write_dataset(tmp_path / "bare")
    with pytest.raises(DatasetError, match="has no city model"):
        posed_samples(root, tmp_path / "silhouettes")
    with pytest.raises(DatasetError, match="no photo with a camera and a true pose"):
        posed_samples(root, tmp_path / "silhouettes", str(city))
