"""Running the command line in a subprocess, as a user does."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

Cli = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache of the tests' own, so that none is left in the user's."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def lodbench(tmp_path: Path, cache: Path) -> Cli:
    """Runs `lodbench ...` in an empty folder; returns the finished process."""

    def run(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "lodbench", *words],
            cwd=tmp_path,
            env={**os.environ, "LODBENCH_CACHE": str(cache), **environment},
            capture_output=True,
            text=True,
            timeout=300,
        )

    return run
