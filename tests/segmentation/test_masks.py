import struct
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.datasets.query import Entry
from lodbench.errors import QueryFault
from lodbench.segmentation import binary_mask
from lodbench.segmentation.masks import MaskFiles, MasksParams, read_mask


def save(path: Path, image: np.ndarray) -> Path:
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())
    return path


def entry_with(mask: Path | None) -> Entry:
    return Entry("a.jpg", "all", None, None, None, mask)


class TestReadMask:
    @pytest.mark.parametrize(("kind", "white"), [(np.uint8, 255), (np.uint16, 65535)])
    def test_white_is_one_at_either_depth(self, tmp_path, kind, white):
        image = np.array([[0, white], [white // 5, white]], dtype=kind)
        mask = read_mask(save(tmp_path / "m.png", image))
        assert mask.dtype == np.float32
        np.testing.assert_allclose(mask, [[0, 1], [0.2, 1]], atol=1e-6)

    @pytest.mark.parametrize("kind", [np.uint8, np.uint16])
    @pytest.mark.parametrize("alpha", [None, 0, 128, 255])
    def test_grey_may_be_stored_with_more_channels(self, tmp_path, kind, alpha):
        white = np.iinfo(kind).max
        grey = np.array([[0, white, 0], [white, white, white // 5]], dtype=kind)
        layers = [grey] * 3 + ([] if alpha is None else [np.full_like(grey, alpha)])
        mask = read_mask(save(tmp_path / "m.png", np.dstack(layers)))
        assert mask.dtype == np.float32
        np.testing.assert_allclose(mask, [[0, 1, 0], [1, 1, 0.2]], atol=1e-6)

    @pytest.mark.parametrize("channel", [0, 1, 2])
    @pytest.mark.parametrize("channels", [3, 4])
    def test_colours_are_refused(self, tmp_path, channel, channels):
        image = np.full((3, 5, channels), 255, np.uint8)
        image[1, 2, channel] = 254
        with pytest.raises(QueryFault, match=r"m\.png is in colour"):
            read_mask(save(tmp_path / "m.png", image))

    def test_an_alpha_that_varies_is_refused(self, tmp_path):
        image = np.full((3, 5, 4), 255, np.uint8)
        image[1, 2, 3] = 0
        with pytest.raises(QueryFault, match=r"m\.png has an alpha channel that varies"):
            read_mask(save(tmp_path / "m.png", image))

    @pytest.mark.parametrize(("kind", "white"), [(np.uint8, 255), (np.uint16, 65535)])
    def test_labels_of_0_and_1_are_refused(self, tmp_path, kind, white):
        labels = np.array([[0, 1], [1, 0]], dtype=kind)
        for image in (labels, np.dstack([labels] * 3), np.ones_like(labels)):
            with pytest.raises(QueryFault, match=f"its largest value is 1; {white} means building"):
                read_mask(save(tmp_path / "m.png", image))

    def test_a_mask_without_building_is_read(self, tmp_path):
        assert not read_mask(save(tmp_path / "m.png", np.zeros((3, 5), np.uint8))).any()

    def test_an_image_too_large_to_decode_is_a_fault_of_the_query(self, tmp_path):
        whole = save(tmp_path / "m.png", np.zeros((2, 2), np.uint8)).read_bytes()
        header = b"IHDR" + struct.pack(">II", 1_000_000, 1_000_000) + whole[24:29]
        forged = whole[:12] + header + struct.pack(">I", zlib.crc32(header)) + whole[33:]
        (tmp_path / "m.png").write_bytes(forged)
        with pytest.raises(QueryFault, match="too many pixels"):
            read_mask(tmp_path / "m.png")

    @pytest.mark.parametrize("name", ["Zürich (Süd), 1.png", "with space.png"])
    def test_any_path(self, tmp_path, name):
        assert read_mask(save(tmp_path / name, np.full((2, 2), 255, np.uint8))).all()

    @pytest.mark.parametrize("content", [b"", b"not an image", b"\x89PNG\r\n\x1a\n" + b"\0" * 40])
    def test_what_is_no_image_is_a_fault_of_the_query(self, tmp_path, content):
        path = tmp_path / "m.png"
        path.write_bytes(content)
        with pytest.raises(QueryFault, match=r"m\.png"):
            read_mask(path)

    def test_a_truncated_image_never_crashes(self, tmp_path):
        whole = cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (64, 64), np.uint8))[
            1
        ].tobytes()
        path = tmp_path / "m.png"
        path.write_bytes(whole[: len(whole) // 2])
        try:
            assert read_mask(path).shape == (64, 64)
        except QueryFault:
            pass

    def test_floating_point_images_are_refused(self, tmp_path):
        path = save(tmp_path / "m.tiff", np.ones((4, 4), np.float32))
        with pytest.raises(QueryFault, match="8 or 16 bit"):
            read_mask(path)

    def test_a_missing_file_and_a_folder(self, tmp_path):
        for path in (tmp_path / "m.png", tmp_path):
            with pytest.raises(QueryFault, match="cannot be read"):
                read_mask(path)

    def test_the_real_mask(self, shared_data):
        mask = read_mask(shared_data / "uavd4l" / "demo" / "masks" / "DJI_20230513163714_0033_T.png")
        assert mask.shape == (512, 640)
        assert set(np.unique(mask)) == {0.0, 1.0}


class TestMaskFiles:
    def test_reads_the_entrys_file(self, tmp_path):
        path = save(tmp_path / "m.png", np.full((2, 3), 255, np.uint8))
        assert MaskFiles(MasksParams()).segment(entry_with(path)).shape == (2, 3)

    def test_without_a_mask_the_query_fails(self):
        with pytest.raises(QueryFault, match="no mask"):
            MaskFiles(MasksParams()).segment(entry_with(None))

    def test_another_folder_takes_the_place_of_the_datasets(self, tmp_path):
        own = save(tmp_path / "own.png", np.zeros((2, 3), np.uint8))
        entry = replace(entry_with(own), name="DJI_0001.JPG")
        (tmp_path / "theirs").mkdir()
        masks = MaskFiles(MasksParams(folder=str(tmp_path / "theirs")))
        with pytest.raises(QueryFault, match="no mask in"):
            masks.segment(entry)
        without = masks.fingerprint((entry,))
        save(tmp_path / "theirs" / "DJI_0001.png", np.full((2, 3), 255, np.uint8))
        assert (masks.segment(entry) == 1).all()
        assert masks.fingerprint((entry,)) != without

    def test_the_fingerprint_follows_the_content(self, tmp_path):
        masks = MaskFiles(MasksParams())
        path = save(tmp_path / "m.png", np.full((2, 3), 255, np.uint8))
        first = masks.fingerprint((entry_with(path),))
        assert masks.fingerprint((entry_with(path),)) == first
        save(path, np.zeros((2, 3), np.uint8))
        assert masks.fingerprint((entry_with(path),)) != first
        assert masks.fingerprint((entry_with(None),)) != first

    def test_a_file_that_cannot_be_read_stops_only_its_query(self, tmp_path):
        masks = MaskFiles(MasksParams())
        link = tmp_path / "m.png"
        link.symlink_to("/proc/self/mem" if Path("/proc/self/mem").exists() else tmp_path)
        print_of = {masks.fingerprint((entry_with(path),)) for path in (link, tmp_path, tmp_path / "none")}
        assert len(print_of) == 1
        assert print_of != {masks.fingerprint((entry_with(None),))}
        with pytest.raises(QueryFault, match="cannot be read"):
            masks.segment(entry_with(link))


class TestBinaryMask:
    def test_the_same_size_is_thresholded_at_a_half(self):
        probability = np.array([[0.4999, 0.5, 0.5001]], dtype=np.float32)
        assert binary_mask(probability, 3, 1).tolist() == [[False, True, True]]

    def test_halving_averages_areas_before_the_threshold(self):
        # Blocks of 2 x 2 with means 0.5, 0.25, 1 and 0.475.
        probability = np.array([[1, 1, 1, 0], [0, 0, 0, 0], [1, 1, 0.9, 0], [1, 1, 0, 1.0]], dtype=np.float32)
        assert binary_mask(probability, 2, 2).tolist() == [[True, False], [True, False]]

    def test_fractions_of_pixels_count(self):
        # Three columns into two: each takes one and a half.
        probability = np.array([[1, 0, 1]], dtype=np.float32)
        assert binary_mask(probability, 2, 1).tolist() == [[True, True]]
        probability = np.array([[0.7, 0, 0]], dtype=np.float32)
        assert binary_mask(probability, 2, 1).tolist() == [[False, False]]

    @given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 2**32 - 1))
    def test_whole_factors_against_numpy(self, fx, fy, seed):
        probability = np.random.default_rng(seed).random((4 * fy, 5 * fx), dtype=np.float32)
        means = probability.astype(np.float64).reshape(4, fy, 5, fx).mean(axis=(1, 3))
        found = binary_mask(probability, 5, 4)
        # Sums in float32 may fall either way within rounding of a half.
        clear = np.abs(means - 0.5) > 1e-5
        np.testing.assert_array_equal(found[clear], (means >= 0.5)[clear])

    def test_full_precision_not_bytes(self):
        # 0.4995 would round to 127.37 / 255 and back above a half at 8 bits.
        assert not binary_mask(np.full((8, 8), 0.4995, np.float32), 4, 4).any()

    def test_a_smaller_mask_grows(self):
        small = np.zeros((2, 2), np.float32)
        small[0, 0] = 1
        grown = binary_mask(small, 8, 8)
        assert grown[:4, :4].all()
        assert not grown[4:, 4:].any()
