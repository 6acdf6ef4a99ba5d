"""Masks of single buildings: from files, and from the truth, exact and as wrong as a network's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.inputs import Input, inputs_of, with_inputs
from lodbench.datasets.instance_labels import encoded_labels, masks_of_labels, read_labels
from lodbench.errors import QueryFault
from lodbench.harness.runs.prepare import Preparation
from lodbench.harness.runs.requirements import required_inputs
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.rendering.raster import RasterRenderer
from lodbench.segmentation.choice import chosen_segmenter
from lodbench.segmentation.instance_files import InstanceFiles, InstanceFilesParams
from lodbench.segmentation.oracle import NoisyOracle, NoisyOracleParams, Oracle, OracleParams
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
