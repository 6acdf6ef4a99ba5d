import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, Pose, wrap_deg
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.synthesis.mask_degradation import mask_iou
from lodbench.synthesis.town import build
from lodbench.synthesis.town.build import PRIORS, build_demo

# Every one looks at a town that is built for them.
pytestmark = pytest.mark.nightly

SPLITS = {"in_place": (0.88, 0.09), "out_of_place": (0.80, 0.15)}


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return build_demo(tmp_path_factory.mktemp("demo") / "town", num_queries=9)


@pytest.fixture(scope="module")
def renderer(demo):
    return SilhouetteRenderer(open_scene(demo / "town_lod3.gml", lod="3"), threads=1)


def files_of(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def mask_of(root: Path, split: str, name: str) -> Path:
    return (root / split / "masks" / name).with_suffix(".png")


def poses_of(path: Path, origin: np.ndarray) -> dict[str, Pose]:
    rows = [line.split() for line in path.read_text().splitlines()]
    return {
        row[0]: Pose.from_quaternion([float(v) for v in row[1:5]], [float(v) for v in row[5:]]).shifted(
            -origin
        )
        for row in rows
    }


def test_layout(demo):
    names = set(files_of(demo))
    assert {"town.gml", "town_lod3.gml", "relief.gml", "terrain.asc", "props.npz", "demo.json"} <= names
    counts = {}
    for split in SPLITS:
        assert {f"{split}/{file}" for file in ("GT_pose.txt", "GPS_pose.txt", "intrinsic.txt")} <= names
        lines = (demo / split / "intrinsic.txt").read_text().splitlines()
        for line in lines:
            name, model, *numbers = line.split()
            camera = Camera.from_colmap(
                model, int(numbers[0]), int(numbers[1]), [float(v) for v in numbers[2:]]
            )
            mask = cv2.imread(str(mask_of(demo, split, name)), cv2.IMREAD_UNCHANGED)
            photo = cv2.imread(str(demo / split / "Query_image" / name), cv2.IMREAD_COLOR)
            assert photo.shape == (camera.height, camera.width, 3)
            assert photo.std() > 20
            assert mask.shape == (camera.height, camera.width)
            assert set(np.unique(mask)) == {0, 255}
        counts[split] = len(lines)
    assert counts == {"in_place": 5, "out_of_place": 4}


@pytest.mark.parametrize("split", SPLITS)
def test_truths_priors_and_masks(demo, renderer, split):
    origin = renderer.scene.origin
    truths = poses_of(demo / split / "GT_pose.txt", origin)
    priors = poses_of(demo / split / "GPS_pose.txt", origin)
    assert list(truths) == list(priors)
    ious = []
    lowest, highest = renderer.scene.vertices[:, 2].min(), renderer.scene.vertices[:, 2].max()
    camera = build.QUERY_CAMERA
    for name, truth in truths.items():
        pitch, _, yaw = truth.euler
        assert 20 <= pitch <= 60
        assert lowest + 65 <= truth.center[2] <= highest + 165
        prior = priors[name]
        widest = PRIORS[split]
        reach = np.array([widest.x_m, widest.y_m, widest.z_m]) + 0.001
        assert (np.abs(prior.center - truth.center) <= reach).all()
        assert abs(prior.euler.pitch_deg - pitch) <= 1.001
        assert abs(wrap_deg(prior.euler.yaw_deg - yaw)) <= widest.yaw_deg + 0.001
        clean = renderer.render(camera, truth)
        assert 0.04 <= clean.mean() <= 0.82
        mask = cv2.imread(str(mask_of(demo, split, name)), cv2.IMREAD_UNCHANGED) > 127
        ious.append(mask_iou(mask, clean))
    mean, spread = SPLITS[split]
    assert mean - spread - 0.1 <= min(ious)
    assert max(ious) <= mean + spread
    assert np.mean(ious) == pytest.approx(mean, abs=0.03)
    assert np.ptp(ious) > spread


def test_splits_look_at_different_ground(demo, renderer):
    centers = [
        np.mean(
            [p.center for p in poses_of(demo / s / "GT_pose.txt", renderer.scene.origin).values()], axis=0
        )
        for s in SPLITS
    ]
    assert np.linalg.norm(centers[0][:2] - centers[1][:2]) > 100.0


def test_the_manifest_tells_what_was_made(demo):
    manifest = json.loads((demo / "demo.json").read_text())
    assert manifest["town_version"] == build.TOWN_VERSION
    assert (manifest["seed"], manifest["num_queries"]) == (0, 9)
    for split, target in SPLITS.items():
        told = manifest["splits"][split]
        assert told["queries"] == len(told["mask_iou"]) == len(list((demo / split / "masks").iterdir()))
        assert told["target_iou"] == list(target)


def test_photos_show_the_town_where_the_masks_say(demo, renderer):
    inside, outside = [], []
    for split in SPLITS:
        for name, truth in poses_of(demo / split / "GT_pose.txt", renderer.scene.origin).items():
            clean = renderer.render(build.QUERY_CAMERA, truth)
            photo = cv2.imread(str(demo / split / "Query_image" / name), cv2.IMREAD_COLOR).astype(float)
            edges = np.abs(cv2.Laplacian(photo.mean(axis=2), cv2.CV_64F))
            border = (
                cv2.morphologyEx(clean.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
            )
            shifted = np.roll(border, 25, axis=1)
            inside.append(edges[border].mean())
            outside.append(edges[shifted].mean())
    # The outlines of the model are edges of the photo; the same outlines 25 pixels aside are not.
    assert np.mean(inside) > 1.25 * np.mean(outside)


def test_a_finished_demo_is_left_alone(demo):
    before = (demo / "town.gml").stat().st_mtime_ns
    assert build_demo(demo, num_queries=9) == demo
    assert (demo / "town.gml").stat().st_mtime_ns == before


def test_another_demo_or_folder_is_not_overwritten(demo, tmp_path):
    with pytest.raises(DatasetError, match="another demo"):
        build_demo(demo, num_queries=9, seed=1)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(DatasetError, match="no demo"):
        build_demo(tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_nothing_is_left_of_a_build_that_fails(tmp_path, monkeypatch, town):
    def fail(*_args, **_kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(build, "grow_town", lambda seed, look: town)
    monkeypatch.setattr(build, "citygml_text", lambda town, is_fine=False: "some text")
    monkeypatch.setattr(build, "write_props", fail)
    with pytest.raises(OSError, match="disk full"):
        build_demo(tmp_path / "demo", num_queries=2)
    assert list(tmp_path.iterdir()) == []


def test_one_query_is_too_few(tmp_path):
    with pytest.raises(DatasetError, match="at least 2"):
        build_demo(tmp_path / "demo", num_queries=1)
