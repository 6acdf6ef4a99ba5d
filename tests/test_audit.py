"""What `make audit` says of pip-audit's answers."""

import json

import pytest

from tests import audit

SOUND = {"name": "numpy", "version": "2.1.0", "vulns": []}
HOLED = {"name": "jinja2", "version": "2.4.1", "vulns": [{"id": "PYSEC-2014-8", "fix_versions": ["2.7.2"]}]}
UNKNOWN = {"name": "torch", "skip_reason": "Dependency not found on PyPI"}


@pytest.mark.parametrize(
    ("packages", "lines", "is_holed"),
    [
        ([UNKNOWN, UNKNOWN], ["not audited: PyPI knows none of 2 packages, so it was not reached"], False),
        ([SOUND], ["1 packages asked about, 0 known holes"], False),
        (
            [SOUND, HOLED, UNKNOWN],
            [
                "jinja2 2.4.1: PYSEC-2014-8",
                "2 packages asked about, 1 known holes",
                "not known to PyPI at these versions: torch",
            ],
            True,
        ),
    ],
)
def test_verdict(packages, lines, is_holed) -> None:
    assert audit.verdict(json.dumps({"dependencies": packages, "fixes": []})) == (lines, is_holed)


def test_no_network_is_one_line_and_no_fault(monkeypatch, capsys) -> None:
    def nothing(folder):
        raise OSError("pip-audit cannot be installed")

    monkeypatch.setattr(audit, "audited", nothing)
    assert audit.main() == 0
    assert capsys.readouterr().out == "not audited: pip-audit cannot be installed\n"
