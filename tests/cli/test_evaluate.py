"""`lodbench evaluate`: a pose file becomes the artefacts of a run, which verify."""

import csv
import json
from pathlib import Path

import pytest

from lodbench.datasets.exchange.photogrammetry import write_odm
from lodbench.datasets.pose_files import brought
from lodbench.datasets.pose_text import FoundPose, inverted, read_poses
from tests.datasets.test_pose_files import lines
from tests.town import write_dataset


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("town"), count=4)[0]


def evaluate(data: Path, poses: Path, *more: str) -> list[str]:
    return ["evaluate", f"poses={poses}", "dataset=folder", f"dataset.root={data}", *more]


def run_folder(tmp_path: Path, name: str) -> Path:
    (folder,) = (tmp_path / "runs" / "folder" / name).iterdir()
    return folder


def test_a_file_is_scored_without_a_city_and_verifies(lodbench, tmp_path, data):
    truth = read_poses(data / "GT_pose.txt")
    poses = dict(list(truth.items())[:3])
    poses["view_01.png"] = poses["view_01.png"].shifted([3.5, 0.0, 0.0])
    path = tmp_path / "ours (final, v=2).txt"
    path.write_text(lines({**poses, "elsewhere.png": truth["view_00.png"]}))
    done = lodbench(*evaluate(data, path, "method_name=ours", "split=data"))
    assert done.returncode == 0, done.stderr
    assert "1 x no pose in the pose file" in done.stdout
    assert "elsewhere.png" in done.stdout
    folder = run_folder(tmp_path, "ours")
    split = json.loads((folder / "summary.json").read_text())["splits"]["data"]
    assert (split["num_queries"], split["num_failed"]) == (4, 1)
    assert split["recall"] == {"2m-2deg": 50.0, "3m-3deg": 50.0, "5m-5deg": 75.0}
    assert split["hypotheses_per_query"] is None
    rows = list(csv.DictReader((folder / "queries.csv").open()))
    assert rows[3]["failure"] == "no pose in the pose file"
    checked = lodbench("verify", str(folder))
    assert checked.returncode == 0, checked.stdout + checked.stderr
    text = (folder / "queries.csv").read_text()
    (folder / "queries.csv").write_text(text.replace("no pose in the pose file", ""))
    assert lodbench("verify", str(folder)).returncode == 1


def test_poses_in_another_system_than_the_dataset_s_are_brought_there(lodbench, tmp_path):
    data, _ = write_dataset(tmp_path / "town", count=2)
    (data / "dataset.json").write_text('{"crs": "EPSG:25832"}')
    truth = {
        name: pose.shifted([281000.0, 5657000.0, 0.0])
        for name, pose in read_poses(data / "GT_pose.txt").items()
    }
    (data / "GT_pose.txt").write_text(lines(truth))
    found = [FoundPose(name, "", pose, crs="EPSG:25832") for name, pose in truth.items()]
    write_odm(brought(found, "EPSG:25833")[0], tmp_path / "geo.txt", "EPSG:25833")
    done = lodbench(*evaluate(data, tmp_path / "geo.txt", "method_name=ours"))
    assert done.returncode == 0, done.stderr
    assert "poses in EPSG:25833 brought to EPSG:25832" in done.stdout
    summary = json.loads((run_folder(tmp_path, "ours") / "summary.json").read_text())
    assert summary["splits"]["data"]["recall"]["2m-2deg"] == 100.0


def test_the_wrong_direction_is_said_and_not_mended(lodbench, tmp_path, data):
    truth = read_poses(data / "GT_pose.txt")
    (tmp_path / "turned.txt").write_text(lines({name: inverted(pose) for name, pose in truth.items()}))
    done = lodbench(*evaluate(data, tmp_path / "turned.txt"))
    assert done.returncode == 0, done.stderr
    assert "camera to world" in done.stdout
    summary = json.loads((run_folder(tmp_path, "turned") / "summary.json").read_text())
    assert summary["splits"]["data"]["recall"]["5m-5deg"] == 0.0
    assert lodbench("verify", str(run_folder(tmp_path, "turned"))).returncode == 0


@pytest.mark.parametrize(
    ("content", "said"),
    [("view_00.png 1 0 0 0 nan 0 0\n", "line 1"), ("view_00.png 1 0 0 0 1 0 0\n" * 2, "has a pose already")],
)
def test_faults_are_one_line(lodbench, tmp_path, data, content, said):
    (tmp_path / "p.txt").write_text(content)
    done = lodbench(*evaluate(data, tmp_path / "p.txt"))
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "runs").exists()
