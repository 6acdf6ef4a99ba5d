"""Figures: calibration, runs whose names mean something to whoever draws them, overlays of photos."""

import re

import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.evaluation.metrics import calibrate
from lodbench.evaluation.pose_errors import summarize
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.reporting.figures import (
    BudgetPoint,
    ErrorSample,
    RecallCurve,
    Trace,
    draw_budget,
    draw_calibration,
    draw_error_curves,
    draw_recall_curves,
    draw_traces,
    shares_below,
)
from lodbench.reporting.overlays import ESTIMATE_COLOUR, OverlayInput, draw_overlay, write_picture
from tests.town import CAMERA, box_obj, prior_of, true_poses


def test_calibration_names_methods_areas_and_counts():
    curves = {
        "one": calibrate([0.95, 0.9, 0.3], [True, True, False]),
        "two": calibrate([0.5] * 7, [True] * 7),
    }
    pictures = draw_calibration(curves)
    svg = pictures["svg"].decode()
    for text in ("one, AURC 11.1 %", "two, AURC 0.0 %", ">7<", "within 2 m, 2 deg"):
        assert text in svg
    assert pictures["png"].startswith(b"\x89PNG")


def test_budget_names_methods():
    curves = {"ours": [BudgetPoint(100, 50, 40, 60), BudgetPoint(1000, 90, 85, 95)]}
    svg = draw_budget({"a city, 20 views": curves})["svg"].decode()
    assert "ours" in svg
    assert "a city, 20 views" in svg
    assert "poses drawn per query" in svg


def test_budget_has_a_panel_for_each_split_and_a_line_for_what_draws_nothing():
    many = {name: [BudgetPoint(10.0 * (n + 1), 50, 40, 60)] for n, name in enumerate("abcd")}
    panels = {"in place": many, "out of place": {"a": many["a"], "prior_only": [BudgetPoint(0, 5, 1, 20)]}}
    svg = draw_budget(panels)["svg"].decode()
    for text in ("in place", "out of place", ">a<", ">d<", ">prior_only<"):
        assert svg.count(text) >= 1
    assert svg.count(">a<") == 1


def test_methods_that_draw_nothing_can_be_reported_apart_where_colours_come_again():
    many = {name: [BudgetPoint(0, 5, 1, 20)] for name in "abcdefgh"}
    svg = draw_budget({"in place": many})["svg"].decode()
    lines = re.findall(r"stroke-dasharray: ([^;]+);[^\"]*stroke: (#\w+)", svg)
    assert len(set(lines)) == 8


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


def test_traces_of_one_query_can_be_reported_apart():
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


def test_overlay_shows_outline_mask_and_caption(tmp_path):
    import cv2

    (tmp_path / "city.obj").write_text(box_obj())
    renderer = SilhouetteRenderer(open_scene(tmp_path / "city.obj"), threads=1)
    (pose,) = true_poses(1).values()
    mask = renderer.render(CAMERA, pose)
    shown = OverlayInput(CAMERA, mask, None, prior_of(pose), pose, None, "a caption")
    picture = draw_overlay(shown, renderer)
    assert picture.shape == (CAMERA.height + 48, CAMERA.width, 3)
    # Lines are smoothed, so near the colour is enough.
    distance = np.abs(picture[: CAMERA.height].astype(int) - ESTIMATE_COLOUR).max(axis=2)
    drawn = distance < 60
    # The estimate's outline runs along the mask's edge.
    padded = np.pad(mask.astype(np.uint8), 3)
    edge = cv2.morphologyEx(padded, cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8))[3:-3, 3:-3] > 0
    assert drawn.sum() > 100
    assert (drawn & edge).sum() > 0.95 * drawn.sum()
    write_picture(tmp_path / "a.png", picture)
    assert np.array_equal(cv2.imread(str(tmp_path / "a.png")), picture)


def test_nothing_but_a_camera_is_enough(tmp_path):
    (tmp_path / "city.obj").write_text(box_obj())
    renderer = SilhouetteRenderer(open_scene(tmp_path / "city.obj"), threads=1)
    picture = draw_overlay(OverlayInput(CAMERA, None, None, None, None, None, "no poses"), renderer)
    assert picture[: CAMERA.height].std() == 0
    # The legend names nothing that is not there.
    assert (picture[CAMERA.height + 24 :] == picture[-1, -1]).all()
