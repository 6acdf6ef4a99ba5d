"""Writes `requirements.lock` and `requirements-test.lock`: what is installed, each file by its SHA-256.

`python -m tests.lock` asks pip, under `constraints.txt`, what `pip install lodbench` would bring to Linux on
x86-64 with the Python it runs on. Use it as `pip install --require-hashes -r requirements.lock`, then
`pip install --no-deps lodbench-*.whl`. What `make test` installs is locked by uv (https://docs.astral.sh/uv),
from an environment of its own, for all systems and Pythons.
"""

import json
import re
import subprocess
import sys
import tempfile
import tomllib
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LOCK, TEST_LOCK = ROOT / "requirements.lock", ROOT / "requirements-test.lock"
HEAD = """\
# What `pip install lodbench` brings, for CPython 3.11 on Linux, x86-64; written by `python -m tests.lock`.
# pip install --require-hashes -r requirements.lock && pip install --no-deps lodbench-*.whl
"""
# The build of torch follows the machine; the libraries of CUDA belong to one of them.
OF_TORCH = re.compile(r"(torch|triton|nvidia-[\w-]+|cuda-[\w-]+)==")
TEST_EXTRAS = "test docs render vector download models pnp xfeat tensorboard cluster torch".split()
TEST_HEAD = """\
# What `make test` installs, for every system and Python, but torch; written by `python -m tests.lock`.
"""


def locked() -> str:
    """Returns the lines of the lock file: a version and a digest per package, by name."""
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    with tempfile.TemporaryDirectory() as scratch:
        report = Path(scratch) / "report.json"
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
        command += ["--report", str(report), "-c", str(ROOT / "constraints.txt"), *needed]
        subprocess.run(command, check=True)
        installed = json.loads(report.read_text())["install"]
    lines = []
    for item in sorted(installed, key=lambda item: item["metadata"]["name"].lower()):
        digest = item["download_info"]["archive_info"]["hashes"]["sha256"]
        name, version = item["metadata"]["name"], item["metadata"]["version"]
        lines.append(f"{name}=={version} --hash=sha256:{digest}\n")
    return HEAD + "".join(lines)


def locked_for_tests() -> str:
    """Returns every package of the tests but torch, of which there is a build for each kind of machine."""
    with tempfile.TemporaryDirectory() as scratch:
        venv.create(scratch, with_pip=True)
        tools, found = Path(scratch) / "bin", Path(scratch) / "found.txt"
        subprocess.run([tools / "python", "-m", "pip", "install", "--quiet", "uv"], check=True)
        ask = [tools / "uv", "pip", "compile", "--quiet", "--universal", "--generate-hashes", "--no-annotate"]
        ask += ["--no-header", "--python-version", "3.11.5", "--output-file", found, "-c", "constraints.txt"]
        ask += [word for extra in TEST_EXTRAS for word in ("--extra", extra)]
        subprocess.run([*ask, "pyproject.toml"], cwd=ROOT, check=True)
        packages = re.split(r"\n(?=\w)", found.read_text().strip())
    wanted = [each for each in packages if not OF_TORCH.match(each) and "emscripten" not in each]
    return TEST_HEAD + "".join(f"{each}\n" for each in wanted)


if __name__ == "__main__":
    LOCK.write_text(locked())
    TEST_LOCK.write_text(locked_for_tests())
