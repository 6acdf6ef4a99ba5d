"""The lock file follows from what the package needs and from the versions the tests pass with."""

import re
import tomllib
from pathlib import Path

from tests.lock import TEST_EXTRAS

ROOT = Path(__file__).resolve().parents[1]


def plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def pinned_versions() -> dict[str, str]:
    lines = (line.partition("==") for line in (ROOT / "constraints.txt").read_text().splitlines())
    return {plain(name): version for name, equals, version in lines if equals}


def test_what_make_test_installs_is_locked_at_the_same_versions() -> None:
    text = (ROOT / "requirements-test.lock").read_text()
    found = re.findall(r"^([\w.-]+)==(\S+)[^\n]*\\\n    --hash=sha256:[0-9a-f]{64}", text, re.MULTILINE)
    locked = {plain(name): version for name, version in found}
    assert len(found) == len(re.findall("^\\w", text, re.MULTILINE)) > 200
    locked.pop("setuptools")  # of torch; no constraint of ours
    pinned = pinned_versions()
    assert {name: pinned.get(name) for name in locked} == locked
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (line,) = re.findall(r"-e '\.\[(test,[\w,]+)\]'", (ROOT / "Makefile").read_text())
    assert set(line.split(",")) == set(TEST_EXTRAS)
    wanted = [
        *project["dependencies"],
        *(w for e in TEST_EXTRAS for w in project["optional-dependencies"][e]),
    ]
    assert {plain(re.match(r"[\w.-]+", each)[0]) for each in wanted} - {"torch"} <= set(locked)


def test_every_package_is_locked_by_a_digest_at_the_version_the_tests_pass_with() -> None:
    lines = [line for line in (ROOT / "requirements.lock").read_text().splitlines() if line[0] != "#"]
    locked = {}
    for line in lines:
        found = re.fullmatch(r"([\w.-]+)==(\S+) --hash=sha256:[0-9a-f]{64}", line)
        assert found, line
        locked[plain(found[1])] = found[2]
    pinned = pinned_versions()
    assert {name: pinned.get(name) for name in locked} == locked
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    assert {plain(re.match(r"[\w.-]+", line)[0]) for line in needed} <= set(locked)
