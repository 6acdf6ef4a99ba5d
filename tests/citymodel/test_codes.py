from __future__ import annotations

import re
from pathlib import Path

from lodbench.citymodel.codes import VAL3DITY, finding_catalogue
from lodbench.datasets.codes import CATALOGUE as DATASET_CODES

_ROOT = Path(__file__).resolve().parents[2]


def test_codes_are_unique_and_grouped() -> None:
    catalogue = finding_catalogue()
    assert len({code.code for code in catalogue}) == len({code.name for code in catalogue}) == len(catalogue)
    assert all(re.fullmatch(r"LB[1-467]\d\d", code.code) for code in catalogue)
    assert all(code.meaning.endswith(".") for code in catalogue)
    assert not {code.code for code in catalogue} & set(DATASET_CODES)


def test_every_code_is_used_and_tested() -> None:
    source = "".join(
        path.read_text() for path in (_ROOT / "lodbench/citymodel").rglob("*.py") if path.name != "codes.py"
    )
    tests = "".join(path.read_text() for path in (_ROOT / "tests/citymodel").glob("test_*.py"))
    for code in finding_catalogue():
        assert re.search(rf"\b{code.name}\b", source), f"{code} is never added"
        assert code.code in tests, f"no test expects {code}"


def test_the_table_in_the_documentation() -> None:
    rows = [
        f"| {c.code} | {c.name} | {c.severity.value} | {VAL3DITY.get(c, '')} | {c.meaning} |"
        for c in finding_catalogue()
    ]
    page = (_ROOT / "docs" / "city-findings.md").read_text()
    assert [line for line in page.splitlines() if line.startswith("| LB")] == rows
