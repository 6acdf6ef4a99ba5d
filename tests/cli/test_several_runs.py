"""Patterns of run folders: `report` and `export` take several runs, and what is no run is passed over."""

import re
from pathlib import Path

import pytest

from tests.town import write_dataset


@pytest.fixture
def runs(lodbench, tmp_path) -> list[str]:
    """Two runs, a folder that is none and a file, as a pattern names them."""
    root, city = write_dataset(tmp_path / "town", count=2)
    words = ["run", "dataset=folder", f"dataset.root={root}", f"city={city}", "method=prior_only"]
    made = [re.search(r"results:\s+(\S+)", lodbench(*words, f"seed={n}").stdout)[1] for n in (0, 1)]
    other, note = Path(made[0]).parent / "pictures", Path(made[0]).parent / "notes.txt"
    (tmp_path / other).mkdir()
    (tmp_path / note).write_text("the second is better")
    return [made[0], str(other), str(note), made[1]]


@pytest.mark.parametrize(
    "words",
    [["report"], ["export", "--format", "csv"], ["compare"], ["leaderboard", "add"]],
    ids=lambda words: words[0],
)
def test_what_is_no_run_is_passed_over_with_a_note(lodbench, tmp_path, runs, words):
    at = 2 if words[0] == "leaderboard" else 1
    done = lodbench(*words[:at], *runs, *words[at:])
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stderr.splitlines() if "skipped" in line] == [
        f"lodbench: skipped, not a finished run: {path}" for path in runs[1:3]
    ]
    files = {"report": "report.html", "export": "export/poses.csv"}
    if words[0] in files:
        for run in (runs[0], runs[3]):
            assert (tmp_path / run / files[words[0]]).is_file()
            assert f"{run}/{files[words[0]]}" in done.stdout
    if words[0] == "leaderboard":
        assert len(list((tmp_path / "leaderboard" / "entries").rglob("*.json"))) == 2


@pytest.mark.parametrize("command", ["report", "export"])
def test_one_out_is_not_for_several_runs(lodbench, runs, command):
    form = ["--format", "csv"] if command == "export" else []
    done = lodbench(command, *runs, *form, "--out", "one.html")
    assert done.returncode == 2
    assert "--out one.html is one place, and there are 2 runs" in done.stderr
    # A pattern that names one run is one run.
    assert lodbench(command, *runs[:3], *form, "--out", "one.html").returncode == 0


@pytest.mark.parametrize("command", ["report", "compare"])
def test_where_nothing_is_a_run_the_first_says_why(lodbench, runs, command):
    done = lodbench(command, *runs[1:3])
    assert done.returncode == 2
    assert "pictures is not a run folder" in done.stderr
    assert lodbench(command, runs[0], "nowhere").returncode == 2
