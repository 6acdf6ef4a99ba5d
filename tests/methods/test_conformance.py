"""The guide's own example of a method conforms to the protocol, and a package's tests may check that."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

from lodbench.methods.conformance import check_answers, check_class

GUIDE = Path(__file__).resolve().parents[2] / "CONTRIBUTING.md"


def test_the_example_of_the_guide_is_whole(tmp_path, monkeypatch):
    (code,) = re.findall(r"## Add a method.*?```python\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    (tmp_path / "shake.py").write_text("from __future__ import annotations\n" + code)
    spec = importlib.util.spec_from_file_location("shake", tmp_path / "shake.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "shake", module)
    spec.loader.exec_module(module)
    config = {"name": "shake", "tries": 64, "sigma_m": 3.0}
    read = lambda values: module.ShakeParams(**values)  # noqa: E731
    checks = [
        *check_class(module.Shake, "shake", lambda: config, read, "conf/method/shake.yaml"),
        *check_answers(lambda: module.Shake(module.ShakeParams())),
    ]
    assert [(check.name, check.detail) for check in checks if check.status != "ok"] == []
    assert {check.name: check.detail for check in checks}["hypotheses"].startswith("64 at most")


def test_a_method_that_exits_is_told():
    class Leaving:
        def __init__(self):
            raise SystemExit(0)

    (check,) = check_answers(Leaving)
    assert (check.status, check.detail) == ("fault", "SystemExit: 0")
