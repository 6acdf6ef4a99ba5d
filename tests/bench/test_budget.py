from __future__ import annotations

import json

import pytest

from lodbench.bench import AccuracyOptions, budget, measure_budget
from lodbench.methods.contour_alignment import ContourAlignment, Params
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.methods.lodlocv2 import Params as LodLocV2Params


@pytest.fixture(scope="module")
def report(city):
    ladder = [
        LodLocV2(LodLocV2Params(variant="no_refine")),
        LodLocV2(LodLocV2Params(steps=1)),
        ContourAlignment(Params(starts=1, steps=3)),
    ]
    steps = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(budget, "_ladder", lambda: ladder)
        options = AccuracyOptions(num_views=2, threads=1)
        report = measure_budget(city, options, lambda *step: steps.append(step))
    assert steps == [(n, 6) for n in range(1, 7)]
    return report


def test_a_point_for_each_setting(report):
    assert [point.hypotheses for point in report.curves["lodlocv2"]] == [504, 553]
    (point,) = report.curves["contour_alignment"]
    assert 504 < point.hypotheses < 553
    assert 0 <= point.low <= point.recall <= point.high <= 100


def test_text_figures_and_picture(report, tmp_path):
    assert "2 views with tilt=prior" in report.to_text()
    json.dumps([figure.to_json() for figure in report.figures()], allow_nan=False)
    report.write_pictures(tmp_path / "pictures")
    assert sorted(path.name for path in (tmp_path / "pictures").iterdir()) == ["budget.png", "budget.svg"]


def test_the_ladder_rises():
    ours = [m.params for m in budget._ladder() if m.name == "contour_alignment"]
    costs = [len(p.grid()) + p.starts * (p.steps + 1) for p in ours]
    assert costs == sorted(costs)
    assert not any(p.searches_basins() for p in ours)
