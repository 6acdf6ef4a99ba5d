"""What the demo has on demand is named by all that it follows from."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from lodbench.synthesis import demo_assets

CODE = {"labels": demo_assets.LABEL_CODE, "map": demo_assets.MAP_CODE}
# In the digest of the demo's own name.
OF_THE_TOWN = ("lodbench.synthesis.town", "lodbench.synthesis.objects", "lodbench.synthesis.photo")


def imported_from_synthesis(module) -> set[str]:
    nodes = ast.walk(ast.parse(Path(module.__file__).read_text()))
    names = {node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module}
    return {name for name in names if name.startswith("lodbench.synthesis.")}


@pytest.mark.parametrize("kind", CODE)
def test_a_change_of_any_code_that_draws_it_gives_the_folder_another_name(monkeypatch, kind):
    code = CODE[kind]
    for module in code:
        others = {name for name in imported_from_synthesis(module) if not name.startswith(OF_THE_TOWN)}
        assert others <= {module.__name__ for module in code}
    digests = {demo_assets.code_digest(code)}
    for changed in (demo_assets, *code):

        def digest(file, changed=changed):
            return f"{Path(file).name} {Path(file) == Path(changed.__file__)}"

        monkeypatch.setattr(demo_assets, "file_digest", digest)
        digests.add(demo_assets.code_digest(code))
    assert len(digests) == 2 + len(code)
