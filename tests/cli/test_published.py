"""`lodbench run` on miniatures of the published datasets, as a person runs it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.data.published_layouts import write_lodlocv2, write_swiss


def summary_of(folder: Path) -> dict:
    (path,) = folder.glob("runs/*/*/*/summary.json")
    return json.loads(path.read_text())


@pytest.mark.slow
def test_a_run_on_the_earth_centred_swiss_files(lodbench, tmp_path):
    root = write_swiss(tmp_path / "Schweiz (neu)", ecef=True)
    done = lodbench("run", "dataset=swiss_epflv2", f"dataset.root={root}", "tilt=truth", "split=in_place")
    assert done.returncode == 0, done.stderr
    assert "2 x LB510 TURNED_TO_ENU" in done.stdout
    summary = summary_of(tmp_path)
    # Exact masks: a frame or a direction mixed up would leave metres or all of it.
    assert summary["splits"]["in_place"]["recall"]["2m-2deg"] == 100.0
    assert list(summary["splits"]) == ["in_place"]


def test_a_run_on_the_colmap_tree_below_the_data_folder(lodbench, tmp_path):
    write_lodlocv2(tmp_path / "data_root")
    words = ("run", "dataset=uavd4l_lodv2", "method=prior_only")
    done = lodbench(*words, LODBENCH_DATA=str(tmp_path / "data_root"))
    assert done.returncode == 0, done.stderr
    splits = summary_of(tmp_path)["splits"]
    assert {name: split["num_queries"] for name, split in splits.items()} == {"in_traj": 2, "out_of_traj": 2}
    again = lodbench(*words, f"paths.data_root={tmp_path / 'data_root'}")
    assert again.returncode == 0
    assert "4 queries were there already" in again.stdout


@pytest.mark.parametrize("name", ["uavd4l_lod", "uavd4l_lodv2", "swiss_epfl", "swiss_epflv2"])
def test_absent_data_is_explained_on_one_screen(lodbench, tmp_path, name):
    done = lodbench("run", f"dataset={name}", LODBENCH_DATA=str(tmp_path / "nothing here"))
    assert done.returncode == 2
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert len(lines) <= 24
    assert f"  lodbench dataset check {name}" in lines
    assert not (tmp_path / "runs").exists()


def test_an_absent_city_model_is_explained_too(lodbench, tmp_path):
    root = write_swiss(tmp_path / "data", ecef=False)
    (root / "MODEL" / "swiss_LoD1_final.obj").unlink()
    done = lodbench("run", "dataset=swiss_epflv2", f"dataset.root={root}", "segmenter=masks")
    assert done.returncode == 2
    assert "city model: none of swiss_LoD1_final.obj" in done.stderr


def test_masks_that_are_not_there_stop_before_the_work(lodbench, tmp_path):
    root = write_swiss(tmp_path / "data", ecef=False)
    for folder in root.glob("Swiss-EPFL/*/masks"):
        folder.rename(folder.with_name("elsewhere"))
    done = lodbench("run", "dataset=swiss_epflv2", f"dataset.root={root}", "segmenter=masks")
    assert done.returncode == 2
    assert "segmenter=masks needs masks, and the dataset has none" in done.stderr
    assert not (tmp_path / "runs").exists()


def test_a_download_that_fetches_nothing_is_no_success(lodbench, tmp_path):
    done = lodbench("dataset", "download", "swiss_epfl", "--root", str(tmp_path))
    assert done.returncode == 1
    assert "cannot be downloaded automatically" in done.stdout
    assert "by hand: " in done.stdout
