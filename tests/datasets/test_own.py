"""Writing a dataset folder: nothing of one image takes the place of another's."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lodbench.datasets.own import OwnImage, find_inside, find_mask, write_dataset
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, Pose


def test_masks_that_would_have_one_name_are_refused(tmp_path):
    mask = tmp_path / "a.png"
    mask.write_bytes(cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes())
    camera = Camera(4, 4, 3.0, 3.0, 2.0, 2.0)
    pair = [
        OwnImage(name, camera, truth=Pose(np.eye(3), np.zeros(3)), mask=mask) for name in ("a.JPG", "a.tif")
    ]
    with pytest.raises(DatasetError, match="2 images with a mask are called a"):
        write_dataset(pair, tmp_path / "town", {})
    assert not (tmp_path / "town").exists()
    assert len(write_dataset([replace(pair[0], mask=None), pair[1]], tmp_path / "town", {}).names) == 2


@pytest.mark.parametrize("name", ["/", ".", "..", "a\0b.jpg", "x" * 400, "../b.png", "c.jpg"])
def test_names_that_mean_no_file_inside_find_none(tmp_path, name):
    (tmp_path / "b.png").touch()
    (tmp_path / "inside").mkdir()
    assert find_inside(tmp_path / "inside", name) is None
    assert find_mask(tmp_path / "inside", name) is None


def test_a_mask_is_found_with_its_folder_before_that_without(tmp_path):
    (tmp_path / "card").mkdir()
    for file in ("card/a.png", "a.png"):
        (tmp_path / file).touch()
    assert find_mask(tmp_path, "card/a.JPG") == tmp_path / "card/a.png"
    assert find_mask(tmp_path, "other/a.JPG") == tmp_path / "a.png"
