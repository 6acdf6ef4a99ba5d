"""Running the command line: in this process, and in one of its own where that is what is tested."""

import io
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from lodbench.cli import main

Cli = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache of the tests' own, so that none is left in the user's."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def lodbench(tmp_path: Path, cache: Path) -> Cli:
    """Runs `lodbench ...` in an empty folder; returns what a finished process would have left.

    An exception that the command line lets through is let through here too: a user would see a traceback.
    """

    def run(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
        out, err = io.StringIO(), io.StringIO()
        with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
            patch.chdir(tmp_path)
            for name, value in {"LODBENCH_CACHE": str(cache), **environment}.items():
                patch.setenv(name, value)
            try:
                code = main([str(word) for word in words])
            except SystemExit as leaving:
                code = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
        return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())

    return run


@pytest.fixture
def lodbench_process(tmp_path: Path, cache: Path) -> Cli:
    """Runs `lodbench ...` in an empty folder and a process of its own, as a user does."""

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
