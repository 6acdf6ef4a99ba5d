"""Everything that can go wrong: a clear error, and finished files stay usable."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.citymodel.options import ReadOptions
from lodbench.cli import main
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.errors import ConfigError, DatasetError
from lodbench.rendering.reference import ReferenceRenderer
from lodbench.segmentation.masks import read_mask
from lodbench.storage import file_digest
from lodbench.synthesis import generate as manifest
from lodbench.synthesis import plan_views
from lodbench.synthesis.camera_paths import GenerateParams
from lodbench.synthesis.generate import generate_training_data
from lodbench.synthesis.photo import LookRanges, look_ranges
from tests.synthesis.conftest import SMALL, WHOLE


def files_in(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.slow
def test_the_folder_opens_as_a_dataset_whose_masks_are_those_of_its_poses(small_set, box_file):
    params, made = small_set
    dataset = open_folder(FolderParams(params.out, str(box_file)))
    assert dataset.splits == ("train",)
    assert len(dataset.entries) == made.views["train"] > 3
    reference = ReferenceRenderer(open_scene(box_file))
    for entry in dataset.entries:
        expected = reference.render(entry.camera, dataset.truth[entry.key])
        np.testing.assert_array_equal(read_mask(entry.mask) > 0.5, expected)
        assert expected.mean() >= params.min_buildings
        assert cv2.imread(str(entry.image)).shape == (80, 96, 3)


def test_labels_and_depth_belong_to_the_masks(small_set):
    _, made = small_set
    for path in sorted((made.out / "train" / "masks").iterdir()):
        mask = read_mask(path) > 0.5
        labels = cv2.imread(str(made.out / "train" / "labels" / path.name), cv2.IMREAD_UNCHANGED)
        classes = cv2.imread(str(made.out / "train" / "classes" / path.name), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(classes > 0, labels > 0)
        assert set(classes.ravel()) <= {0, 1, 2}
        depth = cv2.imread(str(made.out / "train" / "depth" / path.name), cv2.IMREAD_UNCHANGED)
        assert labels.dtype == depth.dtype == np.uint16
        np.testing.assert_array_equal(labels > 0, mask)
        assert labels.max() <= 7
        # Cameras are 90 m above the ground; the highest building is 40 m.
        assert depth[depth > 0].min() > 3500


def test_masks_are_bilevel(small_set):
    _, made = small_set
    content = next((made.out / "train" / "masks").iterdir()).read_bytes()
    assert content[24] == 1  # IHDR: bit depth
    assert content[25] == 0  # grey


@pytest.mark.slow
def test_two_processes_write_the_same_bytes(small_set, tmp_path):
    params, made = small_set
    again = generate_training_data(replace(params, out=str(tmp_path / "data"), workers=2))
    assert files_in(again.out) == files_in(made.out)


def test_another_seed_gives_other_pictures_of_the_same_poses(small_set, tmp_path):
    params, made = small_set
    other = files_in(generate_training_data(replace(params, out=str(tmp_path / "data"), seed=1)).out)
    same = files_in(made.out)
    assert other["train/poses.txt"] == same["train/poses.txt"]
    assert all(other[name] != same[name] for name in same if "/images/" in name)


def test_the_manifest_says_what_it_was_made_of(small_set, box_file):
    _, made = small_set
    manifest = json.loads((made.out / "manifest.json").read_text())
    assert manifest["inputs"] == {"city": {"city.obj": file_digest(box_file)}}
    assert manifest["settings"]["pitch"] == SMALL["pitch"]
    assert manifest["views"] == made.views
    assert manifest["state"] == "finished"
    assert manifest["source"] == {}
    assert manifest["candidates"] == sum(made.views.values()) + sum(made.skipped.values())


def test_what_is_missing_is_made_again_and_nothing_else(small_set, tmp_path):
    params, made = small_set
    before = files_in(made.out)
    victims = sorted((made.out / "train" / "images").iterdir())
    victims[1].unlink()
    victims[2].write_bytes(b"")  # as a power cut may leave it
    again = generate_training_data(params)
    assert again.resumed == sum(made.views.values()) - 2
    assert files_in(made.out) == before


def test_a_folder_of_another_set_is_left_alone(small_set):
    params, made = small_set
    before = files_in(made.out)
    with pytest.raises(DatasetError, match="seed is 0 there"):
        generate_training_data(replace(params, seed=5))
    assert files_in(made.out) == before


@pytest.mark.attack
@pytest.mark.nightly
def test_a_killed_run_leaves_whole_pictures_and_goes_on(small_set, tmp_path):
    params, made = small_set
    out = tmp_path / "data"
    words = [f"city={params.city}", f"out={out}", "labels=true", "depth=true", "classes=true", "workers=2"]
    words += ["pitch=[40]", "height=[90]", "yaw=[0,120,240]", "size=[96,80]", "val_share=0", "test_share=0"]
    command = [sys.executable, "-m", "lodbench", "generate-training-data", *words]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    images = out / "train" / "images"
    deadline = time.monotonic() + 120
    while process.poll() is None and time.monotonic() < deadline:
        if images.is_dir() and len([path for path in images.iterdir() if path.suffix == ".jpg"]) >= 2:
            os.kill(process.pid, signal.SIGKILL)
            break
        time.sleep(0.002)
    assert process.wait() == -signal.SIGKILL
    written = [path for path in out.rglob("*.[jp][pn]g") if not path.name.startswith(".")]
    assert 0 < len(written) < 5 * sum(made.views.values())
    for path in written:
        assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED) is not None
        assert path.read_bytes() == (made.out / path.relative_to(out)).read_bytes()
    assert main(["generate-training-data", *words]) == 0
    assert files_in(out) == files_in(made.out)


@pytest.mark.attack
@pytest.mark.nightly
def test_a_full_disk_stops_with_a_clear_error_and_the_rest_follows(small_set, tmp_path, monkeypatch):
    params, made = small_set
    params = replace(params, out=str(tmp_path / "data"))
    room = [7]

    def write(path: Path, content: bytes, survives_power_cut: bool = True) -> None:
        if room[0] == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        room[0] -= 1
        path.write_bytes(content)

    with monkeypatch.context() as patched:
        patched.setattr(plan_views, "write_bytes", write)
        with pytest.raises(DatasetError, match=r"full after 1 of \d+ views") as caught:
            generate_training_data(params)
    assert "goes on" in caught.value.hint
    assert len([path for path in (tmp_path / "data" / "train").rglob("*.??g")]) == 7
    assert generate_training_data(params).resumed == 1
    assert files_in(tmp_path / "data") == files_in(made.out)


@pytest.mark.attack
@pytest.mark.nightly
def test_a_set_goes_on_neither_with_another_city_nor_with_other_code(small_set, monkeypatch):
    """Its poses are written anew each time: views that are there already would be of others."""
    params, made = small_set
    before = files_in(made.out)
    with pytest.raises(DatasetError, match="read in another way"):
        generate_training_data(params, ReadOptions(up_axis="y"))
    monkeypatch.setattr(manifest, "_code_digest", lambda: "other")
    with pytest.raises(DatasetError, match="another version of lodbench"):
        generate_training_data(params)
    assert files_in(made.out) == before


def test_the_manifest_says_how_the_city_was_read(box_file, tmp_path):
    """Without it nobody makes the set again, or lays its map over its photos."""
    asked = GenerateParams(str(box_file), str(tmp_path / "a"), crs="EPSG:25832", limit=1, **SMALL, **WHOLE)
    options = ReadOptions(crs="EPSG:25833", origin=(691000.0, 5335000.0, 500.0), layers=("bridges",))
    generate_training_data(asked, options)
    told = json.loads((tmp_path / "a" / "manifest.json").read_text())
    assert told["city"]["crs"] == "EPSG:25832"
    assert ReadOptions.from_mapping(told["source"]) == replace(options, crs="EPSG:25832")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"pitch": []}, "pitch is empty"),
        ({"pitch": [95.0]}, "pitch=95 is not within 0 to 90"),
        ({"height": [-3.0]}, "height=-3 is not within"),
        ({"size": (8, 8)}, "size=8 is not within"),
        ({"sampling": "spiral"}, "sampling=spiral is not known"),
        ({"sampling": "priors"}, "needs poses"),
        ({"poses": "track.txt"}, "poses means nothing to sampling=grid"),
        ({"count": 50}, "count means nothing to sampling=grid"),
        ({"sampling": "random", "spacing_m": 20.0}, "spacing_m means nothing to sampling=random"),
        ({"sampling": "priors", "poses": "a", "height": [80.0]}, "height means nothing to sampling=priors"),
        ({"sampling": "trajectory", "poses": "a", "height": [80.0]}, "height means nothing to"),
        ({"texture_model": "a.obj", "props": "p.npz"}, "props means nothing to texture_model"),
        ({"texture_up": "y"}, "texture_up means nothing without texture_model"),
        ({"renderer": "pyrender"}, "textured meshes only"),
        ({"val_share": 0.6, "test_share": 0.6}, "leave little to train on"),
        ({"fov_deg": float("nan")}, "fov_deg=nan"),
    ],
)
def test_impossible_settings_are_named(settings, message):
    with pytest.raises(ConfigError, match=message):
        GenerateParams("city.obj", "out", **settings)


def test_more_buildings_than_labels_tell_apart_are_refused(box_file, tmp_path, monkeypatch):
    monkeypatch.setattr("lodbench.synthesis.generate.MOST_LABELS", 1)
    params = GenerateParams(str(box_file), str(tmp_path / "data"), labels=True, **{**SMALL, **WHOLE})
    with pytest.raises(ConfigError, match="labels hold at most 1"):
        generate_training_data(params)
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    "ranges", [{"noise": (0.1, 0.0)}, {"sun_elevation_deg": (-5.0, 20.0)}, {"exposure": (1.0, float("inf"))}]
)
def test_impossible_looks_are_named(ranges):
    with pytest.raises(ConfigError, match=f"look.{next(iter(ranges))} is"):
        LookRanges(**ranges)


def test_no_building_anywhere_counts_the_reasons(box_file, tmp_path):
    params = GenerateParams(str(box_file), str(tmp_path / "data"), min_buildings=0.99, **{**SMALL, **WHOLE})
    with pytest.raises(DatasetError, match=r"None of \d+ views can be taken: \d+ too few buildings in view"):
        generate_training_data(params)
    assert not (tmp_path / "data").exists()


def test_the_command_exits_with_2_and_one_line(box_file, tmp_path, capsys):
    words = ["generate-training-data", f"city={box_file}", f"out={tmp_path / 'data'}"]
    assert main([*words, "heigth=[100]"]) == 2
    assert "height" in capsys.readouterr().err
    assert main([*words, "texture_model=nowhere.obj"]) == 2
    assert "nowhere.obj does not exist" in capsys.readouterr().err
    assert main([*words, "look.noise=[2,3]"]) == 2
    assert "look.noise is [2, 3]" in capsys.readouterr().err
    assert main([*words, "look=hrd"]) == 2
    assert capsys.readouterr().err.splitlines() == [
        "lodbench: There is no look 'hrd'.",
        "  hint: Did you mean hard?",
    ]
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("look", ["hard", "plain"])
def test_a_look_is_chosen_by_name_and_told_by_the_manifest(box_file, tmp_path, look):
    out = tmp_path / "data"
    words = [f"city={box_file}", f"out={out}", f"look={look}", "limit=2", "size=[64,48]", "executor=serial"]
    assert main(["generate-training-data", *words, "min_buildings=0", "height=[80]"]) == 0
    asked = json.loads((out / "manifest.json").read_text())["settings"]["look"]
    ranges = {key: list(value) for key, value in asdict(look_ranges(look)).items()}
    assert asked == ranges
    assert look_ranges(look) != look_ranges("varied")


def test_another_folder_is_never_written_into(box_file, tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "thesis.txt").write_text("all of it")
    params = GenerateParams(str(box_file), str(tmp_path / "data"), **SMALL, **WHOLE)
    with pytest.raises(DatasetError, match="something else than a training set"):
        generate_training_data(params)
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["thesis.txt"]


def test_more_views_than_can_be_held_are_refused_before_they_are_laid_out(box_file, tmp_path):
    params = GenerateParams(city=str(box_file), out=str(tmp_path), sampling="grid", spacing_m=0.1)
    with pytest.raises(ConfigError, match=r"A grid every 0\.1 m over .* has .* views, more than") as told:
        generate_training_data(replace(params, yaw=[float(yaw) for yaw in range(360)]))
    assert "spacing_m=" in told.value.hint
    with pytest.raises(ConfigError, match="is not within 1 to"):
        GenerateParams(city="x", out="x", sampling="random", count=3_000_000)


def test_draws_around_too_many_poses_are_refused(box_file, tmp_path, monkeypatch):
    monkeypatch.setattr("lodbench.synthesis.plan_views.MOST_VIEWS", 5)
    params = GenerateParams(city=str(box_file), out=str(tmp_path / "a"), sampling="random", count=6)
    with pytest.raises(ConfigError, match="more than 5 views to choose from") as told:
        generate_training_data(params)
    assert "count=" in told.value.hint
