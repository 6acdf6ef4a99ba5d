"""Masks that are compared: sigmoid, the paper's stretch checks of answers; masks in the cache."""

import numpy as np
import pytest

from lodbench.errors import ConfigError, QueryFault
from lodbench.geometry import Camera
from lodbench.segmentation import check_mask
from lodbench.segmentation import photo_segmenter as mask_cache
from lodbench.segmentation.photo_segmenter import cached_probability
from lodbench.segmentation.probability import check_normalise, probability_of, without_unsure_parts
from lodbench.storage.paths import cache_root


def logit(p):
    p = np.asarray(p, np.float64)
    return np.log(p / (1 - p)).astype(np.float32)


def test_without_a_stretch_it_is_the_sigmoid():
    p = np.array([[0.1, 0.6], [0.3, 0.9]])
    np.testing.assert_allclose(probability_of(logit(p), "none"), p, atol=1e-6)


def test_the_paper_stretches_to_0_and_1():
    found = probability_of(logit([[0.1, 0.5], [0.3, 0.9]]), "paper")
    np.testing.assert_allclose(found, [[0.0, 0.5], [0.25, 1.0]], atol=1e-6)


@pytest.mark.parametrize("values", [[[0.01, 0.02], [0.2, 0.49]], [[0.51, 0.7], [0.9, 0.99]], [[0.6, 0.6]]])
def test_a_photo_of_one_kind_only_is_not_stretched(values):
    # Unguarded, half of a photo without any building would turn into buildings.
    np.testing.assert_allclose(probability_of(logit(values), "paper"), values, atol=1e-6)


def test_huge_logits_stay_in_range():
    found = probability_of(np.array([[-1e4, 1e4]], np.float32), "none")
    assert found.tolist() == [[0.0, 1.0]]


def test_unknown_normalisations_are_named():
    with pytest.raises(ConfigError, match="minmax"):
        check_normalise("minmax")


def test_parts_that_convince_nobody_are_dropped():
    found = np.full((20, 40), 0.1, np.float32)
    found[2:12, 2:12] = 0.8  # none of it is sure
    found[2:12, 20:30] = 0.8
    found[2:3, 20:30] = 0.995  # a tenth of it is
    found[15:17, 5:15] = 0.8
    found[15, 5] = 0.995  # a twentieth
    kept = without_unsure_parts(found, 0.99)
    expected = np.zeros_like(found, bool)
    expected[2:12, 20:30] = True
    assert np.array_equal(kept >= 0.5, expected)
    assert np.array_equal(kept[expected], found[expected])
    assert kept[5, 5] == np.float32(0.4)
    assert np.array_equal(without_unsure_parts(found, 0.0), found)


@pytest.mark.parametrize("normalise", ["none", "paper"])
def test_an_answer_that_is_no_number_is_no_empty_mask(normalise):
    logits = np.zeros((4, 6), np.float32)
    logits[1, 2] = np.nan
    with pytest.raises(QueryFault, match="NaN"):
        probability_of(logits, normalise)


CAMERA = Camera(640, 512, 1125.0, 1125.0, 320.0, 256.0)


class TestAccepted:
    @pytest.mark.parametrize("kind", [bool, np.uint8, np.int64, np.float16, np.float32, np.float64])
    def test_any_kind_of_number(self, kind):
        mask = np.zeros((64, 80), kind)
        mask[10:20] = 1
        checked = check_mask(mask, CAMERA)
        assert checked.dtype == np.float32
        np.testing.assert_array_equal(checked, mask.astype(np.float32))

    def test_probabilities_stay_as_they_are(self):
        mask = np.random.default_rng(0).random((512, 640), dtype=np.float32)
        np.testing.assert_array_equal(check_mask(mask, CAMERA), mask)

    def test_a_step_of_rounding_is_taken_back(self):
        mask = np.full((64, 80), np.nextafter(np.float32(1), np.float32(2)))
        mask[0] = -1e-8
        checked = check_mask(mask, CAMERA)
        assert checked.min() == 0
        assert checked.max() == 1

    def test_no_building_is_for_the_method_to_say(self):
        assert not check_mask(np.zeros((64, 80)), CAMERA).any()

    def test_a_photo_one_pixel_wide(self):
        narrow = Camera(width=1, height=400, fx=400.0, fy=400.0, cx=0.5, cy=200.0)
        assert check_mask(np.ones((512, 1)), narrow).shape == (512, 1)

    @pytest.mark.parametrize(("height", "width"), [(512, 640), (511, 640), (50, 63), (1024, 1280), (4, 5)])
    def test_any_size_of_the_aspect(self, height, width):
        assert check_mask(np.ones((height, width)), CAMERA).shape == (height, width)


class TestRefused:
    @pytest.mark.parametrize(
        ("mask", "reason"),
        [
            (np.ones((64, 64)), "64 x 64, the camera 640 x 512: another aspect"),
            (np.ones((80, 64)), "64 x 80, .*another aspect"),
            (np.ones((64, 80, 3)), r"shape \(64, 80, 3\)"),
            (np.ones((64, 80, 1)), r"shape \(64, 80, 1\)"),
            (np.ones(80), r"shape \(80,\)"),
            (1.0, r"shape \(\)"),
            (np.ones((0, 80)), "empty"),
            (np.ones((64, 0), bool), "empty"),
            (np.full((64, 80), np.nan), "not finite"),
            (np.full((64, 80), np.inf), "not finite"),
            (np.full((64, 80), -0.1), "from -0.1 to -0.1"),
            (np.full((64, 80), -1, np.int8), "from -1 to -1"),
            (np.full((64, 80), 1.5), "to 1.5"),
            (np.full((64, 80), "1"), "instead of numbers"),
            (np.full((64, 80), 1j), "complex128 instead of numbers"),
            (None, "object instead of numbers"),
            ([[1, 0], [1]], "differ in length"),
        ],
    )
    def test_with_one_reason(self, mask, reason):
        with pytest.raises(QueryFault, match=reason):
            check_mask(mask, CAMERA)

    @pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int32, np.float32])
    def test_bytes_are_no_probabilities(self, kind):
        mask = np.zeros((64, 80), kind)
        mask[10:20] = 255
        with pytest.raises(QueryFault, match="from 0 to 255 instead of probabilities") as caught:
            check_mask(mask, CAMERA)
        assert caught.value.hint == "Divide by 255."


@pytest.fixture
def photo(tmp_path, monkeypatch):
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))
    path = tmp_path / "photo.jpg"
    path.write_bytes(b"a photo")
    return path


@pytest.mark.attack
def test_flipped_bits_never_change_a_mask(photo, caplog):
    probability = np.linspace(0, 1, 48 * 64, dtype=np.float32).reshape(48, 64)
    asked: list[bytes] = []

    def compute(content):
        asked.append(content)
        return probability

    whole = cached_probability(photo, "network", compute)
    assert np.abs(whole - probability).max() < 1e-5
    (file,) = (cache_root() / "segmentations").iterdir()
    content, told = file.read_bytes(), 0
    # The archive's and the array's headers, the values and the archive's directory.
    for place in [
        *range(0, 240, 3),
        *range(240, len(content), 97),
        *range(len(content) - 130, len(content), 3),
    ]:
        damaged = bytearray(content)
        damaged[place] ^= 1 << place % 8
        file.write_bytes(damaged)
        asked.clear()
        assert (cached_probability(photo, "network", compute) == whole).all(), place
        told += bool(asked)
        assert bool(asked) == ("is damaged" in caplog.text), place
        caplog.clear()
    assert told > 100


@pytest.mark.attack
@pytest.mark.parametrize("change", ["_LIBRARIES", "__file__"])
def test_other_code_makes_its_own_mask(photo, monkeypatch, tmp_path, change):
    mask_cache._code_digest.cache_clear()
    cached_probability(photo, "network", lambda content: np.zeros((4, 4), np.float32))
    (tmp_path / "photos.py").write_text("# changed\n")
    monkeypatch.setattr(mask_cache, change, ("scipy",) if change == "_LIBRARIES" else str(tmp_path / "x.py"))
    mask_cache._code_digest.cache_clear()
    try:
        found = cached_probability(photo, "network", lambda content: np.ones((4, 4), np.float32))
    finally:
        mask_cache._code_digest.cache_clear()
    assert (found == 1).all()
