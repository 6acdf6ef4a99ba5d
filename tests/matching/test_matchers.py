"""Matches of photos seen through a known homography, where weights are, poses of known correspondences."""

import hashlib
import sys

import cv2
import numpy as np
import pytest

from lodbench.errors import ConfigError, RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.matching import Features, match_images, open_extractor, open_matcher
from lodbench.matching.pose_solver import open_pose_solver, poses_of_pairs
from lodbench.segmentation.weight_files import Published, fetched_folder, weights_file

HALF = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
# Of pixels whose first centre is (0.5, 0.5): a turn, half the size, a shear and some perspective.
HOMOGRAPHY = np.array([[0.46, -0.19, 210.0], [0.17, 0.52, 20.0], [2e-5, -4e-5, 1.0]])


@pytest.fixture(scope="module")
def pair(shared_data):
    """A drone's photo, and what a camera elsewhere would see of it if it were flat."""
    path = shared_data / "real_photos" / "labelled" / "boruszyn" / "photos" / "img_4970.jpg"
    first = cv2.imread(str(path))[:, :, ::-1]
    first = np.ascontiguousarray(cv2.resize(first, (900, 600), interpolation=cv2.INTER_AREA))
    centres_at_zero = np.linalg.inv(HALF) @ HOMOGRAPHY @ HALF
    second = cv2.warpPerspective(first, centres_at_zero, (700, 500), flags=cv2.INTER_AREA)
    return first, second


def errors_px(matches) -> np.ndarray:
    seen = cv2.perspectiveTransform(matches.first[None].astype(np.float64), HOMOGRAPHY)[0]
    return np.linalg.norm(seen - matches.second, axis=1)


def test_matches_follow_the_homography(pair):
    matches = match_images(*pair, open_matcher("mutual_nn"), open_extractor("sift"))
    off = errors_px(matches)
    assert len(off) > 300
    assert np.mean(off < 2.0) > 0.9
    # Half a pixel of another convention, halved by the homography, would be seen.
    assert np.median(off) < 0.2
    shift = (
        cv2.perspectiveTransform(matches.first[None].astype(np.float64), HOMOGRAPHY)[0] - matches.second
    )[off < 2.0]
    assert np.abs(np.median(shift, axis=0)).max() < 0.08


def test_a_stricter_ratio_leaves_fewer_and_better(pair):
    sift = open_extractor("sift")
    loose = match_images(*pair, open_matcher("mutual_nn", ratio=1.0), sift)
    strict = match_images(*pair, open_matcher("mutual_nn", ratio=0.7), sift)
    assert len(strict.first) < len(loose.first)
    assert np.mean(errors_px(strict) < 2.0) > np.mean(errors_px(loose) < 2.0)


def test_matches_are_mutual_by_an_independent_count(pair):
    sift, matcher = open_extractor("sift", max_features=200), open_matcher("mutual_nn", ratio=1.0)
    first, second = (sift.extract(image) for image in pair)
    distance = np.linalg.norm(first.descriptors[:, None] - second.descriptors[None], axis=2)
    nearest, back = distance.argmin(axis=1), distance.argmin(axis=0)
    expected = [i for i, j in enumerate(nearest) if back[j] == i]
    matches = matcher.match(first, second)
    np.testing.assert_array_equal(matches.first, first.keypoints[expected])
    np.testing.assert_array_equal(matches.second, second.keypoints[nearest[expected]])


def test_features_are_of_length_one_and_bounded_in_number(pair):
    features = open_extractor("sift", max_features=150).extract(pair[0])
    assert 0 < len(features.keypoints) <= 151
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-5)


def test_nothing_to_see_gives_no_matches(pair):
    blank = np.full((40, 60, 3), 128, np.uint8)
    for images in ((blank, blank), (blank, pair[1]), (pair[0], blank)):
        matches = match_images(*images, open_matcher("mutual_nn"), open_extractor("sift"))
        assert matches.first.shape == matches.second.shape == (0, 2)


def test_what_is_no_picture_or_feature_is_refused(pair):
    sift = open_extractor("sift")
    for bad in (pair[0][:, :, 0], pair[0].astype(np.float32), np.zeros((0, 5, 3), np.uint8)):
        with pytest.raises(RenderingError, match="A picture is"):
            sift.extract(bad)
    points = np.full((3, 2), np.nan, np.float32)
    with pytest.raises(RenderingError, match="not all finite"):
        Features(points, np.zeros((3, 4), np.float32), np.zeros(3, np.float32), (9, 9))
    with pytest.raises(RenderingError, match="outside the picture"):
        Features(
            np.full((3, 2), 10, np.float32), np.zeros((3, 4), np.float32), np.zeros(3, np.float32), (9, 9)
        )
    with pytest.raises(ConfigError, match="takes features"):
        match_images(*pair, open_matcher("mutual_nn"))


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: open_matcher("mutual_n"), "mutual_n"),
        (lambda: open_matcher("mutual_nn", ratio=1.5), "ratio=1.5"),
        (lambda: open_matcher("mutual_nn", ration=0.5), "mutual_nn.ration is not a setting"),
        (lambda: open_extractor("sift", max_features=-1), "max_features=-1 is not at least 0"),
    ],
)
def test_bad_settings_are_one_line(make, word):
    with pytest.raises(ConfigError, match=word):
        make()


PUBLISHED = Published("someone/something", "Apache-2.0", 3)
CONTENT = b"numbers"
RIGHT, WRONG = hashlib.sha256(CONTENT).hexdigest(), 64 * "0"


def test_a_pinned_file_or_folder_is_taken_if_it_is_the_one(tmp_path):
    file = tmp_path / "net.safetensors"
    file.write_bytes(CONTENT)
    assert weights_file(f"{file}#sha256={RIGHT}") == weights_file(str(file)) == file
    assert fetched_folder(f"{tmp_path}#sha256={RIGHT}", PUBLISHED) == tmp_path
    for take in (
        lambda: weights_file(f"{file}#sha256={WRONG}"),
        lambda: fetched_folder(f"{tmp_path}#sha256={WRONG}", PUBLISHED),
    ):
        with pytest.raises(ConfigError, match=f"have the sha256 {RIGHT}, not {WRONG}"):
            take()
    with pytest.raises(ConfigError, match="is no SHA-256"):
        weights_file(f"{file}#sha256=12")
    (tmp_path / "second.safetensors").write_bytes(b"")
    with pytest.raises(ConfigError, match="has 2 files"):
        fetched_folder(f"{tmp_path}#sha256={RIGHT}", PUBLISHED)


def test_what_was_not_fetched_is_told_with_its_licence_and_size(monkeypatch, tmp_path):
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    for weights in (None, f"someone/something#sha256={RIGHT}"):
        with pytest.raises(ConfigError, match=r"someone/something.*Apache-2\.0; 3 MB"):
            fetched_folder(weights, PUBLISHED)


CAMERA = Camera(1204, 896, 861.6, 853.3, 607.4, 434.8)
NAMES = ["opencv", "poselib", "pycolmap", "upright"]


def correspondences(seed: int, outliers: float, origin=(0.0, 0.0, 0.0), count: int = 500):
    stream = np.random.default_rng(seed)
    angles = EulerAngles(stream.uniform(20, 60), 0.4, stream.uniform(-180, 180))
    pose = Pose.from_euler(angles, np.array([3.0, -7.0, 130.0]) + origin)
    pixels = stream.uniform(size=(count, 2)) * (CAMERA.width, CAMERA.height)
    rays = np.c_[(pixels - (CAMERA.cx, CAMERA.cy)) / (CAMERA.fx, CAMERA.fy), np.ones(count)]
    points = (rays * stream.uniform(100, 260, (count, 1))) @ pose.rotation + pose.center
    seen = pixels + stream.normal(scale=1.0, size=pixels.shape)
    wrong = np.arange(count) < outliers * count
    seen[wrong] = stream.uniform(size=(int(wrong.sum()), 2)) * (CAMERA.width, CAMERA.height)
    return pose, points, seen, wrong


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.8])
def test_the_pose_is_found_among_outliers(name, outliers):
    for seed in range(4):
        pose, points, pixels, wrong = correspondences(seed, outliers)
        found = open_pose_solver(name).solve(points, pixels, CAMERA, pose)
        assert np.linalg.norm(found.pose.center - pose.center) < 0.5
        assert found.inliers[~wrong].mean() > 0.98
        assert found.inliers[wrong].mean() < 0.05 if wrong.any() else True


def test_gravity_helps_where_nearly_all_is_wrong_though_it_is_a_little_off():
    for seed in range(4):
        pose, points, pixels, _ = correspondences(seed, 0.95)
        pitch, roll, yaw = pose.euler
        prior = Pose.from_euler(EulerAngles(pitch + 0.3, roll - 0.3, yaw + 40), pose.center + 30.0)
        found = open_pose_solver("upright").solve(points, pixels, CAMERA, prior)
        assert np.linalg.norm(found.pose.center - pose.center) < 0.5


def test_two_points_and_gravity_give_the_pose_they_are_seen_from():
    pose, points, _, _ = correspondences(0, 0.0)
    yaw = np.radians(33.0)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    rays = (points - pose.center) @ turn * np.random.default_rng(0).uniform(0.01, 3, (len(points), 1))
    pairs = np.arange(400).reshape(-1, 2)
    yaws, centers = poses_of_pairs(points[pairs], rays[pairs])
    is_it = np.linalg.norm(centers - pose.center, axis=1) < 1e-6
    # One of the two poses of every pair.
    assert is_it.sum() == len(pairs)
    assert np.abs(np.angle(np.exp(1j * (yaws[is_it] - yaw)))).max() < 1e-9


@pytest.mark.parametrize("name", NAMES)
def test_points_far_from_zero_lose_nothing(name):
    pose, points, pixels, _ = correspondences(1, 0.3, origin=(691_000.0, 5_335_000.0, 500.0))
    found = open_pose_solver(name).solve(points, pixels, CAMERA, pose)
    assert np.linalg.norm(found.pose.center - pose.center) < 0.5


@pytest.mark.parametrize("name", NAMES)
def test_a_tighter_threshold_leaves_fewer(name):
    pose, points, pixels, _ = correspondences(2, 0.2)
    loose = open_pose_solver(name, threshold_px=8.0).solve(points, pixels, CAMERA, pose)
    tight = open_pose_solver(name, threshold_px=0.8).solve(points, pixels, CAMERA, pose)
    assert tight.inliers.sum() < 0.7 * loose.inliers.sum()


@pytest.mark.parametrize("name", NAMES)
def test_nothing_to_agree_on_is_none_or_few(name):
    pose, points, pixels, _ = correspondences(3, 1.0, count=60)
    found = open_pose_solver(name).solve(points, pixels, CAMERA, pose)
    assert found is None or found.inliers.sum() < 12
    assert open_pose_solver(name).solve(points[:3], pixels[:3], CAMERA, pose) is None


@pytest.mark.parametrize("name", ["poselib", "pycolmap"])
def test_an_absent_library_is_told_in_a_line(name, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError, match=f"needs {name}") as raised:
        open_pose_solver(name)
    assert "lodbench[pnp]" in raised.value.hint


@pytest.mark.parametrize("wrong", [{"threshold_px": 0.0}, {"max_iterations": 0}, {"confidence": 1.0}])
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ConfigError):
        open_pose_solver("opencv", **wrong)
