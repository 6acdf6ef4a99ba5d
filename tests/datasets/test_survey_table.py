"""A pose in a surveyor's terms: coordinates, compass heading, gimbal pitch, standard deviations in order."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.angles import STEEP_DEG, off_nadir_deg
from lodbench.photos.map_frame import SIGMA_COLUMNS, SURVEY_COLUMNS, MapFrame, survey_row
from lodbench.photos.metadata import PhotoMetadata
from lodbench.photos.pose import RoughPlace, pose_at, pose_from_photo

LOOK = ("heading_deg", "pitch_deg", "roll_deg")
UTM = MapFrame("EPSG:25832")
POSE = Pose.from_euler(EulerAngles(60.0, 1.5, -30.0), (281018.84, 5657451.55, 151.24))


def test_a_row_without_a_reference_system_counts_from_the_axes():
    row = survey_row(POSE, None)
    assert list(row) == list(SURVEY_COLUMNS)
    # Roll is 1.5 about the level axis ahead; the axis itself looks a little to the side of that.
    right, _, ahead = POSE.rotation
    heading, pitch = math.atan2(ahead[0], ahead[1]), math.asin(ahead[2])
    roll = math.asin(-right[2] / math.cos(pitch))
    assert [row[name] for name in LOOK] == pytest.approx(np.degrees([heading, pitch, roll]), abs=6e-4)
    assert {name for name, value in row.items() if value is None} == {
        "latitude_deg", "longitude_deg", *SIGMA_COLUMNS,
    }  # fmt: skip


def test_a_heading_counts_from_true_north():
    """Three degrees west of its central meridian, UTM's grid north is 2.3 degrees west of true north."""
    place = MapFrame("EPSG:25832").place_of(POSE)
    row = survey_row(POSE, place)
    latitude, off_meridian = math.radians(row["latitude_deg"]), math.radians(row["longitude_deg"] - 9.0)
    convergence = math.degrees(math.atan(math.tan(off_meridian) * math.sin(latitude)))
    assert row["heading_deg"] == pytest.approx(survey_row(POSE, None)["heading_deg"] + convergence, abs=0.01)
    assert convergence < -2


@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: 0.1 < np.linalg.norm(q)),
    st.sampled_from([None, UTM]),
)
def test_a_row_given_back_with_heading_pitch_and_roll_makes_the_same_pose(quaternion, frame):
    """Through what reads a photo's metadata, whatever way the camera is turned; columns are rounded."""
    pose = Pose.from_center(Rotation.from_quat(quaternion).as_matrix(), POSE.center)
    assume(STEEP_DEG < off_nadir_deg(pose.rotation) < 180.0 - STEEP_DEG)
    row = survey_row(pose, None if frame is None else frame.place_of(pose))
    assert -90.0 <= row["pitch_deg"] <= 90.0
    photo = PhotoMetadata("a.jpg", 400, 300)
    turned = RoughPlace(**{name: row[name] for name in LOOK})
    if frame is None:
        again = pose_at(tuple(row[name] for name in list(row)[:3]), 0.0, photo, turned)
    else:
        where = {name: row[name] for name in ("latitude_deg", "longitude_deg", "height_m")}
        again = pose_from_photo(photo, frame, given=replace(turned, **where))
    error = pose_error(again, pose)
    assert error.translation_m < 0.002
    assert error.rotation_deg < 0.002


@pytest.mark.parametrize("is_triangle", [False, True])
def test_standard_deviations_are_of_their_columns(is_triangle):
    covariance = np.diag(np.arange(1.0, 7.0) ** 2)
    covariance[0, 1] = covariance[1, 0] = 0.5
    given = covariance[np.triu_indices(6)] if is_triangle else covariance
    row = survey_row(POSE, None, given)
    # A covariance has x, y, z, pitch, roll, yaw; those of the angles come from draws of whole poses.
    assert [row[name] for name in SIGMA_COLUMNS[:3]] == [1.0, 2.0, 3.0]
    draws = np.random.default_rng(1).normal(size=(20000, 3)) * (0.004, 0.005, 0.006)
    rows = [survey_row(Pose.from_euler(EulerAngles(*d), (0, 0, 0)), None) for d in draws + POSE.euler]
    spread = 1000.0 * np.std([[row[name] for name in LOOK] for row in rows], axis=0)
    assert [row[name] for name in SIGMA_COLUMNS[3:]] == pytest.approx(spread, rel=0.02)


def test_a_heading_just_west_of_north_is_no_360_degrees():
    pose = Pose.from_euler(EulerAngles(60.0, 0.0, 1e-5), (0.0, 0.0, 10.0))
    assert survey_row(pose, None)["heading_deg"] == 0.0
