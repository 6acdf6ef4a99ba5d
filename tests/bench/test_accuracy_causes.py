from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from lodbench.bench.accuracy_causes import measure_causes
from lodbench.datasets.inputs import Input
from lodbench.datasets.priors import UniformPrior
from lodbench.evaluation.queries import ERROR, PRIOR_ERROR
from lodbench.geometry import Pose
from lodbench.methods.protocol import Estimate
from lodbench.synthesis.views_dataset import ViewsParams


@dataclass(frozen=True)
class Told:
    name: str = "believer"
    x_m: float = 0.0


class Believer:
    """Answers with the prior, keeps the prior turned about as an alternative, and notes what it was told."""

    params_type, name, requires = Told, "believer", frozenset({Input.MASK})
    told: list[UniformPrior] = []  # noqa: RUF012

    def __init__(self, params: Told | None = None) -> None:
        self.params = params or Told()

    def params_for_prior(self, prior: UniformPrior) -> Told:
        self.told.append(prior)
        return Told(x_m=prior.x_m)

    def localize(self, query, city_map, streams):
        moved = Pose(query.prior.rotation, query.prior.translation + np.array([0.0, 0.0, 500.0]))
        return Estimate(pose=moved, score=0.5, probability=0.25, alternatives=(query.prior,))


@pytest.fixture(scope="module")
def report(city):
    Believer.told.clear()
    views = ViewsParams(str(city), num_views=3, tilt_deg=0.5)
    return measure_causes([views], [0], [Believer()], threads=1)


def errors(report, cause):
    return report.data[report.data["cause"] == cause][list(ERROR)].to_numpy()


def test_each_cause_is_taken_away_alone_and_the_method_is_told_the_same(report):
    assert {prior.x_m for prior in Believer.told} == {10.0}
    assert {prior.pitch_deg for prior in Believer.told} == {0.5, 0.0}
    drawn, known = errors(report, "as drawn"), errors(report, "place known")
    # The alternative of a known place stands at the truth; the answer is 500 m off in both.
    assert known[:, 0] == pytest.approx(500.0, abs=0.01)
    assert (np.abs(drawn[:, 0] - 500.0) > 0.1).all()
    assert known[:, 1] == pytest.approx(drawn[:, 1])
    assert (errors(report, "true tilt")[:, 1] < drawn[:, 1]).all()


def test_masks_are_perfect_where_they_are_said_to_be(report):
    by_cause = report.data.groupby("cause")["mask_iou"].min()
    assert by_cause["perfect masks"] == 1.0
    assert by_cause["exact map and perfect masks"] == 1.0
    assert by_cause["as drawn"] < 0.9


def test_what_was_kept_counts_beside_what_was_answered(city):
    views = ViewsParams(str(city), num_views=8, tilt_deg=0.0, range_m=0.0)
    data = measure_causes([views], [0], [Believer()], threads=1).data
    # The prior that it keeps stands at the truth, turned by up to 7.5 degrees.
    assert (data["is_any_kept_found"] == (data[PRIOR_ERROR[1]] < 2.0)).all()
    assert 0 < data["is_any_kept_found"].mean() < 1


def test_table_and_figures_agree(report, city):
    figures = {figure.figure: figure.value for figure in report.figures}
    assert figures[f"found as drawn believer {city.name}"] == 0.0
    assert figures[f"found said believer {city.name}"] == 25.0
    for part in ("any kept", "place known", "mean of 1", "25.0", "seed 0"):
        assert part in report.text
