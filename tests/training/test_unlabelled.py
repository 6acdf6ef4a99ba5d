"""Photos without masks as training views: labelled by a network, or empty."""

import cv2
import numpy as np
import pytest

from lodbench.errors import DatasetError
from lodbench.segmentation.compact import Compact, CompactParams
from lodbench.segmentation.masks import read_mask
from lodbench.training.photo_sets import ground_samples, pseudo_samples


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "place"
    (folder / "deeper").mkdir(parents=True)
    picture = np.random.default_rng(0).integers(0, 256, (60, 90, 3), dtype=np.uint8)
    for name in ("a.jpg", "deeper/b.png"):
        cv2.imwrite(str(folder / name), picture)
    return folder


def test_labels_of_the_shipped_network_are_written_as_grey_masks(photos, tmp_path):
    teacher = Compact(CompactParams(size=64))
    samples = pseudo_samples(teacher, [photos], tmp_path / "out")
    assert [sample.key for sample in samples] == ["out/place/a.jpg_0", "out/place/deeper/b.png_0"]
    photo, mask = samples[1].read(0, square=False)
    assert photo.shape == (43, 64, 3)
    full = cv2.imread(str(photos / "deeper" / "b.png"))[..., ::-1]
    np.testing.assert_allclose(mask, teacher.probability(full), atol=0.003)
    assert 0 < mask.std()


def test_ground_has_no_building_at_either_size(photos, tmp_path):
    samples = ground_samples(64, [photos], tmp_path / "out")
    assert len(samples) == 4
    assert all(sample.is_ground and read_mask(sample.mask).max() == 0 for sample in samples)
    assert [sample.read(0, square=False)[0].shape for sample in samples[:2]] == [(43, 64, 3), (64, 96, 3)]


def test_photos_of_one_name_in_folders_of_one_name_stay_apart(photos, tmp_path):
    other = tmp_path / "elsewhere" / "place"
    other.mkdir(parents=True)
    for name in ("a.jpg", "a.png"):
        cv2.imwrite(str(other / name), np.zeros((40, 60, 3), np.uint8))
    samples = ground_samples(64, [photos, other], tmp_path / "out")
    assert len({sample.photo for sample in samples}) == len({sample.key for sample in samples}) == 8
    assert [sample.read(0, square=False)[0].any() for sample in samples] == [True] * 4 + [False] * 4


def test_photos_stored_as_tiff_are_learnt_as_well(photos, tmp_path):
    cv2.imwrite(str(photos / "c.tif"), np.zeros((40, 60, 3), np.uint8))
    assert len(ground_samples(64, [photos], tmp_path / "out")) == 6


def test_a_folder_without_photos_is_named(tmp_path):
    with pytest.raises(DatasetError, match="holds no photos to learn from"):
        ground_samples(64, [tmp_path], tmp_path / "out")
