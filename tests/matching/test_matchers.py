"""SIFT and mutual nearest neighbours on a photo seen through a known homography, and where weights are."""

import hashlib

import cv2
import numpy as np
import pytest

from lodbench.errors import ConfigError, RenderingError
from lodbench.matching import Features, match_images, open_extractor, open_matcher
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
