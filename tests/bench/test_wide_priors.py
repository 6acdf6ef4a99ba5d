from __future__ import annotations

import json

import pandas as pd
import pytest

from lodbench.bench.wide_priors import measure_wide_priors, pairs_of, report_pairs
from lodbench.geometry import EulerAngles, Pose
from lodbench.synthesis.views_dataset import ViewsParams

UPRIGHT = EulerAngles(30, 0, 0)


def rows(view, grid_x, basins_x):
    """Returns two rows of a sweep: where both searches end, metres east of the truth, or None."""
    ends = (("grid", 1000, grid_x), ("basins", 50, basins_x))
    return [
        {
            "seed": 0,
            "query": f"{view}.png",
            "search": search,
            "hypotheses": count,
            "translation_error_m": float("inf") if x is None else x,
            "pose": None if x is None else Pose.from_euler(UPRIGHT, (x, 0, 100)),
        }
        for search, count, x in ends
    ]


@pytest.fixture(scope="module")
def pairs():
    return pairs_of(
        pd.DataFrame([*rows("near", 0.4, 0.41), *rows("far", 0.4, 3.4), *rows("none", 0.4, None)])
    )


def test_ends_are_compared_pose_by_pose(pairs):
    assert pairs["view"].tolist() == ["far", "near", "none"]
    assert pairs["is_same"].tolist() == [False, True, False]
    assert pairs["apart_m"].tolist() == pytest.approx([3.0, 0.01, float("inf")])
    assert "1 of 3 end within 0.1 m" in report_pairs(pairs, "boxes").text


def test_views_of_several_seeds_are_told_apart(pairs):
    both = pd.concat([pairs, pairs.assign(seed=1)])
    text = report_pairs(both, "boxes").text
    assert "seed 0, near" in text
    assert "seed 1, near" in text
    assert "seed" not in report_pairs(pairs, "boxes").text


def test_figures_are_json(pairs):
    figures = {f.figure: f for f in report_pairs(pairs, "boxes").figures}
    json.dumps([f.to_json() for f in figures.values()], allow_nan=False)
    assert figures["hypotheses of basins"].ratio == pytest.approx(20)
    assert figures["views whose searches end in one optimum"].value == 1


def test_both_searches_of_a_view(city):
    views = ViewsParams(str(city), num_views=1, range_m=20.0, height_m=15.0)
    (found,) = measure_wide_priors(views, [0], threads=1).data.to_dict("records")
    assert found["hypotheses basins"] < found["hypotheses grid"]
    assert found["is_same"] == (found["apart_m"] < 0.1 and found["apart_deg"] < 0.1)
