"""A slice of what `python -m tests.faults` tries: disks that fail or die under whole commands."""

import os
import subprocess
import sys

import pytest

from tests.faults import NO_THREADS

SLICE = """
import sys, tempfile
from pathlib import Path
from tests.faults import COMMANDS, Stage, prepare_inputs, try_faults
(command,) = [command for command in COMMANDS if command.name == sys.argv[1]]
with tempfile.TemporaryDirectory() as scratch:
    stage = Stage(command, Path(scratch), prepare_inputs(Path(scratch) / "town"))
    places = range(int(sys.argv[2]), len(stage.operations) + 1, int(sys.argv[3]))
    print(len(list(try_faults(stage, places))))
"""


def faults_survived(name: str, first: int, step: int) -> int:
    # A process of its own: forks of one that has threads may hang.
    command = [sys.executable, "-c", SLICE, name, str(first), str(step)]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | NO_THREADS)
    assert done.returncode == 0, done.stderr[-2000:]
    return int(done.stdout)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "first", "step", "least"),
    [("city convert over a scene", 2, 4, 12), ("dataset import", 12, 9, 9), ("export tum", 1, 1, 16)],
)
def test_nothing_is_lost(name: str, first: int, step: int, least: int) -> None:
    assert faults_survived(name, first, step) >= least


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "step"), [("run", 40), ("leaderboard build", 16), ("generate-training-data", 40), ("train", 16)]
)
def test_nothing_is_lost_of_longer_work(name: str, step: int) -> None:
    assert faults_survived(name, 4, step) >= 3
