"""A slice of what `python -m tests.faults` tries: disks that fail or die under whole commands."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

SLICE = """
import itertools, os, sys, tempfile
from pathlib import Path
from tests.faults import COMMANDS, KINDS, apart, disturbed
from tests.town import write_dataset
name, places = sys.argv[1], [int(word) for word in sys.argv[2:]]
with tempfile.TemporaryDirectory() as scratch:
    os.environ["LODBENCH_CACHE"] = str(Path(scratch) / "cache")
    assert apart(lambda: bool(write_dataset(Path(scratch) / "town", 2)) - 1) == 0
    (command,) = [command for command in COMMANDS if command.name == name]
    print(len(list(disturbed(command, Path(scratch) / "town", iter(places)))))
"""


@pytest.mark.parametrize(
    ("name", "places"),
    [("run", [3, 8]), ("evaluate", [4]), ("city convert", [2]), ("city convert, over a scene", [11, 12])],
)
def test_nothing_is_lost(name: str, places: list[int]) -> None:
    command = [sys.executable, "-c", SLICE, name, *map(str, places)]
    done = subprocess.run(command, capture_output=True, text=True, env=dict(os.environ))
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout) == 4 * len(places)
