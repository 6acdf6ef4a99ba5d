"""A pose in a surveyor's terms: coordinates, compass heading, gimbal pitch, standard deviations in order."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lodbench.datasets.exchange.survey import SIGMA_COLUMNS, SURVEY_COLUMNS, survey_row
from lodbench.datasets.map_frame import MapFrame
from lodbench.geometry import EulerAngles, Pose

POSE = Pose.from_euler(EulerAngles(60.0, 1.5, -30.0), (281018.84, 5657451.55, 151.24))


def test_a_row_without_a_reference_system_counts_from_the_axes():
    row = survey_row(POSE, None)
    assert list(row) == list(SURVEY_COLUMNS)
    assert (row["heading_deg"], row["pitch_deg"], row["roll_deg"]) == pytest.approx((30.0, -30.0, 1.5))
    assert {name for name, value in row.items() if value is None} == {
        "latitude_deg", "longitude_deg", *SIGMA_COLUMNS,
    }  # fmt: skip


def test_a_heading_counts_from_true_north():
    """Three degrees west of its central meridian, UTM's grid north is 2.3 degrees west of true north."""
    place = MapFrame("EPSG:25832").place_of(POSE)
    row = survey_row(POSE, place)
    latitude, off_meridian = math.radians(row["latitude_deg"]), math.radians(row["longitude_deg"] - 9.0)
    convergence = math.degrees(math.atan(math.tan(off_meridian) * math.sin(latitude)))
    assert row["heading_deg"] == pytest.approx(30.0 + convergence, abs=0.01)
    assert convergence < -2


@pytest.mark.parametrize("is_triangle", [False, True])
def test_standard_deviations_are_of_their_columns(is_triangle):
    covariance = np.diag(np.arange(1.0, 7.0) ** 2)
    covariance[0, 1] = covariance[1, 0] = 0.5
    given = covariance[np.triu_indices(6)] if is_triangle else covariance
    row = survey_row(POSE, None, given)
    # A covariance has x, y, z, pitch, roll, yaw.
    assert [row[name] for name in SIGMA_COLUMNS] == [1.0, 2.0, 3.0, 6.0, 4.0, 5.0]


def test_a_heading_just_west_of_north_is_no_360_degrees():
    pose = Pose.from_euler(EulerAngles(60.0, 0.0, 1e-5), (0.0, 0.0, 10.0))
    assert survey_row(pose, None)["heading_deg"] == 0.0
