"""Photos as training views: labelled by a network or empty, with traced masks, posed over a map."""

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
from lodbench.segmentation.packaged import Compact, CompactParams
from lodbench.training.nets.batches import batches
from lodbench.training.samples import (
    TrainParams,
    ground_samples,
    is_posed,
    posed_samples,
    pseudo_samples,
    repeated,
    traced_samples,
)
from lodbench.training.train import Trained
from tests.town import write_dataset


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "place"
    (folder / "deeper").mkdir(parents=True)
    picture = np.random.default_rng(0).integers(0, 256, (60, 90, 3), dtype=np.uint8)
    for name in ("a.jpg", "deeper/b.png"):
        cv2.imwrite(str(folder / name), picture)
    return folder


def test_labels_of_the_shipped_network_are_written_as_grey_masks(photos, tmp_path):
    teacher = Compact(CompactParams(size=64))
    samples = pseudo_samples(teacher, [photos], tmp_path / "out")
    assert [sample.key for sample in samples] == ["out/place/a.jpg_0", "out/place/deeper/b.png_0"]
    photo, mask = samples[1].read(0, square=False)
    assert photo.shape == (43, 64, 3)
    full = cv2.imread(str(photos / "deeper" / "b.png"))[..., ::-1]
    np.testing.assert_allclose(mask, teacher.probability(full), atol=0.003)
    assert 0 < mask.std()


def test_ground_has_no_building_at_either_size(photos, tmp_path):
    samples = ground_samples(64, [photos], tmp_path / "out")
    assert len(samples) == 4
    assert all(sample.is_ground and read_mask(sample.mask).max() == 0 for sample in samples)
    assert [sample.read(0, square=False)[0].shape for sample in samples[:2]] == [(43, 64, 3), (64, 96, 3)]


def test_photos_of_one_name_in_folders_of_one_name_stay_apart(photos, tmp_path):
    other = tmp_path / "elsewhere" / "place"
    other.mkdir(parents=True)
    for name in ("a.jpg", "a.png"):
        cv2.imwrite(str(other / name), np.zeros((40, 60, 3), np.uint8))
    samples = ground_samples(64, [photos, other], tmp_path / "out")
    assert len({sample.photo for sample in samples}) == len({sample.key for sample in samples}) == 8
    assert [sample.read(0, square=False)[0].any() for sample in samples] == [True] * 4 + [False] * 4


def test_photos_stored_as_tiff_are_learnt_as_well(photos, tmp_path):
    cv2.imwrite(str(photos / "c.tif"), np.zeros((40, 60, 3), np.uint8))
    assert len(ground_samples(64, [photos], tmp_path / "out")) == 6


def test_a_folder_without_photos_is_named(tmp_path):
    with pytest.raises(DatasetError, match="holds no photos to learn from"):
        ground_samples(64, [tmp_path], tmp_path / "out")


@pytest.fixture
def traced(tmp_path):
    """A photo whose left half is a building, 400 x 300, and whose last rows nobody could tell."""
    for kind in ("photos", "masks"):
        (tmp_path / "town" / kind).mkdir(parents=True)
    photo, mask = np.zeros((300, 400, 3), np.uint8), np.zeros((300, 400), np.uint8)
    photo[::2] = 200
    mask[:, :200] = 255
    mask[280:] = 128
    cv2.imwrite(str(tmp_path / "town" / "photos" / "one.png"), photo)
    cv2.imwrite(str(tmp_path / "town" / "masks" / "one.png"), mask)
    return tmp_path


def test_crops_are_cut_from_all_pixels_at_the_networks_size(traced):
    (sample,) = traced_samples(200, [traced])
    assert sample.working_scale == 0.5
    params = TrainParams(data="", crop=64, scale=(2.0, 2.0), batch=1)
    ((images, truth),) = batches([sample], params, 0, 0, 0, 1)
    assert images.shape == (1, 3, 64, 64)
    # At twice half the size every second row of the photo is still told from the next.
    assert np.abs(np.diff(images.numpy()[0, 0], axis=0)).max() > 0.5
    assert set(np.unique(np.round(truth.numpy(), 1))) <= {0.0, 0.5, 1.0}


def test_few_photos_are_a_share_of_an_epoch_each_time_another_crop(traced):
    samples = traced_samples(200, [traced])
    views = repeated(samples, 0.25, 30)
    assert len(views) == 10
    assert len({view.key for view in views}) == 10
    assert len(repeated(samples, 0.0, 30)) == 1
    assert repeated([], 0.5, 30) == []


def test_a_photo_without_a_mask_is_named(traced):
    (traced / "town" / "masks" / "one.png").unlink()
    with pytest.raises(DatasetError, match=r"one\.png has no mask"):
        traced_samples(200, [traced])


def test_a_mask_of_another_size_and_two_photos_of_one_name_are_refused(traced):
    folder = traced / "town"
    cv2.imwrite(str(folder / "masks" / "one.png"), np.zeros((400, 300), np.uint8))
    with pytest.raises(DatasetError, match=r"masks/one\.png is not of its photo's size"):
        traced_samples(200, [traced])
    cv2.imwrite(str(folder / "photos" / "one.jpg"), np.zeros((300, 400, 3), np.uint8))
    with pytest.raises(DatasetError, match="share a name"):
        traced_samples(200, [traced])


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


def test_photos_that_are_missing_are_reported(flight, tmp_path, caplog):
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


def test_views_with_few_buildings_leave_no_iou_and_the_reason_is_reported(tmp_path):
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
