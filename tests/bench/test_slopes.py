"""`lodbench bench slopes`: every axis is measured, and slopes are those of the points."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from lodbench.bench.slopes import slope_of
from lodbench.cli import main


def test_the_slope_is_that_of_the_last_half() -> None:
    sizes = np.array([1, 10, 100, 1000])
    costs = np.array([5.0, 5.0, 0.3 * 100**1.5, 0.3 * 1000**1.5])
    assert slope_of(pd.DataFrame({"size": sizes, "cpu_s": costs})) == pytest.approx(1.5)


def test_every_axis_is_measured(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))
    reach = ["--hypotheses", "1000", "--buildings", "1000", "--queries", "100", "--workers", "1"]
    assert main(["bench", "slopes", *reach, "--json", "--pictures", str(tmp_path / "drawn")]) == 0
    figures = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    found = {figure["figure"]: figure["value"] for figure in figures}
    assert found["cpu seconds, hypotheses 1,000"] > found["cpu seconds, hypotheses 100"] > 0
    assert found["cpu seconds, image width, px 1,200"] > found["cpu seconds, image width, px 150"]
    assert {name for name in found if name.startswith("slope over")} == {
        "slope over hypotheses",
        "slope over image width, px",
        "slope over buildings, opened",
        "slope over buildings, 1000 hypotheses",
        "slope over queries stored and read",
        "slope over workers, 16,000 hypotheses",
    }
    assert (tmp_path / "drawn" / "slopes.png").stat().st_size > 10_000
