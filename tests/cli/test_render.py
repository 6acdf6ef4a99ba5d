"""`lodbench render`: every kind of picture, from the command line to the pixels."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.datasets.inputs import read_references
from lodbench.datasets.pose_text import format_pose, read_cameras, read_poses
from lodbench.rendering.raster import RasterRenderer
from tests.town import write_dataset


@pytest.fixture
def dataset(tmp_path):
    """A town of seven boxes and two views of it."""
    return write_dataset(tmp_path / "town", count=2)


@pytest.fixture
def render(lodbench, tmp_path, dataset):
    """Runs `lodbench render` over the dataset's true poses; returns the process and the out folder."""
    root, city = dataset

    def run(*words):
        out = tmp_path / "out, (1)"
        done = lodbench(
            "render",
            f"city={city}",
            f"poses={root / 'GT_pose.txt'}",
            f"intrinsics={root / 'intrinsic.txt'}",
            f"out={out}",
            *words,
        )
        return done, out

    return run


@pytest.fixture
def layers(dataset):
    """What the raster says of each view, by name without suffix."""
    root, city = dataset
    scene, cameras = open_scene(city), read_cameras(root / "intrinsic.txt")
    raster = RasterRenderer(scene, 1)
    return {
        name.split(".")[0]: raster.draw(cameras[name], pose.shifted(-scene.origin))
        for name, pose in read_poses(root / "GT_pose.txt").items()
    }


def read(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def test_depth(render, layers):
    done, out = render("kind=depth")
    assert done.returncode == 0, done.stderr
    assert "4 files" in done.stdout
    for name, expected in layers.items():
        np.testing.assert_array_equal(np.load(out / f"{name}.npy"), expected.depth)
        picture = read(out / f"{name}.png")
        assert picture.dtype == np.uint16
        assert np.abs(picture / 100.0 - expected.depth).max() <= 0.00501
        assert ((picture > 0) == expected.mask).all()


def test_label(render, layers, dataset):
    done, out = render("kind=label")
    assert done.returncode == 0, done.stderr
    names = json.loads((out / "labels.json").read_text())
    scene = open_scene(dataset[1])
    assert [names[str(i + 1)] for i in range(scene.num_buildings)] == list(scene.building_ids)
    for name, expected in layers.items():
        np.testing.assert_array_equal(read(out / f"{name}.png"), expected.building + 1)


def test_instances(render, layers, dataset):
    done, out = render("kind=instance")
    assert done.returncode == 0, done.stderr
    ids = open_scene(dataset[1]).building_ids
    for name, seen in layers.items():
        union, found = np.zeros(seen.mask.shape, dtype=bool), json.loads((out / f"{name}.json").read_text())
        for instance in found["instances"]:
            runs = instance["segmentation"]["counts"]
            flat = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
            mask = flat.reshape(seen.mask.shape[::-1]).T
            assert instance["segmentation"]["size"] == list(mask.shape)
            assert instance["area"] == mask.sum()
            left, top, width, height = instance["bbox"]
            assert mask[top : top + height, left : left + width].sum() == mask.sum()
            # What is seen of it, and what is hidden besides.
            assert mask[seen.building == ids.index(instance["building"])].all()
            union |= mask
        np.testing.assert_array_equal(union, seen.mask)
        assert len(found["instances"]) > 2


def test_colour_at_another_size(render):
    done, out = render("kind=colour", "size=[160,120]")
    assert done.returncode == 0, done.stderr
    picture = read(out / "view_00.png")
    assert picture.shape == (120, 160, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 5


def test_overlay_over_photos_and_over_grey(render, tmp_path, layers):
    photos = tmp_path / "my photos"
    photos.mkdir()
    for name in layers:
        cv2.imwrite(str(photos / f"{name}.png"), np.full((240, 320, 3), (9, 90, 200), dtype=np.uint8))
    done, out = render("kind=overlay", f"images={photos}")
    assert done.returncode == 0, done.stderr
    drawn = (read(out / "view_00.png") != (9, 90, 200)).any(axis=2)
    assert 0 < drawn.sum() < 0.2 * drawn.size
    assert not (drawn & (cv2.dilate(layers["view_00"].mask.astype(np.uint8), np.ones((5, 5))) == 0)).any()
    assert render("kind=overlay")[0].returncode == 0
    assert len(np.unique(read(out / "view_01.png").reshape(-1, 3), axis=0)) > 1


def test_photos_and_other_pictures_are_never_replaced(render, tmp_path, layers):
    out = tmp_path / "out, (1)"
    out.mkdir()
    for name in layers:
        cv2.imwrite(str(out / f"{name}.png"), np.full((240, 320, 3), (9, 90, 200), dtype=np.uint8))
    photo = (out / "view_00.png").read_bytes()
    for words, expected in (
        (["kind=overlay", f"images={out}"], "holds the photos"),
        (["kind=depth"], "view_00.png is there already"),
        ([], "view_00.png is there already"),
    ):
        done, _ = render(*words)
        assert (done.returncode, done.stdout) == (2, "")
        assert expected in done.stderr
        assert "out=DIR" in done.stderr
        assert (out / "view_00.png").read_bytes() == photo


def test_masks_made_by_hand_are_never_replaced(render, tmp_path):
    """They have the bits of silhouettes; only pictures that say they were drawn are drawn anew."""
    assert [render()[0].returncode for _ in range(2)] == [0, 0]
    out = tmp_path / "out, (1)"
    by_hand = out / "view_01.png"
    cv2.imwrite(str(by_hand), np.zeros((240, 320), dtype=np.uint8))
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    done, _ = render("size=[160,120]")
    assert done.returncode == 2
    assert "view_01.png is there already, and is no such picture" in done.stderr
    assert {file.name: file.read_bytes() for file in out.iterdir()} == before


@pytest.mark.parametrize(("kind", "name"), [("instance", "view_01.json"), ("label", "labels.json")])
def test_files_of_one_s_own_are_never_replaced(render, tmp_path, kind, name):
    """Tools of annotation write JSON under the name of the photo."""
    out = tmp_path / "out, (1)"
    out.mkdir()
    (out / name).write_text('{"shapes": []}')
    done, _ = render(f"kind={kind}")
    assert done.returncode == 2
    assert f"{name} is there already, and is no such file" in done.stderr
    assert [file.name for file in out.iterdir()] == [name]
    (out / name).unlink()
    assert [render(f"kind={kind}")[0].returncode for _ in range(2)] == [0, 0]


@pytest.mark.parametrize("renderer", ["reference", "raster"])
def test_silhouettes_are_the_same_bytes_whatever_the_renderer(render, renderer):
    done, out = render()
    assert done.returncode == 0, done.stderr
    usual = {path.name: path.read_bytes() for path in out.iterdir()}
    assert render(f"renderer={renderer}", "size=[320,240]")[0].returncode == 0
    assert {path.name: path.read_bytes() for path in out.iterdir()} == usual


@pytest.mark.parametrize(
    ("file", "edit", "expected"),
    [
        ("GT_pose.txt", lambda text: text + text.splitlines()[0].replace(".png", ".jpg"), "view_00.png"),
        ("intrinsic.txt", lambda text: text.splitlines()[0], "view_01.png has no camera"),
        (
            "intrinsic.txt",
            lambda text: text.replace("PINHOLE", "OPENCV").replace("\n", " 0.1 0 0 0\n"),
            "pinhole",
        ),
    ],
)
def test_inputs_that_do_not_go_together(render, dataset, file, edit, expected):
    path = dataset[0] / file
    path.write_text(edit(path.read_text()))
    done, out = render()
    assert done.returncode == 2, done.stdout
    assert expected in done.stderr
    assert not out.exists()


def test_cameras_that_see_nothing_of_the_city_are_told(render, dataset):
    """Poses of another tile, or in local coordinates, draw empty pictures."""
    file = dataset[0] / "GT_pose.txt"
    poses = {name: pose.shifted((90_000.0, 0.0, 0.0)) for name, pose in read_poses(file).items()}
    file.write_text("".join(f"{format_pose(name, pose)}\n" for name, pose in poses.items()))
    done, _ = render()
    assert done.returncode == 0
    assert "note: the cameras are 89." in done.stdout
    assert "Is it the right tile" in done.stdout


def test_help_says_what_the_pictures_hold(lodbench):
    text = lodbench("render", "--help").stdout
    for word in ("centimetres", "655.35 m", "labels.json", "images=DIR", "NAME.json", "0.1 m"):
        assert word in text


def test_a_photo_that_is_none(render, tmp_path, layers):
    for name in layers:
        (tmp_path / f"{name}.png").write_text("not a picture")
    done, out = render("kind=overlay", f"images={tmp_path}")
    assert done.returncode == 2
    assert "view_00.png is not a picture" in done.stderr
    assert not out.exists()


def test_a_photo_of_another_shape_is_no_background(render, tmp_path, layers):
    """It was pressed into the camera's, and nothing in the overlay lay where it should."""
    for name in layers:
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((240, 240, 3), dtype=np.uint8))
    done, out = render("kind=overlay", f"images={tmp_path}")
    assert done.returncode == 2
    assert "view_00.png is 240 x 240, its camera 320 x 240: another aspect" in done.stderr
    done, _ = render("kind=depth", f"images={tmp_path}")
    assert "images= is not used by kind=depth" in done.stderr
    assert not out.exists()


def test_a_textured_map_is_drawn_and_its_pictures_serve_as_references(dataset, render, tmp_path):
    root, city = dataset
    low, high = open_scene(city).extent_m
    (x0, y0), (x1, y1), z = low[:2], high[:2], low[2]
    cv2.imwrite(str(tmp_path / "ground.png"), np.full((8, 8, 3), (40, 120, 200), dtype=np.uint8))
    (tmp_path / "m.mtl").write_text("newmtl ground\nmap_Kd ground.png\n")
    corners = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
    lines = ["mtllib m.mtl", "usemtl ground", *(f"v {x} {y} {z}" for x, y in corners)]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", "f 1/1 2/2 3/3 4/4"]
    (tmp_path / "map.obj").write_text("\n".join(lines) + "\n")
    done, out = render("kind=colour", f"textured_map={tmp_path / 'map.obj'}")
    assert done.returncode == 0, done.stderr
    assert "map.obj is in" in done.stdout
    references = read_references(out)
    assert [r.name for r in references] == [
        f"{Path(name).stem}.png" for name in read_poses(root / "GT_pose.txt")
    ]
    for reference in references:
        assert (read(reference.image) == (40, 120, 200)).all(axis=2).mean() > 0.05
    before = (root / "intrinsic.txt").read_text()
    done, _ = render("kind=colour", f"textured_map={tmp_path / 'map.obj'}", "size=[64,48]", f"out={root}")
    assert "intrinsic.txt is read" in done.stderr
    assert (root / "intrinsic.txt").read_text() == before
    done, _ = render("kind=depth", f"textured_map={tmp_path / 'map.obj'}")
    assert done.returncode == 2
    assert "textured map" in done.stderr
