from __future__ import annotations

import numpy as np
import pytest

from lodbench.bench.accuracy_causes import measure_causes
from lodbench.bench.outline_limit import linear_errors, share_within_reach
from lodbench.cli import main
from lodbench.methods.registry import make_method
from lodbench.synthesis.views_dataset import ViewsParams


def test_no_linear_estimate_learnt_from_examples_errs_less():
    stream = np.random.default_rng(3)
    # Far apart the points' noise is independent, so that the covariance the estimate takes is the true one.
    pixels = np.column_stack([1e4 * np.arange(30.0), np.zeros(30)])
    slopes, sigmas = stream.normal(size=(30, 3)), np.array([1.0, 5.0, 0.2])
    known = stream.normal(scale=4.0, size=(40000, 30)) + 1.5
    offsets = stream.normal(size=(20000, 3)) * sigmas
    judged = stream.normal(scale=4.0, size=(20000, 30)) + 1.5
    errors = linear_errors(slopes, known, judged, pixels, offsets, sigmas)

    def seen(offsets, noise):
        return np.column_stack([offsets @ slopes.T + noise, np.ones(len(noise))])

    examples = stream.normal(size=(len(known), 3)) * sigmas
    learnt = np.linalg.lstsq(seen(examples, known), examples, rcond=None)[0]
    best = seen(offsets, judged) @ learnt - offsets
    assert (errors**2).mean(axis=0) == pytest.approx((best**2).mean(axis=0), rel=0.02)
    assert ((errors**2).mean(axis=0)[:2] < 0.5 * sigmas[:2] ** 2).all()


@pytest.mark.slow
def test_perfect_masks_leave_everything_within_reach_and_rough_ones_less(city):
    shares = [share_within_reach(ViewsParams(str(city), num_views=2, mask_iou=iou), 20) for iou in (1.0, 0.5)]
    assert shares[0] == 100.0
    assert shares[1] < 90.0


@pytest.mark.slow
def test_the_limit_is_one_more_column_and_the_same_for_all_methods(city):
    views = ViewsParams(str(city), num_views=1)
    methods = [make_method(name) for name in ("prior_only", "lodlocv2")]
    steps: list[tuple[int, int]] = []
    report = measure_causes([views], [0], methods, lambda *step: steps.append(step), 1, limit_draws=20)
    assert steps == [(k, 13) for k in range(1, 14)]  # six causes by two methods, and the limit
    found = {figure.figure: figure.value for figure in report.figures if "best linear" in figure.figure}
    assert len(found) == 2
    assert len(set(found.values())) == 1
    assert set(found.values()) == {share_within_reach(views, 20)}
    assert "best linear" in report.text.splitlines()[0]


@pytest.mark.parametrize("options", [["--limit", "200"], ["--causes", "--limit", "5"]])
def test_a_limit_without_its_column_or_its_masks_is_refused(options, capsys):
    assert main(["bench", "accuracy", *options]) == 2
    assert "--causes --limit 200" in capsys.readouterr().err
