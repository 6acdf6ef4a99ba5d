"""Roofs and walls apart: labels from files, oracles and networks, and poses by the fit of both."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.citymodel.scene import ROOF, WALL
from lodbench.cli import main
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.inputs import Input, read_classes
from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, DatasetError, QueryFault
from lodbench.evaluation import pose_error
from lodbench.harness import RunSettings, run_method
from lodbench.harness.runs.prepare import Preparation
from lodbench.harness.runs.requirements import require_surfaces
from lodbench.methods.lodlocv2 import LodLocV2, LodLocV2Params
from lodbench.rendering.raster import RasterRenderer
from lodbench.segmentation import ClassSegmenter, check_classes, resized_classes
from lodbench.segmentation.compact import CompactClasses, CompactClassesParams
from lodbench.segmentation.masks import ClassFiles, ClassFilesParams
from lodbench.segmentation.oracle import NoisyOracle, NoisyOracleParams, Oracle, OracleParams
from lodbench.segmentation.registry import chosen_segmenter
from lodbench.synthesis.mask_degradation import mask_iou
from tests.town import CAMERA, write_dataset

NEEDS = frozenset({Input.CLASSES})
METHOD = LodLocV2(LodLocV2Params(fit="semantic_iou", steps=30, coarse_size=(160, 120), fine_size=(320, 240)))


def seen_at(scene, truth) -> np.ndarray:
    """Returns the classes of the surfaces seen, by the normals that the raster draws."""
    layers = RasterRenderer(scene, 1).draw(CAMERA, truth.shifted(-scene.origin))
    return np.where(layers.mask, np.where(np.abs(layers.normal[..., 2]) > 0.3, ROOF, WALL), 0)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """A dataset of two queries with classes of what is seen, and its scene."""
    root, city = write_dataset(tmp_path_factory.mktemp("town"), count=2)
    scene = open_scene(city)
    (root / "classes").mkdir()
    bare = open_folder(FolderParams(str(root), str(city)))
    for entry in bare.entries:
        classes = seen_at(scene, bare.truth[entry.key]).astype(np.uint8)
        assert {ROOF, WALL} <= set(classes.ravel())
        cv2.imwrite(str(root / "classes" / f"{entry.name.rpartition('.')[0]}.png"), classes)
    return open_folder(FolderParams(str(root), str(city))), scene


def test_surfaces_are_told_apart_by_slope(town):
    scene = town[1]
    corners = scene.vertices[scene.triangles]
    rises = np.ptp(corners[..., 2], axis=1)
    assert ((scene.surface_classes() == WALL) == (rises > 0.5)).all()
    sides = np.linalg.norm(np.roll(corners, 1, axis=1) - corners, axis=2).astype(float)
    half = sides.sum(axis=1, keepdims=True) / 2
    heron = np.sqrt(half[:, 0] * (half - sides).prod(axis=1))
    np.testing.assert_allclose(scene.areas_m2(), heron, rtol=1e-3)


def test_class_maps_and_their_fit_go_through_the_map(town):
    dataset, scene = town
    city_map = CityMap(scene, threads=1)
    poses = [dataset.truth[entry.key].shifted(-scene.origin) for entry in dataset.entries]
    rotations = np.array([pose.rotation for pose in poses])
    centers = np.array([pose.center for pose in poses])
    classes = city_map.classes(CAMERA, rotations, centers)
    for entry, drawn in zip(dataset.entries, classes, strict=True):
        np.testing.assert_array_equal(drawn, seen_at(scene, dataset.truth[entry.key]))
    query = Preparation(dataset, scene, ClassFiles(ClassFilesParams()), "prior", NEEDS).query(
        dataset.entries[0]
    )
    from lodbench.methods.search import make_fit

    fit = make_fit("semantic_iou", query, (CAMERA.width, CAMERA.height))
    # Forty poses take two rounds.
    many = city_map.fit(CAMERA, np.repeat(rotations, 20, axis=0), np.repeat(centers, 20, axis=0), fit)
    other = np.mean([mask_iou(classes[0] == k, classes[1] == k) for k in (ROOF, WALL)])
    np.testing.assert_array_equal(many, [1.0] * 20 + [other] * 20)
    assert not city_map.fit(CAMERA, rotations[:0], centers[:0], fit).size


@pytest.mark.parametrize(
    "segmenter", [ClassFiles(ClassFilesParams()), Oracle(OracleParams()), NoisyOracle(NoisyOracleParams())]
)
def test_poses_are_found_by_them(town, tmp_path, segmenter):
    dataset, _ = town
    run = run_method(METHOD, dataset, segmenter, RunSettings(tmp_path, threads=1, tilt="truth"))
    for entry in dataset.entries:
        found = run.predictions[entry.key]
        assert pose_error(found.pose, dataset.truth[entry.key]).translation_m < 2.5


def test_the_noisy_oracles_classes_fill_its_mask(town):
    dataset, scene = town
    entry = dataset.entries[0]
    preparation = Preparation(dataset, scene, NoisyOracle(NoisyOracleParams()), "prior", NEEDS | {Input.MASK})
    query, truth = preparation.query(entry), seen_at(scene, dataset.truth[entry.key])
    assert ((query.classes > 0) == (query.mask > 0)).all()
    assert all(0.3 < mask_iou(query.classes == k, truth == k) < 0.97 for k in (ROOF, WALL))
    with pytest.raises(QueryFault, match="needs the truth"):
        Oracle(OracleParams()).segment_classes(entry)


def test_files_are_chosen_where_they_are(town):
    dataset, _ = town
    assert chosen_segmenter(dataset, NEEDS)[0] == "classes"
    bare = replace(dataset, entries=tuple(replace(e, classes=None) for e in dataset.entries))
    with pytest.raises(DatasetError, match="masks of roofs and walls"):
        chosen_segmenter(bare, NEEDS)
    files = ClassFiles(ClassFilesParams())
    assert files.fingerprint(dataset.entries) != files.fingerprint(bare.entries)
    with pytest.raises(QueryFault, match="no labels in the classes folder"):
        files.segment(bare.entries[0])


def test_a_map_without_walls_is_refused(town):
    scene = town[1]
    flat = replace(scene, vertices=scene.vertices * np.float32([1, 1, 0]))
    require_surfaces(METHOD, scene)
    require_surfaces(LodLocV2(), flat)
    with pytest.raises(DatasetError, match="the map has no walls"):
        require_surfaces(METHOD, flat)


def test_other_values_and_shapes_are_a_fault(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((6, 8), 3, np.uint8))
    with pytest.raises(QueryFault, match=r"classes a\.png hold the value 3"):
        read_classes(tmp_path / "a.png")
    for wrong in (np.zeros((3, 4, 1), np.uint8), np.zeros((3, 4)), np.full((3, 4), 3, np.uint8)):
        with pytest.raises(QueryFault, match="not 0, 1, 2"):
            check_classes(wrong, CAMERA)


def test_the_class_of_most_of_a_pixel_counts():
    classes = np.zeros((8, 8), np.uint8)
    classes[:, :5], classes[4:, 4:7] = ROOF, WALL
    small = resized_classes(classes, 2, 2)
    np.testing.assert_array_equal(small, [[ROOF, 0], [ROOF, WALL]])
    assert resized_classes(classes, 8, 8) is classes


@pytest.mark.slow
def test_a_network_learns_them_from_views_and_its_file_tells_them_apart(tmp_path):
    """Red roofs over blue walls on green ground."""
    pytest.importorskip("torch")
    generator = np.random.default_rng(1)
    for split, count in (("train", 12), ("val", 2)):
        for kind in ("images", "masks", "classes"):
            (tmp_path / "set" / split / kind).mkdir(parents=True)
        for number in range(count):
            picture = generator.integers(0, 60, (64, 96, 3), dtype=np.uint8)
            picture[..., 1] += 100
            top, left = int(generator.integers(4, 20)), int(generator.integers(4, 60))
            classes = np.zeros((64, 96), np.uint8)
            classes[top : top + 20, left : left + 30] = ROOF
            classes[top + 20 : top + 36, left : left + 30] = WALL
            picture[classes == ROOF] = (20, 20, 200)
            picture[classes == WALL] = (200, 40, 40)
            for kind, content in (("images", picture), ("masks", 255 * (classes > 0)), ("classes", classes)):
                cv2.imwrite(str(tmp_path / "set" / split / kind / f"{number}.png"), content)
    words = ["schedule.epochs=6", "schedule.batch=4", "schedule.crop=64", "schedule.val_every=6", "threads=1"]
    out = tmp_path / "out"
    train = ["train", "segmenter=compact_classes", f"data={tmp_path / 'set'}", "init=package"]
    assert main([*train, f"out={out}", *words]) == 0
    segmenter = CompactClasses(CompactClassesParams(size=96, weights=str(out / "compact_classes.onnx")))
    assert isinstance(segmenter, ClassSegmenter)
    photo = tmp_path / "set" / "val" / "images" / "0.png"
    entry = Entry("0.png", "", None, None, photo, None)
    found = segmenter.segment_classes(entry)
    truth = read_classes(tmp_path / "set" / "val" / "classes" / "0.png")
    assert all(mask_iou(found == k, truth == k) > 0.7 for k in (ROOF, WALL))
    np.testing.assert_array_equal(segmenter.segment(entry), found > 0)
    picture = cv2.imread(str(photo))[..., ::-1]
    probability = segmenter.probability(np.ascontiguousarray(picture))
    assert mask_iou(probability > 0.5, truth > 0) > 0.7


def test_a_network_without_weights_says_how_to_get_some():
    segmenter = CompactClasses(CompactClassesParams())
    with pytest.raises(ConfigError, match="comes without weights") as caught:
        segmenter.fingerprint(())
    assert "lodbench train segmenter=compact_classes" in caught.value.hint
