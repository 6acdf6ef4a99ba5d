"""Tracking: from the last pose and motion, lost where nothing fits, found again by search."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, QueryFault
from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.methods.tracking import Tracker, Tracking, TrackingParams, state_of
from lodbench.params import to_params
from lodbench.storage import random_stream
from tests.town import CAMERA

STEP_S = 0.5


def path(count: int) -> list[Pose]:
    """Returns a flight over the town at 6 m/s that turns slowly."""
    return [
        Pose.from_euler(EulerAngles(20 + 0.5 * k, 0.4, -40 + 3.0 * k), (-20 + 3.0 * k, -10 + 0.5 * k, 120.0))
        for k in range(count)
    ]


def frames(city_map, poses: list[Pose]) -> list[Query]:
    masks = [city_map.render(CAMERA, pose).astype(np.float32) for pose in poses]
    return [
        Query(f"f{k}", "", CAMERA, start(poses[0]), mask, time_s=STEP_S * k) for k, mask in enumerate(masks)
    ]


def tracked(tracker: Tracker, frame: Query):
    return tracker.next(frame, partial(random_stream, 0, frame.name))


def start(pose: Pose) -> Pose:
    return Pose.from_euler(
        EulerAngles(*np.add(pose.euler, (0.4, -0.3, 3.0)).tolist()), np.add(pose.center, (4.0, -3.0, 6.0))
    )


def test_each_frame_is_found_from_the_last(city_map):
    poses = path(8)
    all_frames = frames(city_map, poses)
    tracker = Tracking().begin(all_frames[0], city_map)
    for frame, pose in zip(all_frames, poses, strict=True):
        found = tracked(tracker, frame)
        assert state_of(found) == "tracked"
        error = pose_error(found.pose, pose)
        assert error.translation_m < 0.6
        assert error.rotation_deg < 0.3
        # As sure as one frame is: not of centimetres, and not of metres.
        assert 0.02 < np.sqrt(np.trace(found.covariance[:3, :3])) < 2.0
        assert 0.9 < found.probability <= 1.0


def test_motion_carries_over_frames_that_are_gone(city_map):
    # Every third frame only: 9 m from one to the next, further than outlines reach without the motion.
    poses = path(10)
    all_frames = frames(city_map, poses)
    tracker = Tracking().begin(all_frames[0], city_map)
    for k in (0, 1, 2, 3, 6, 9):
        found = tracked(tracker, all_frames[k])
        assert state_of(found) == "tracked"
        assert pose_error(found.pose, poses[k]).translation_m < 0.6


def test_a_lost_camera_says_so_and_is_found_again(city_map):
    poses = path(9)
    all_frames = frames(city_map, poses)
    blind = np.zeros(all_frames[0].mask.shape, np.float32)
    wrong = blind.copy()
    wrong[:70, :70] = 1.0
    all_frames[3], all_frames[4] = (
        replace(all_frames[k], building_probability=mask) for k, mask in ((3, blind), (4, wrong))
    )
    # When it sees again, it is where no motion leads: 25 m aside.
    poses[5:] = [pose.shifted((0.0, 25.0, 0.0)) for pose in poses[5:]]
    all_frames[5:] = [
        replace(frame, building_probability=city_map.render(CAMERA, pose).astype(np.float32))
        for frame, pose in zip(all_frames[5:], poses[5:], strict=True)
    ]
    tracker = Tracking().begin(all_frames[0], city_map)
    found = [tracked(tracker, frame) for frame in all_frames]
    states = list(map(state_of, found))
    assert states[:5] == ["tracked"] * 3 + ["lost"] * 2
    assert [each.covariance is None for each in found] == [state == "lost" for state in states]
    assert [each.probability == 0.0 for each in found] == [state == "lost" for state in states]
    assert "found again" in states[5:8]
    again = states.index("found again")
    assert states[again + 1 :] == ["tracked"] * (8 - again)
    for each, pose in zip(found[again:], poses[again:], strict=True):
        assert pose_error(each.pose, pose).translation_m < 0.8


def test_photos_of_a_dataset_are_followed_by_their_times_or_a_second_apart(city_map):
    poses = path(10)
    every = [frames(city_map, poses)[k] for k in (0, 1, 2, 3, 6, 9)]
    method = Tracking(to_params({"fine_size": [602, 448]}, TrackingParams, "method"))

    def states(photos: list[Query]) -> list[str]:
        streams = [partial(random_stream, 0, photo.name) for photo in photos]
        return list(map(state_of, method.localize_flight(photos, city_map, streams).estimates))

    assert states(every) == ["tracked"] * 6
    # One without a time: of none is known how long after the one before it was taken, so motion misleads.
    untimed = [*every[:5], replace(every[5], time_s=None)]
    assert states(untimed) == states([replace(each, time_s=float(k)) for k, each in enumerate(every)])


def test_a_photo_without_a_building_has_no_pose_of_its_own(city_map):
    (frame,) = frames(city_map, path(1))
    blind = replace(frame, building_probability=np.zeros_like(frame.mask))
    with pytest.raises(QueryFault, match="holds no building"):
        Tracking().localize(blind, city_map, partial(random_stream, 0, "blind"))


def test_a_wrong_setting_is_named():
    with pytest.raises(ConfigError, match=r"method\.fit=0 is not above 0"):
        TrackingParams(fit=0.0)
    with pytest.raises(ConfigError, match=r"method\.fine_size is a width and a height"):
        TrackingParams(fine_size=(602,))


def test_a_search_grows_to_its_widest_and_stays_there_however_long_the_camera_is_lost():
    widths_m = [TrackingParams().search(lost).range_x_m for lost in (1, 2, 3, 10, 100_000)]
    assert widths_m == [20.0, 30.0, 45.0, 120.0, 120.0]


def test_a_lens_that_is_hardly_known_leaves_the_first_place_open(city_map):
    poses = path(2)
    first, second = frames(city_map, poses)
    sigmas_m = []
    for percent in (None, 3.0):
        first = replace(first, lens_percent=percent)
        tracker = Tracking().begin(first, city_map)
        found = tracked(tracker, first)
        assert pose_error(found.pose, poses[0]).translation_m < 2.0
        sigmas_m.append(np.sqrt(np.trace(found.covariance[:3, :3])))
        assert state_of(tracked(tracker, second)) == "tracked"
    assert sigmas_m[1] > 1.5 * sigmas_m[0]
