"""The demo's labels are named by all that they follow from."""

from __future__ import annotations

import ast
from pathlib import Path

from lodbench.synthesis import demo_instances, instance_degradation, mask_degradation, mask_error_fields


def imported_from_synthesis(module) -> set[str]:
    nodes = ast.walk(ast.parse(Path(module.__file__).read_text()))
    names = {node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module}
    return {name for name in names if name.startswith("lodbench.synthesis.")}


def test_a_change_of_any_code_that_draws_labels_gives_the_folder_another_name(monkeypatch):
    drawing = (instance_degradation, mask_degradation, mask_error_fields)
    assert imported_from_synthesis(instance_degradation) <= {module.__name__ for module in drawing}
    digests = {demo_instances._digest.__wrapped__()}
    for changed in (demo_instances, *drawing):

        def digest(file, changed=changed):
            return f"{Path(file).name} {Path(file) == Path(changed.__file__)}"

        monkeypatch.setattr(demo_instances, "file_digest", digest)
        digests.add(demo_instances._digest.__wrapped__())
    assert len(digests) == 5
