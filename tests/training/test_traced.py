"""Photos with traced masks as training views."""

import cv2
import numpy as np
import pytest

from lodbench.errors import DatasetError
from lodbench.training.nets.batches import batches
from lodbench.training.photo_sets import repeated, traced_samples
from lodbench.training.samples import TrainParams


@pytest.fixture
def traced(tmp_path):
    """A photo whose left half is a building, 400 x 300, and whose last rows nobody could tell."""
    for kind in ("photos", "masks"):
        (tmp_path / "town" / kind).mkdir(parents=True)
    photo, mask = np.zeros((300, 400, 3), np.uint8), np.zeros((300, 400), np.uint8)
    photo[::2] = 200
    mask[:, :200] = 255
    mask[280:] = 128
    cv2.imwrite(str(tmp_path / "town" / "photos" / "one.png"), photo)
    cv2.imwrite(str(tmp_path / "town" / "masks" / "one.png"), mask)
    return tmp_path


def test_crops_are_cut_from_all_pixels_at_the_networks_size(traced):
    (sample,) = traced_samples(200, [traced])
    assert sample.working_scale == 0.5
    params = TrainParams(data="", crop=64, scale=(2.0, 2.0), batch=1)
    ((images, truth),) = batches([sample], params, 0, 0, 0, 1)
    assert images.shape == (1, 3, 64, 64)
    # At twice half the size every second row of the photo is still told from the next.
    assert np.abs(np.diff(images.numpy()[0, 0], axis=0)).max() > 0.5
    assert set(np.unique(np.round(truth.numpy(), 1))) <= {0.0, 0.5, 1.0}


def test_few_photos_are_a_share_of_an_epoch_each_time_another_crop(traced):
    samples = traced_samples(200, [traced])
    views = repeated(samples, 0.25, 30)
    assert len(views) == 10
    assert len({view.key for view in views}) == 10
    assert len(repeated(samples, 0.0, 30)) == 1
    assert repeated([], 0.5, 30) == []


def test_a_photo_without_a_mask_is_named(traced):
    (traced / "town" / "masks" / "one.png").unlink()
    with pytest.raises(DatasetError, match=r"one\.png has no mask"):
        traced_samples(200, [traced])


def test_a_mask_of_another_size_and_two_photos_of_one_name_are_refused(traced):
    folder = traced / "town"
    cv2.imwrite(str(folder / "masks" / "one.png"), np.zeros((400, 300), np.uint8))
    with pytest.raises(DatasetError, match=r"masks/one\.png is not of its photo's size"):
        traced_samples(200, [traced])
    cv2.imwrite(str(folder / "photos" / "one.jpg"), np.zeros((300, 400, 3), np.uint8))
    with pytest.raises(DatasetError, match="share a name"):
        traced_samples(200, [traced])
