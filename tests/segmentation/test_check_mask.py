import numpy as np
import pytest

from lodbench.errors import QueryFault
from lodbench.geometry import Camera
from lodbench.segmentation import check_mask

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
