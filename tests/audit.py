"""Known holes in the packages of `constraints.txt`, by pip-audit, which asks PyPI.

`python -m tests.audit` prints what was asked and what was found, and ends with 1 where there is a hole. Where
no network is, it says so in one line: pip-audit itself would say that there are no holes.
"""

import json
import subprocess
import sys
import tempfile
import venv
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def audited(folder: Path) -> str:
    """Returns pip-audit's answer as JSON text, by a pip-audit in an environment of its own.

    Raises:
        OSError: It cannot be installed, or gives no answer.
    """
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    install = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "pip-audit"]
    done = subprocess.run(install, capture_output=True, text=True)
    if done.returncode:
        raise OSError("pip-audit cannot be installed")
    ask = [folder / "bin" / "pip-audit", "--requirement", ROOT / "constraints.txt", "--no-deps"]
    ask += ["--disable-pip", "--progress-spinner", "off", "--format", "json"]
    done = subprocess.run(ask, capture_output=True, text=True)
    if not done.stdout:
        raise OSError((done.stderr.strip().splitlines() or ["pip-audit gives no answer"])[-1])
    return done.stdout


def verdict(answer: str) -> tuple[list[str], bool]:
    """Returns what is to be told of pip-audit's JSON, and whether there is a hole."""
    packages: list[dict[str, Any]] = json.loads(answer)["dependencies"]
    asked = [package for package in packages if "skip_reason" not in package]
    if not asked:
        return [f"not audited: PyPI knows none of {len(packages)} packages, so it was not reached"], False
    holes = [(each["name"], each["version"], hole["id"]) for each in asked for hole in each["vulns"]]
    skipped = sorted(package["name"] for package in packages if "skip_reason" in package)
    lines = [f"{name} {version}: {hole}" for name, version, hole in holes]
    lines.append(f"{len(asked)} packages asked about, {len(holes)} known holes")
    if skipped:
        lines.append(f"not known to PyPI at these versions: {', '.join(skipped)}")
    return lines, bool(holes)


def main() -> int:
    """Prints the verdict; returns 1 where there is a hole."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            lines, is_holed = verdict(audited(Path(folder)))
        except OSError as error:
            lines, is_holed = [f"not audited: {error}"], False
    sys.stdout.write("\n".join(lines) + "\n")
    return int(is_holed)


if __name__ == "__main__":
    sys.exit(main())
