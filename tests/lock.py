"""Writes `requirements.lock`: what `pip install lodbench` brings, each file by its SHA-256.

`python -m tests.lock` asks pip what it would install for Linux on x86-64 with the Python it runs on, under
`constraints.txt`, and writes the file. Use it as `pip install --require-hashes -r requirements.lock`, then
`pip install --no-deps lodbench-*.whl`.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LOCK = ROOT / "requirements.lock"
HEAD = """\
# What `pip install lodbench` brings, for CPython 3.11 on Linux, x86-64; written by `python -m tests.lock`.
# pip install --require-hashes -r requirements.lock && pip install --no-deps lodbench-*.whl
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


if __name__ == "__main__":
    LOCK.write_text(locked())
