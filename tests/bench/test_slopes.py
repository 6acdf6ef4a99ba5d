"""`lodbench bench slopes`: every axis is measured, and slopes are those of the points."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pandas as pd
import pytest

from lodbench.bench import slope_points, slopes
from lodbench.bench.slopes import slope_of
from lodbench.cli import main


def test_the_slope_is_that_of_the_last_half() -> None:
    sizes = np.array([1, 10, 100, 1000])
    costs = np.array([5.0, 5.0, 0.3 * 100**1.5, 0.3 * 1000**1.5])
    assert slope_of(pd.DataFrame({"size": sizes, "cpu_s": costs})) == pytest.approx(1.5)


def test_a_single_point_has_no_slope() -> None:
    point = pd.DataFrame({"axis": ["workers"], "size": [1], "cpu_s": [2.0], "peak_mb": [200.0]})
    assert slopes._text(point, {"workers": slope_of(point)}).splitlines()[1].split()[-2:] == ["-", "200"]


@pytest.mark.slow
def test_a_point_tells_the_peak_of_its_own_process() -> None:
    small, large = (slope_points._apart(partial(_hold, megabytes)) for megabytes in (1, 300))
    assert (small.cpu_s, large.cpu_s) == (1.0, 1.0)
    assert large.peak_mb - small.peak_mb == pytest.approx(300 * 1.048576, abs=30)


def _hold(megabytes: int) -> tuple[float, float]:
    np.ones(megabytes << 20, np.uint8)
    return 1.0, 0.0


@pytest.mark.slow
def test_every_axis_is_measured(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))
    # Processes take seconds to start; one test is enough for them.
    monkeypatch.setattr(slope_points, "_apart", slope_points._cost)
    reach = [
        "--hypotheses",
        "1000",
        "--buildings",
        "1000",
        "--tiled",
        "1000",
        "--queries",
        "100",
        "--workers",
        "1",
    ]
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
        "slope over buildings of CityGML tiles, compiled",
        "slope over queries stored and read",
        "slope over workers, 16,000 hypotheses",
    }
    # Of whole processes: numpy, numba and OpenCV alone take more than 50 MB.
    peaks = [value for name, value in found.items() if name.startswith("peak memory")]
    assert len(peaks) == sum(name.startswith("cpu seconds") for name in found)
    assert 50 < min(peaks) <= max(peaks) < 5000
    assert (tmp_path / "drawn" / "slopes.png").stat().st_size > 10_000
