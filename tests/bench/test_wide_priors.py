from __future__ import annotations

import json

import pytest

from lodbench.bench import AccuracyOptions, measure_wide_priors
from lodbench.bench.wide_priors import SearchPair, WidePriorReport
from lodbench.evaluation import PoseError
from lodbench.evaluation.errors import FAILED


def pair(name, apart):
    errors = {"grid": PoseError(0.4, 0.1), "basins": PoseError(0.5, 0.1)}
    return SearchPair(name, {"grid": 1000, "basins": 50}, errors, apart)


REPORT = WidePriorReport("boxes", (pair("near", PoseError(0.01, 0.01)), pair("far", PoseError(3.0, 0.01))))


def test_ends_are_compared_pose_by_pose():
    text = REPORT.to_text()
    assert "1 of 2 end within 0.1 m" in text
    assert [p.is_same for p in REPORT.pairs] == [True, False]
    assert not pair("none", FAILED).is_same


def test_figures_are_json():
    figures = {f.figure: f for f in REPORT.figures()}
    json.dumps([f.to_json() for f in figures.values()], allow_nan=False)
    assert figures["hypotheses of basins"].ratio == pytest.approx(20)
    assert figures["views whose searches end in one optimum"].value == 1


def test_both_searches_of_a_view(city):
    options = AccuracyOptions(num_views=1, range_m=20.0, height_m=15.0, threads=1)
    (found,) = measure_wide_priors(city, options).pairs
    assert found.hypotheses["basins"] < found.hypotheses["grid"]
    assert found.is_same == (found.apart.translation_m < 0.1 and found.apart.rotation_deg < 0.1)
