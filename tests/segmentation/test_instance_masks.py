"""Masks of single buildings: from files, the truth, map and photo; their overlap with the map."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.inputs import (
    Input,
    encoded_labels,
    inputs_of,
    masks_of_labels,
    read_labels,
    with_inputs,
)
from lodbench.errors import ConfigError, QueryFault
from lodbench.harness.runs.queries import Preparation
from lodbench.harness.runs.requirements import required_inputs
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.rendering.raster import RasterRenderer
from lodbench.segmentation.map_guided import MapInstances, MapInstancesParams, parted
from lodbench.segmentation.masks import InstanceFiles, InstanceFilesParams, mapped_overlap
from lodbench.segmentation.oracle import NoisyOracle, NoisyOracleParams, Oracle, OracleParams
from lodbench.segmentation.protocol import chosen_segmenter
from lodbench.synthesis.mask_degradation import mask_iou
from tests.town import CAMERA, write_dataset

BOTH = frozenset({Input.MASK, Input.INSTANCES})


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """A dataset of two queries with labels of the blocks seen, and its scene."""
    root, city = write_dataset(tmp_path_factory.mktemp("town"), count=2)
    scene = open_scene(city)
    (root / "instances").mkdir()
    bare = open_folder(FolderParams(str(root), str(city)))
    for entry in bare.entries:
        seen = seen_at(scene, bare.truth[entry.key])
        (root / "instances" / entry.name).write_bytes(encoded_labels((seen + 1).astype(np.uint16) * 300))
    return open_folder(FolderParams(str(root), str(city))), scene


def seen_at(scene, truth) -> np.ndarray:
    pose = truth.shifted(-scene.origin)
    return RasterRenderer(scene, 1).draw(CAMERA, pose).building


def test_labels_of_an_upright_photo_are_scaled_by_its_longer_side(town, tmp_path):
    path = tmp_path / "tall.png"
    tall = np.zeros((40_000, 30), np.uint16)
    tall[10_000:20_000], tall[30_000:] = 7, 9
    path.write_bytes(encoded_labels(tall))
    entry = replace(town[0].entries[0], instances=path)
    masks = InstanceFiles(InstanceFilesParams()).segment_instances(entry)
    assert masks.shape == (2, 1024, 1)
    np.testing.assert_array_equal(np.flatnonzero(masks[0, :, 0]), np.arange(256, 512))


def test_too_many_masks_are_refused_before_they_take_memory():
    labels = np.arange(2000, dtype=np.uint16).repeat(500).reshape(1000, 1000)
    with pytest.raises(QueryFault, match="1999 masks of 1000 x 1000"):
        masks_of_labels(labels)


def test_files_give_a_mask_of_each_building_and_where_any_is(town):
    dataset, scene = town
    assert Input.INSTANCES in inputs_of(dataset, dataset.entries)
    segmenter = InstanceFiles(InstanceFilesParams())
    for entry in dataset.entries:
        seen = seen_at(scene, dataset.truth[entry.key])
        masks = segmenter.segment_instances(entry)
        np.testing.assert_array_equal(masks, [seen == b for b in np.unique(seen[seen >= 0])])
        np.testing.assert_array_equal(segmenter.segment(entry), seen >= 0)
    assert segmenter.fingerprint(dataset.entries) != segmenter.fingerprint(dataset.entries[:1])
    with pytest.raises(QueryFault, match="no labels in the instances folder"):
        segmenter.segment_instances(replace(dataset.entries[0], instances=None))


def test_a_dataset_makes_them_on_demand_for_who_reads_them(town, tmp_path):
    dataset, _ = town
    bare = tuple(replace(entry, instances=None) for entry in dataset.entries)
    made = tmp_path / dataset.entries[0].split
    made.mkdir()
    (made / "view_01.png").write_bytes(dataset.entries[1].instances.read_bytes())
    asked = replace(dataset, entries=bare, on_demand={Input.INSTANCES: lambda: tmp_path})
    assert Input.INSTANCES in inputs_of(asked, asked.entries)
    method = LodLocV2()
    assert with_inputs(asked, required_inputs(method, Oracle(OracleParams()))) is asked
    found = with_inputs(asked, required_inputs(method, InstanceFiles(InstanceFilesParams())))
    assert [entry.instances for entry in found.entries] == [None, made / "view_01.png"]


def test_they_are_chosen_where_a_method_asks_for_buildings(town):
    assert chosen_segmenter(town[0], {Input.INSTANCES})[0] == "instances"
    assert chosen_segmenter(town[0])[0] == "masks"


def test_large_labels_become_masks_at_most_1024_wide(tmp_path):
    labels = np.zeros((300, 4000), np.uint16)
    labels[100:200, 1000:3000] = 40000
    file = tmp_path / "wide.png"
    file.write_bytes(encoded_labels(labels))
    entry = type("Labelled", (), {"instances": file})()
    (mask,) = InstanceFiles(InstanceFilesParams()).segment_instances(entry)
    assert mask.shape == (77, 1024)
    assert mask.mean() == pytest.approx(1 / 6, abs=0.01)


def written(folder: Path, picture: np.ndarray) -> Path:
    cv2.imwrite(str(folder / "labels.png"), picture)
    return folder / "labels.png"


@pytest.mark.parametrize(
    ("picture", "reason"),
    [
        (np.zeros((8, 8, 3), np.uint8), "not a grey image"),
        (np.arange(64 * 64, dtype=np.uint16).reshape(64, 64), "4095 labels: is it a photo"),
        (None, "not a grey image"),
    ],
)
def test_what_is_no_label_picture_is_a_fault(tmp_path, picture, reason):
    if picture is None:
        (tmp_path / "labels.png").write_bytes(b"no picture")
    file = tmp_path / "labels.png" if picture is None else written(tmp_path, picture)
    with pytest.raises(QueryFault, match=reason):
        read_labels(file)
    with pytest.raises(QueryFault, match="cannot be read"):
        read_labels(tmp_path / "none.png")


def test_the_oracle_shows_what_is_seen_at_the_truth(town):
    dataset, scene = town
    preparation = Preparation(dataset, scene, Oracle(OracleParams()), "prior", BOTH)
    for entry in dataset.entries:
        query = preparation.query(entry)
        seen = seen_at(scene, dataset.truth[entry.key])
        np.testing.assert_array_equal(query.instances, masks_of_labels(seen + 1))
        np.testing.assert_array_equal(query.instances.any(axis=0), query.mask > 0)


def test_the_noisy_oracles_instances_fill_its_mask(town):
    dataset, scene = town
    params = NoisyOracleParams(merged=0.0, split=0.0)
    preparation = Preparation(dataset, scene, NoisyOracle(params), "prior", BOTH)
    query = preparation.query(dataset.entries[0])
    seen = seen_at(scene, dataset.truth[dataset.entries[0].key])
    assert (query.instances.sum(axis=0) == (query.mask > 0)).all()
    assert mask_iou(query.mask > 0, seen >= 0) == pytest.approx(0.88, abs=0.01)
    # Each block is found again, not exactly.
    for building in np.unique(seen[seen >= 0]):
        ious = [mask_iou(mask, seen == building) for mask in query.instances]
        if np.count_nonzero(seen == building) > 500:
            assert 0.5 < max(ious) < 1.0


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
def town_of_map_instances(tmp_path_factory):
    """A query whose photo is light blocks on dark ground, and the scene."""
    root, city = write_dataset(tmp_path_factory.mktemp("town_of_map_instances"), count=1)
    (root / "masks").rename(root / "Query_image")
    return open_folder(FolderParams(str(root), str(city))), open_scene(city)


def test_a_run_hands_them_to_who_asks(town_of_map_instances):
    dataset, scene = town_of_map_instances
    assert chosen_segmenter(dataset, {Input.INSTANCES})[0] == "compact_instances"
    segmenter = MapInstances(MapInstancesParams(size=320))
    segmenter.segment = lambda entry: (cv2.imread(str(entry.image), 0) > 0).astype(np.float32)
    preparation = Preparation(dataset, scene, segmenter, "prior", frozenset({Input.INSTANCES}))
    masks = preparation.query(dataset.entries[0]).instances
    # Those in view, and their masks make up the whole.
    assert 4 <= len(masks) <= 7
    np.testing.assert_array_equal(masks.sum(axis=0), segmenter.segment(dataset.entries[0]))
    assert segmenter.fingerprint(dataset.entries)


def test_nothing_to_see_is_a_fault(town_of_map_instances):
    dataset, scene = town_of_map_instances
    entry, segmenter = dataset.entries[0], MapInstances(MapInstancesParams(size=320))
    city_map, pose = CityMap(scene, threads=1), dataset.entries[0].prior.shifted(-scene.origin)
    with pytest.raises(QueryFault, match="no photo"):
        segmenter.segment_instances_from(replace(entry, image=None), pose, city_map)
    away = pose.shifted(np.array([0.0, 9000.0, 0.0]))
    with pytest.raises(QueryFault, match="no building of the map"):
        segmenter.segment_instances_from(entry, away, city_map)
    with pytest.raises(ConfigError, match=r"segmenter\.range_m=-1"):
        MapInstancesParams(range_m=-1)


def blocks(*corners: tuple[int, int], shape: tuple[int, int] = (300, 400), side: int = 45):
    mask = np.zeros(shape, dtype=bool)
    for row, column in corners:
        mask[row : row + side, column : column + side] = True
    return mask


def test_buildings_far_from_mapped_ones_do_not_count():
    mapped = blocks((30, 30))
    everywhere = blocks((30, 30), (30, 200), (30, 330), (200, 30), (200, 200), (200, 330))
    assert mapped_overlap(mapped, mapped) == 1.0
    assert mapped_overlap(mapped, everywhere) == 1.0
    # IoU would call it a wrong place.
    assert np.count_nonzero(mapped & everywhere) / np.count_nonzero(mapped | everywhere) < 0.2


def test_masks_that_know_nothing_of_the_buildings_have_none():
    mapped, random = blocks((60, 60), (150, 250)), np.random.default_rng(0)
    assert mapped_overlap(mapped, np.ones_like(mapped)) == 0.0
    for share in (0.2, 0.5, 0.8):
        assert mapped_overlap(mapped, random.random(mapped.shape) < share) == pytest.approx(0.0, abs=0.1)
    # Beside it, not on it.
    assert mapped_overlap(mapped, blocks((60, 105), (150, 295))) < 0.0


@pytest.mark.parametrize("shift", [3, 6])
def test_of_masks_that_err_little_it_is_the_iou(shift):
    mapped = blocks((60, 60), (150, 250), side=90)
    mask = np.roll(mapped, shift, axis=1)
    iou = np.count_nonzero(mapped & mask) / np.count_nonzero(mapped | mask)
    assert mapped_overlap(mapped, mask) == pytest.approx(iou, abs=0.02)


def test_a_photo_full_of_mapped_buildings_or_without_any():
    full, none = np.ones((30, 40), dtype=bool), np.zeros((30, 40), dtype=bool)
    assert mapped_overlap(full, full) == 1.0
    assert mapped_overlap(none, full) == 0.0
