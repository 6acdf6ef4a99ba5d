"""Buildings told apart by map and photo: borders lie where the photo has them, not where the map does."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.inputs import Input
from lodbench.errors import ConfigError, QueryFault
from lodbench.harness.runs.prepare import Preparation
from lodbench.segmentation.choice import chosen_segmenter
from lodbench.segmentation.map_instances import MapInstances, MapInstancesParams, parted
from tests.town import write_dataset


def test_a_border_goes_to_the_photos_edge():
    photo = np.full((80, 160, 3), 90, np.uint8)
    photo[20:60, 30:80], photo[20:60, 80:130] = (200, 90, 80), (90, 90, 160)
    mask = np.zeros((80, 160), bool)
    mask[20:60, 30:130] = True
    seen = np.full((80, 160), -1, np.int32)
    # The map lies five pixels to the right.
    seen[20:60, 35:85], seen[20:60, 85:135] = 41, 7
    labels = parted(photo, mask, seen)
    assert ((labels > 0) == mask).all()
    left, right = np.unique(labels[25:55, 35:77]), np.unique(labels[25:55, 83:125])
    assert len(left) == len(right) == 1
    assert left[0] != right[0]


def test_what_the_map_has_not_is_a_building_of_its_own():
    photo = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (60, 90, 3), np.uint8), (0, 0), 3)
    mask = np.zeros((60, 90), bool)
    mask[10:30, 10:30] = mask[10:30, 50:80] = True
    seen = np.full((60, 90), -1, np.int32)
    seen[10:30, 10:30] = 3
    labels = parted(photo, mask, seen)
    assert sorted(np.unique(labels)) == [0, 1, 2]
    assert len(np.unique(labels[10:30, 50:80])) == 1


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """A query whose photo is light blocks on dark ground, and the scene."""
    root, city = write_dataset(tmp_path_factory.mktemp("town"), count=1)
    (root / "masks").rename(root / "Query_image")
    return open_folder(FolderParams(str(root), str(city))), open_scene(city)


def test_a_run_hands_them_to_who_asks(town):
    dataset, scene = town
    assert chosen_segmenter(dataset, {Input.INSTANCES})[0] == "compact_instances"
    segmenter = MapInstances(MapInstancesParams(size=320))
    segmenter.segment = lambda entry: (cv2.imread(str(entry.image), 0) > 0).astype(np.float32)
    preparation = Preparation(dataset, scene, segmenter, "prior", frozenset({Input.INSTANCES}))
    masks = preparation.query(dataset.entries[0]).instances
    # Those in view, and their masks make up the whole.
    assert 4 <= len(masks) <= 7
    np.testing.assert_array_equal(masks.sum(axis=0), segmenter.segment(dataset.entries[0]))
    assert segmenter.fingerprint(dataset.entries)


def test_nothing_to_see_is_a_fault(town):
    dataset, scene = town
    entry, segmenter = dataset.entries[0], MapInstances(MapInstancesParams(size=320))
    city_map, pose = CityMap(scene, threads=1), dataset.entries[0].prior.shifted(-scene.origin)
    with pytest.raises(QueryFault, match="no photo"):
        segmenter.segment_instances_from(replace(entry, image=None), pose, city_map)
    away = pose.shifted(np.array([0.0, 9000.0, 0.0]))
    with pytest.raises(QueryFault, match="no building of the map"):
        segmenter.segment_instances_from(entry, away, city_map)
    with pytest.raises(ConfigError, match=r"segmenter\.range_m=-1"):
        MapInstancesParams(range_m=-1)
