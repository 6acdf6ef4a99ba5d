"""What is kept of the demo is named by all the code that it follows from."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import lodbench
from lodbench.synthesis.demo import LABEL_CODE, MAP_CODE
from lodbench.synthesis.town import build
from lodbench.synthesis.town.build import DEMO_CODE, code_digest

PACKAGE = Path(lodbench.__file__).parent


def files_of(*patterns: str) -> set[Path]:
    return {file for pattern in patterns for file in PACKAGE.glob(pattern)}


def imported_by(file: Path) -> set[Path]:
    nodes = ast.walk(ast.parse(file.read_text()))
    names = {node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module}
    # What a z-buffer is, and how functions are compiled, says nothing of a picture.
    plain = {f"lodbench.kernels.{name}" for name in ("arguments", "compiled")}
    of = ("lodbench.synthesis.", "lodbench.kernels.")
    own = [name.split(".")[1:] for name in names - plain if name.startswith(of)]
    return {file for file in (PACKAGE.joinpath(*name).with_suffix(".py") for name in own) if file.exists()}


@pytest.mark.parametrize("code", [DEMO_CODE, (*DEMO_CODE, *MAP_CODE), (*DEMO_CODE, *LABEL_CODE)])
def test_a_change_of_any_code_that_draws_it_gives_it_another_name(monkeypatch, code):
    # The module of the dataset calls what makes either.
    python = {file for file in files_of(*code) if file.suffix == ".py" and file.name != "demo.py"}
    assert set().union(*map(imported_by, python)) <= python
    digests = {code_digest.__wrapped__(*code)}
    for changed in files_of(*code):
        monkeypatch.setattr(build, "file_digest", lambda file, changed=changed: f"{file} {file == changed}")
        digests.add(code_digest.__wrapped__(*code))
    assert len(digests) == 1 + len(files_of(*code))
