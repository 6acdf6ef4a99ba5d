from __future__ import annotations

import json

import pytest

from lodbench.bench import budget
from lodbench.methods.contour_alignment import ContourAlignment, Params
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.methods.lodlocv2 import Params as LodLocV2Params
from lodbench.synthesis.views_dataset import ViewsParams


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
        views = ViewsParams(str(city), num_views=2)
        report = budget.measure_budget(views, [0], lambda *step: steps.append(step), threads=1)
    assert steps == [(n, 3) for n in range(1, 4)]
    return report


def test_a_point_for_each_setting(report):
    means = report.data.groupby("rung")["hypotheses"].mean()
    assert means[[0, 1]].tolist() == [504, 553]
    assert 504 < means[2] < 553
    assert [figure.figure.rsplit(" at ")[0] for figure in report.figures] == [
        "recall 2m-2deg of lodlocv2",
        "recall 2m-2deg of lodlocv2",
        "recall 2m-2deg of contour_alignment",
    ]
    assert all(0 <= figure.value <= 100 for figure in report.figures)


def test_text_figures_and_picture(report, tmp_path):
    assert "2 views with tilt=prior" in report.text
    json.dumps([figure.to_json() for figure in report.figures], allow_nan=False)
    report.write_pictures(tmp_path / "pictures")
    assert sorted(path.name for path in (tmp_path / "pictures").iterdir()) == ["budget.png", "budget.svg"]


def test_the_ladder_rises():
    ours = [m.params for m in budget._ladder() if m.name == "contour_alignment"]
    costs = [len(p.grid()) + p.starts * (p.steps + 1) for p in ours]
    assert costs == sorted(costs)
    assert not any(p.searches_basins() for p in ours)
