"""Figures of runs whose names mean something to whoever draws them, and of many splits."""

import re

import numpy as np
import pytest

from lodbench.evaluation.pose_errors import summarize
from lodbench.reporting.figures import RecallCurve, draw_recall_curves
from lodbench.reporting.run_figures import ErrorSample, Trace, draw_error_curves, draw_traces, shares_below

ERRORS = np.array([[0.5, 0.3], [4.0, 1.0], [np.inf, 180.0]])


@pytest.mark.parametrize("name", ["$^$", "a$\\frac$", "$x$"])
def test_a_name_between_dollars_is_no_formula(name):
    traces = draw_traces([Trace(f"worst: {name}.jpg", {f"beam {name}": (0.1, 0.4)})])
    curves = draw_error_curves([ErrorSample(name, ERRORS, ERRORS)])
    assert f"worst: {name}.jpg" in traces["svg"].decode()
    assert f"estimate, {name}" in curves["svg"].decode()
    # The numbers along a logarithmic axis are plain ones too.
    assert "mathdefault" not in curves["svg"].decode()
    assert ">0.1<" in curves["svg"].decode()


def test_traces_of_one_query_can_be_told_apart():
    traces = {"beam 1": (0.1, 0.4), "fine": (0.1, 0.3), "coarse": (0.2, 0.3)}
    svg = draw_traces([Trace("worst: a.jpg", traces)])["svg"].decode()
    assert len(set(re.findall(r"stroke-dasharray: ([^;]+);", svg))) == 2


@pytest.mark.slow
def test_every_split_is_drawn_however_many_there_are():
    names = [f"split_{number}" for number in range(6)]
    curves = draw_error_curves([ErrorSample(name, ERRORS, ERRORS) for name in names])["svg"].decode()
    summary = summarize([tuple(row) for row in ERRORS])
    recalls = [RecallCurve(name, (30.0, 50.0), (summary, summary)) for name in names]
    basin = draw_recall_curves([("half width, m", recalls)])["svg"].decode()
    assert all(f"estimate, {name}" in curves and f"2m-2deg, {name}" in basin for name in names)


def test_the_share_below_an_error_begins_at_none_and_lasts_to_the_end():
    x, shares = shares_below(np.array([4.0, 0.5, 900.0]), 5, 100.0)
    assert x[1:].tolist() == [0.5, 4.0, 100.0]
    assert shares.tolist() == [0.0, 20.0, 40.0, 40.0]
    assert shares_below(np.zeros(0), 5, 100.0)[1].tolist() == [0.0, 0.0]
