import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.errors import DatasetError
from lodbench.rendering.reference import ReferenceRenderer
from lodbench.segmentation.masks import read_mask
from lodbench.storage import file_digest
from lodbench.synthesis.training_data.generate import generate_training_data
from tests.synthesis.conftest import SMALL


def files_in(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.slow
def test_the_folder_opens_as_a_dataset_whose_masks_are_those_of_its_poses(small_set, box_file):
    params, made = small_set
    dataset = open_folder(FolderParams(params.out, str(box_file)))
    assert dataset.splits == ("train",)
    assert len(dataset.entries) == made.views["train"] > 3
    reference = ReferenceRenderer(open_scene(box_file))
    for entry in dataset.entries:
        expected = reference.render(entry.camera, dataset.truth[entry.key])
        np.testing.assert_array_equal(read_mask(entry.mask) > 0.5, expected)
        assert expected.mean() >= params.min_buildings
        assert cv2.imread(str(entry.image)).shape == (80, 96, 3)


def test_labels_and_depth_belong_to_the_masks(small_set):
    _, made = small_set
    for path in sorted((made.out / "train" / "masks").iterdir()):
        mask = read_mask(path) > 0.5
        labels = cv2.imread(str(made.out / "train" / "labels" / path.name), cv2.IMREAD_UNCHANGED)
        classes = cv2.imread(str(made.out / "train" / "classes" / path.name), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(classes > 0, labels > 0)
        assert set(classes.ravel()) <= {0, 1, 2}
        depth = cv2.imread(str(made.out / "train" / "depth" / path.name), cv2.IMREAD_UNCHANGED)
        assert labels.dtype == depth.dtype == np.uint16
        np.testing.assert_array_equal(labels > 0, mask)
        assert labels.max() <= 7
        # Cameras are 90 m above the ground; the highest building is 40 m.
        assert depth[depth > 0].min() > 3500


def test_masks_are_bilevel(small_set):
    _, made = small_set
    content = next((made.out / "train" / "masks").iterdir()).read_bytes()
    assert content[24] == 1  # IHDR: bit depth
    assert content[25] == 0  # grey


@pytest.mark.slow
def test_two_processes_write_the_same_bytes(small_set, tmp_path):
    params, made = small_set
    again = generate_training_data(replace(params, out=str(tmp_path / "data"), workers=2))
    assert files_in(again.out) == files_in(made.out)


def test_another_seed_gives_other_pictures_of_the_same_poses(small_set, tmp_path):
    params, made = small_set
    other = files_in(generate_training_data(replace(params, out=str(tmp_path / "data"), seed=1)).out)
    same = files_in(made.out)
    assert other["train/poses.txt"] == same["train/poses.txt"]
    assert all(other[name] != same[name] for name in same if "/images/" in name)


def test_the_manifest_says_what_it_was_made_of(small_set, box_file):
    _, made = small_set
    manifest = json.loads((made.out / "manifest.json").read_text())
    assert manifest["inputs"] == {"city": {"city.obj": file_digest(box_file)}}
    assert manifest["settings"]["pitch"] == SMALL["pitch"]
    assert manifest["views"] == made.views
    assert manifest["state"] == "finished"
    assert manifest["source"] == {}
    assert manifest["candidates"] == sum(made.views.values()) + sum(made.skipped.values())


def test_what_is_missing_is_made_again_and_nothing_else(small_set, tmp_path):
    params, made = small_set
    before = files_in(made.out)
    victims = sorted((made.out / "train" / "images").iterdir())
    victims[1].unlink()
    victims[2].write_bytes(b"")  # as a power cut may leave it
    again = generate_training_data(params)
    assert again.resumed == sum(made.views.values()) - 2
    assert files_in(made.out) == before


def test_a_folder_of_another_set_is_left_alone(small_set):
    params, made = small_set
    before = files_in(made.out)
    with pytest.raises(DatasetError, match="seed is 0 there"):
        generate_training_data(replace(params, seed=5))
    assert files_in(made.out) == before
