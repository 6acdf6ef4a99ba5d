"""The wheel, installed with the constraints into a clean environment, works away from the checkout."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def call(*words: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "LODBENCH", "COV_"))}
    environment["LODBENCH_CACHE"] = str(cwd / "cache")
    done = subprocess.run([str(w) for w in words], cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done


@pytest.mark.slow
def test_wheel_runs_the_demo_away_from_the_checkout(tmp_path):
    # From a copy: setuptools would take along what an earlier build left in the checkout.
    leftovers = shutil.ignore_patterns(".*", "build", "*.egg-info")
    shutil.copytree(
        ROOT,
        tmp_path / "source",
        ignore=lambda folder, names: {*leftovers(folder, names), *({"runs"} if Path(folder) == ROOT else ())},
    )
    call(sys.executable, "-m", "build", "--wheel", "--outdir", tmp_path / "dist", "source", cwd=tmp_path)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    venv.create(tmp_path / "env", with_pip=True)
    python = tmp_path / "env" / "bin" / "python"
    call(python, "-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", wheel, cwd=tmp_path)

    # Installed read-only, as on a shared machine: caches go to the user's folders.
    package = Path(
        call(python, "-c", "import lodbench; print(lodbench.__path__[0])", cwd=tmp_path).stdout.strip()
    )
    assert ROOT not in package.parents
    for name in (
        "conf/run.yaml",
        "conf/method/lodlocv2.yaml",
        "baselines/prior_only/__init__.py",
        "py.typed",
    ):
        assert (package / name).is_file(), name
    lodbench = tmp_path / "env" / "bin" / "lodbench"
    assert "run" in call(lodbench, "--help", cwd=tmp_path).stdout
    printed = call(lodbench, "run", "dataset.num_queries=2", "tilt=truth", cwd=tmp_path).stdout
    assert "lodlocv2 full" in printed
    assert "tilt=truth" in printed
    assert list((tmp_path / "runs" / "demo" / "lodlocv2").glob("*/summary.json"))
