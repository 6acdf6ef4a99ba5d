"""`lodbench leaderboard`: only verified runs get in, oracles stand apart, files follow from entries."""

import csv
import json
import re
import shutil
from pathlib import Path

import pytest

from tests.town import write_dataset


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> tuple[Path, Path]:
    return write_dataset(tmp_path_factory.mktemp("town"), count=3)


def run(lodbench, tmp_path: Path, data: tuple[Path, Path], *more: str) -> Path:
    words = ["run", "method=prior_only", "dataset=folder", f"dataset.root={data[0]}"]
    done = lodbench(*words, f"dataset.city_model={data[1]}", *more)
    assert done.returncode == 0, done.stderr
    return Path(re.search(r"results:\s+(\S+)", done.stdout)[1])


def entries(tmp_path: Path) -> list[dict]:
    return [json.loads(p.read_text()) for p in sorted(tmp_path.glob("leaderboard/entries/folder/*.json"))]


def test_a_run_ranks_and_its_oracle_twin_does_not(lodbench, tmp_path, data):
    honest = run(lodbench, tmp_path, data)
    oracle = run(lodbench, tmp_path, data, "tilt=truth")
    for folder in (honest, oracle):
        assert lodbench("leaderboard", "add", str(folder)).returncode == 0
    by_tilt = {entry["protocol"]["tilt"]: entry for entry in entries(tmp_path)}
    assert by_tilt["prior"]["ranking"] == {"ranked": True, "reasons": []}
    assert "oracle" in by_tilt["truth"]["ranking"]["reasons"][0]
    assert by_tilt["prior"]["protocol"]["prior"]
    assert by_tilt["prior"]["protocol"]["code"]
    assert lodbench("leaderboard", "build", "--check").returncode == 1
    assert lodbench("leaderboard", "build").returncode == 0
    assert lodbench("leaderboard", "build", "--check").returncode == 0
    lines = list(csv.DictReader((tmp_path / "leaderboard" / "folder.csv").open()))
    assert [(line["tilt"], line["rank"]) for line in lines] == [("prior", "1"), ("truth", "")]


def test_a_run_without_masks_has_an_entry(lodbench, tmp_path, data):
    done = lodbench("leaderboard", "add", str(run(lodbench, tmp_path, data, "segmenter=none")))
    assert done.returncode == 0, done.stderr
    assert "masks" not in entries(tmp_path)[0]["protocol"]


def test_the_board_of_a_dataset_whose_last_entry_is_gone_is_told(lodbench, tmp_path, data):
    assert lodbench("leaderboard", "add", str(run(lodbench, tmp_path, data))).returncode == 0
    entries = tmp_path / "leaderboard" / "entries" / "folder"
    shutil.copytree(entries, entries.with_name("other"))
    for path in entries.with_name("other").glob("*.json"):
        entry = json.loads(path.read_text())
        path.write_text(json.dumps({**entry, "dataset": {**entry["dataset"], "name": "other"}}))
    assert lodbench("leaderboard", "build").returncode == 0
    shutil.rmtree(entries.with_name("other"))
    assert lodbench("leaderboard", "build").returncode == 0
    done = lodbench("leaderboard", "build", "--check")
    assert done.returncode == 1
    assert "leaderboard/other.csv: no entry makes it any more: remove it" in done.stdout


def test_a_tampered_run_is_refused_and_an_unverifiable_one_stands_apart(lodbench, tmp_path, data):
    folder = run(lodbench, tmp_path, data)
    provenance = (folder if folder.is_absolute() else tmp_path / folder) / "provenance.json"
    whole = provenance.read_text()
    provenance.write_text(re.sub(r'("dataset_root": )".*"', r'\1"/no/such"', whole))
    assert "not verified" in lodbench("leaderboard", "add", str(folder)).stdout
    assert entries(tmp_path)[0]["ranking"]["ranked"] is False
    provenance.write_text(whole)
    summary = provenance.with_name("summary.json")
    summary.write_text(summary.read_text().replace('"num_failed": 0', '"num_failed": 1', 1))
    done = lodbench("leaderboard", "add", str(folder))
    assert done.returncode == 1
    assert "not added" in done.stderr


def test_a_run_without_truth_is_refused_in_words(lodbench, tmp_path):
    root, city = write_dataset(tmp_path / "untold", count=2)
    (root / "GT_pose.txt").unlink()
    (root / "dataset.json").write_text('{"truth": false}')
    done = lodbench("leaderboard", "add", str(run(lodbench, tmp_path, (root, city))))
    assert done.returncode == 2
    assert "has no truth for data, without which nothing is scored" in done.stderr
    assert not entries(tmp_path)


def test_a_submitted_pose_file_stands_apart(lodbench, tmp_path, data):
    poses = data[0] / "GPS_pose.txt"
    assert lodbench("evaluate", f"poses={poses}", "dataset=folder", f"dataset.root={data[0]}").returncode == 0
    (folder,) = (tmp_path / "runs" / "folder" / "GPS_pose").iterdir()
    done = lodbench("leaderboard", "add", str(folder))
    assert done.returncode == 0, done.stdout + done.stderr
    (entry,) = entries(tmp_path)
    assert (entry["source"], entry["ranking"]["ranked"]) == ("submitted", False)


def test_an_empty_leaderboard_is_one_line(lodbench):
    done = lodbench("leaderboard", "build")
    assert done.returncode == 2
    assert "holds no entries" in done.stderr


def test_copies_rank_once_and_seeds_are_told_apart(lodbench, tmp_path, data):
    """Three copies of a run were ranked 1, 1, 1, and the next one 4th."""
    honest = run(lodbench, tmp_path, data)
    other = run(lodbench, tmp_path, data, "seed=1")
    twin = shutil.copytree(tmp_path / honest, tmp_path / "twin")
    assert lodbench("leaderboard", "add", str(honest), str(other)).returncode == 0
    done = lodbench("leaderboard", "add", str(twin))
    assert done.returncode == 2
    assert "is a copy of a run that has an entry" in done.stderr
    assert len(entries(tmp_path)) == 2
    assert lodbench("leaderboard", "build").returncode == 0
    text = (tmp_path / "leaderboard" / "folder.md").read_text()
    assert "seed 0]" in text
    assert "seed 1]" in text


def test_nothing_is_added_where_one_of_the_words_is_no_run(lodbench, tmp_path, data):
    honest = run(lodbench, tmp_path, data)
    assert lodbench("leaderboard", "add", str(honest), "nosuch").returncode == 2
    assert entries(tmp_path) == []
