"""A tilt that is told better than it is known: found where lines are plain, left alone elsewhere."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from lodbench.datasets.query import Query
from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.methods.region import Region
from lodbench.storage import random_stream
from tests.methods.test_region_lens import WIDE, shaded_photo
from tests.methods.test_region_roofs import FAST
from tests.town import prior_of, true_poses

BELIEVING = replace(FAST, tilt_doubt_deg=0.0)


def estimates_of(city_map, folder, tilt_deg, params):
    """Returns the estimates of photos whose prior is tilted so far off, and their errors in place, metres."""
    estimates, errors = [], []
    for number, truth in enumerate(true_poses(2).values()):
        path = folder / f"{number}.png"
        cv2.imwrite(str(path), shaded_photo(city_map, truth, number))
        query = Query(path.name, "all", WIDE, tilted(prior_of(truth), tilt_deg), None, path)
        estimates.append(Region(params).localize(query, city_map, partial(random_stream, 0, "test")))
        errors.append(pose_error(estimates[-1].pose, truth).translation_m)
    return estimates, np.array(errors)


def tilted(pose, tilt_deg):
    """Returns a pose that looks so much higher up and leans half as far."""
    pitch, roll, yaw = pose.euler
    return Pose.from_euler(EulerAngles(pitch + tilt_deg, roll + 0.5 * tilt_deg, yaw), pose.center)


@pytest.mark.slow
@pytest.mark.parametrize("tilt_deg", [pytest.param(-4.0, marks=pytest.mark.slow), 4.0])
def test_a_tilt_worse_than_told_is_found_and_told(city_map, tmp_path, tilt_deg):
    _, believing = estimates_of(city_map, tmp_path, tilt_deg, BELIEVING)
    estimates, doubting = estimates_of(city_map, tmp_path, tilt_deg, FAST)
    assert believing.max() > 3.0
    assert doubting.max() < 1.0
    assert any(
        "outside the stated range" in note and "pitch" in note for each in estimates for note in each.notes
    )


@pytest.mark.slow
@pytest.mark.parametrize("params", [FAST, replace(FAST, range_tilt_deg=0.0)], ids=["as told", "exact"])
def test_a_tilt_as_told_is_left_alone(city_map, tmp_path, params):
    """A range of 0 is believed even where it is wrong: whoever says so knows."""
    tilt_deg = 0.5 if params.range_tilt_deg else 4.0
    doubting, _ = estimates_of(city_map, tmp_path, tilt_deg, params)
    believing, _ = estimates_of(city_map, tmp_path, tilt_deg, replace(params, tilt_doubt_deg=0.0))
    for one, other in zip(doubting, believing, strict=True):
        np.testing.assert_array_equal(one.pose.center, other.pose.center)
