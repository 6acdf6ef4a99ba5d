"""The runs of the Makefile's tables name methods, settings and values that there are."""

import re
import shlex
import subprocess
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import yaml

from lodbench.cli import main
from lodbench.methods.registry import configure_method
from tests import conftest

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


def test_each_nightly_test_is_in_one_slice_of_those_that_ci_takes_and_all_are_in_make_nightly():
    nightly = [f"tests/test_faults.py::test_nothing_is_lost[{number}]" for number in range(40)]
    items = [SimpleNamespace(nodeid=name, get_closest_marker=lambda _: True) for name in nightly]
    items.append(SimpleNamespace(nodeid="another", get_closest_marker=lambda _: None))

    def taken(slice_):
        config, left = Mock(getoption=lambda _: slice_), list(items)
        conftest.pytest_collection_modifyitems(config, left)
        assert len(config.hook.pytest_deselected.call_args.kwargs["items"]) == len(items) - len(left)
        return [item.nodeid for item in left]

    parts = int(re.search(r'SLICE="\$slice/(\d)"', (ROOT / ".ci" / "run").read_text())[1])
    slices = [taken(f"{part}/{parts}") for part in range(parts)]
    assert sorted(name for each in slices for name in each) == sorted([*nightly, *["another"] * parts])
    assert taken("0/1") == [*nightly, "another"]
    told = subprocess.run(["make", "-n", "nightly"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "--nightly 0/1" in told.stdout
    assert re.findall(r"-m tests\.(\w+)", told.stdout) == ["determinism", "matrix", "audit"]


def test_every_attack_that_reliability_names_is_among_them():
    """Those of the files that they are written in, but for what `make fuzz` tries itself."""
    words = (ROOT / "docs" / "reliability.md").read_text()
    named = set(re.findall(r"tests/[\w/]+\.py", words)) - {"tests/test_fuzz_trees.py"}
    assert len(named) >= 15
    for name in sorted(named):
        assert "pytest.mark.attack" in (ROOT / name).read_text(), name
