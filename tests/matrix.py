"""Installs lodbench as people do, and asks each installation whether it works.

`python -m tests.matrix` tries every row, `python -m tests.matrix NAME ...` some. A row makes an environment,
installs a wheel or an sdist with oldest, pinned or newest packages, and then wants
`lodbench doctor --thorough` to say what is so (the base works, the extras asked for are ready) and two
queries of the demo answered.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# Root without its rights, who may not write what is read-only: others may not reach the Pythons of root.
AS_ANYBODY = ("setpriv", "--bounding-set=-all", "--inh-caps=-all")


@dataclass(frozen=True)
class Row:
    """One way to install.

    Attributes:
        python: Version, ``3.11``; empty for that of the Python that runs this.
        packages: ``locked`` (by digest), ``pinned`` (constraints.txt), ``lowest``, ``newest``; ``at hand``:
            those of the Python that runs this, not installed again.
        kind: ``wheel`` or ``sdist``.
        extras: Installed too.
        is_shared: The packages are read-only, and there is no home.
    """

    python: str
    packages: str
    kind: str = "wheel"
    extras: tuple[str, ...] = ()
    is_shared: bool = False


ROWS = {
    "3.11 locked": Row("3.11", "locked"),
    "3.11 lowest": Row("3.11", "lowest"),
    "3.12 pinned, read-only, no home": Row("3.12", "pinned", is_shared=True),
    "3.12 newest, sdist": Row("3.12", "newest", "sdist"),
    "3.13 pinned, vector and download": Row("3.13", "pinned", extras=("vector", "download")),
    "3.13 newest": Row("3.13", "newest"),
    "3.13 lowest": Row("3.13", "lowest"),
    "at hand, read-only, no home": Row("", "at hand", is_shared=True),
    "this Python, pinned, read-only, no home": Row("", "pinned", is_shared=True),
}
# Files that no row asks for, by kind: configuration of baselines, their code, that there are types.
IN_THE_WHEEL = ("conf/method/mcloc.yaml", "baselines/prior_only/__init__.py", "py.typed")


def call(*words: str | Path, cwd: Path, **options: object) -> str:
    """Returns what a program printed.

    Raises:
        AssertionError: It failed.
    """
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "LODBENCH"))}
    done = subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        capture_output=True,
        text=True,
        **{"env": environment, **options},
    )
    assert done.returncode == 0, f"{words[:4]}: {done.stdout[-1500:]}{done.stderr[-1500:]}"
    return done.stdout


def lowest() -> list[str]:
    """Returns the base packages at the oldest versions that are allowed."""
    bounds = [re.match(r"([\w.-]+)>=([\w.]+)", needed) for needed in PROJECT["dependencies"]]
    # 5.0 may be published as 5.0.0.93 alone.
    return [f"{bound[1]}=={bound[2]}.*" for bound in bounds if bound is not None]


def build(folder: Path) -> dict[str, Path]:
    """Returns a wheel and an sdist of the working tree, made in a folder."""
    # From a copy: setuptools would take along what an earlier build left in the checkout.
    shutil.copytree(ROOT, folder / "source", ignore=shutil.ignore_patterns(".*", "build", "*.egg-info"))
    call(sys.executable, "-m", "build", "--outdir", folder / "dist", "source", cwd=folder)
    (wheel,), (sdist,) = (folder / "dist").glob("*.whl"), (folder / "dist").glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as files:
        lacking = {f"lodbench/{name}" for name in IN_THE_WHEEL} - set(files.namelist())
    assert not lacking, lacking
    return {"wheel": wheel, "sdist": sdist}


def install(row: Row, built: dict[str, Path], folder: Path) -> Path:
    """Makes the environment of a row; returns the folder of its programs."""
    python = f"python{row.python}" if row.python else sys.executable
    call(python, "-m", "venv", folder / "env", cwd=folder)
    programs = folder / "env" / "bin"
    pip = [programs / "python", "-m", "pip", "install", "-q", "--disable-pip-version-check"]
    package = str(built[row.kind]) + (f"[{','.join(row.extras)}]" if row.extras else "")
    if row.packages == "at hand":
        (own,) = (folder / "env" / "lib").glob("python3*/site-packages")
        (own / "at_hand.pth").write_text("".join(f"{path}\n" for path in sys.path if "site-packages" in path))
        call(*pip, "--no-deps", package, cwd=folder)
    elif row.packages == "locked":
        call(*pip, "--require-hashes", "-r", ROOT / "requirements.lock", cwd=folder)
        call(*pip, "--no-deps", package, cwd=folder)
    else:
        more = {"pinned": ["-c", ROOT / "constraints.txt"], "lowest": lowest(), "newest": ["--upgrade"]}
        call(*pip, package, *more[row.packages], cwd=folder)
    return programs


def examine(row: Row, programs: Path, folder: Path) -> str:
    """Returns what a row's installation says of itself, once that is found true.

    Raises:
        AssertionError: It does not work, or says something else than what is so.
    """
    place = folder / "place"
    place.mkdir()
    environment = {"PATH": os.environ["PATH"], "LODBENCH_CACHE": str(place / "cache")}
    options: dict[str, object] = {"env": environment if row.is_shared else environment | {"HOME": str(place)}}
    lodbench = [*(AS_ANYBODY if row.is_shared and os.geteuid() == 0 else ()), programs / "lodbench"]
    if row.is_shared:
        for path in [programs.parent, *programs.parent.rglob("*")]:
            if not path.is_symlink():
                path.chmod(path.stat().st_mode & ~0o222)
    told = call(*lodbench, "doctor", "--thorough", "--json", cwd=place, **options)
    checks = [json.loads(line) for line in told.splitlines()]
    broken = [check["name"] for check in checks if check["is_base"] and check["status"] != "ok"]
    assert not broken, broken
    lacking = [check["name"] for check in checks if check["section"] == "extras" and check["status"] != "ok"]
    assert "render" in lacking or row.packages == "at hand", "no row asks for extra `render`"
    assert not set(row.extras) & set(lacking), lacking
    wrong = [check for check in checks if check["status"] == "broken" and not check["is_base"]]
    ready = sorted(
        check["name"] for check in checks if check["section"] == "extras" and check["status"] == "ok"
    )
    printed = call(*lodbench, "run", "dataset.num_queries=2", "tilt=truth", cwd=place, **options)
    assert "lodlocv2 full" in printed
    versions = {check["name"]: check["detail"] for check in checks if check["name"] in ("numpy", "numba")}
    return f"base works; extras {ready}; broken {[check['name'] for check in wrong]}; {versions}"


def try_rows(names: Sequence[str]) -> int:
    """Prints how each row went; returns how many failed."""
    faults = 0
    with tempfile.TemporaryDirectory() as scratch:
        built = build(Path(scratch))
        for number, name in enumerate(names):
            started, folder = time.monotonic(), Path(scratch) / f"row{number}"
            folder.mkdir()
            try:
                words = examine(ROWS[name], install(ROWS[name], built, folder), folder)
            except AssertionError as error:
                words, faults = f"FAILED: {error}", faults + 1
            sys.stdout.write(f"{name}: {words} ({time.monotonic() - started:.0f} s)\n")
            sys.stdout.flush()
            shutil.rmtree(folder, ignore_errors=True)
    sys.stdout.write(f"{len(names)} rows, {faults} failed\n")
    return faults


if __name__ == "__main__":
    sys.exit(min(1, try_rows(sys.argv[1:] or list(ROWS))))
