"""The runs of the Makefile's tables name methods, settings and values that there are."""

from __future__ import annotations

import re
import shlex
import subprocess
from itertools import product
from pathlib import Path

import pytest
import yaml

from lodbench.cli import main
from lodbench.methods.registry import configure_method

ROOT = Path(__file__).parents[1]


def runs_of(target: str) -> list[dict[str, str]]:
    """Returns the settings of each `lodbench run` of a target."""
    told = subprocess.run(
        ["make", "-n", target, "LIMIT=1"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    lines = [line.split("||")[0] for line in told.splitlines() if "lodbench run " in line]
    return [dict(word.split("=", 1) for word in shlex.split(line) if "=" in word) for line in lines]


@pytest.mark.parametrize("target", ["table1", "holdout", "budget", "thresholds"])
def test_every_run_of_a_table_has_settings_that_its_methods_know(target):
    runs = runs_of(target)
    assert runs
    for run in runs:
        assert run["limit"] == "1"
        known = yaml.safe_load((ROOT / "conf" / "dataset" / f"{run['dataset']}.yaml").read_text())
        told = {key.removeprefix("dataset.") for key in run if key.startswith("dataset.")}
        assert told <= {*known, "dataset"}
        settings = {
            k.removeprefix("method."): v.split(",") for k, v in run.items() if k.startswith("method.")
        }
        for name, *values in product(run["method"].split(","), *settings.values()):
            read = (yaml.safe_load(value) for value in values)
            configure_method({"name": name, **dict(zip(settings, read, strict=True))})


@pytest.mark.parametrize("target", ["table1", "holdout", "budget", "thresholds"])
def test_the_table_is_asked_for_in_words_that_compare_knows(target, tmp_path, capsys):
    """Of runs that are not there: then nothing else is wrong."""
    told = subprocess.run(
        ["make", "-n", target, "LIMIT=1"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    (line,) = (line for line in told.splitlines() if "lodbench compare " in line)
    words = [str(tmp_path / "none") if "*" in word else word for word in shlex.split(line)[1:]]
    assert main(words) == 2
    error = capsys.readouterr().err
    assert str(tmp_path / "none") in error
    assert "Known" not in error


def test_a_try_leaves_the_leaderboard_alone():
    told = subprocess.run(
        ["make", "-n", "table1", "LIMIT=1"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    assert "compare" in told
    assert "leaderboard" not in told


@pytest.mark.parametrize("target", ["fuzz", "faults"])
def test_all_attacks_are_run_again_after_the_others(target):
    told = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    first, last = re.findall(r"python -m ((?:tests|pytest)\b.*)", told)
    assert first.split()[0] == f"tests.{target}"
    assert last == "pytest -n auto --dist loadfile -m attack"


def test_every_attack_that_reliability_names_is_among_them():
    """Those of the files that they are written in, but for what `make fuzz` tries itself."""
    words = (ROOT / "docs" / "reliability.md").read_text()
    named = set(re.findall(r"tests/[\w/]+\.py", words)) - {"tests/test_fuzz_trees.py"}
    assert len(named) >= 15
    for name in sorted(named):
        assert "pytest.mark.attack" in (ROOT / name).read_text(), name
