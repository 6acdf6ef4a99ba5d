"""Roofs and walls apart: labels from files, oracles and networks, and poses by the fit of both."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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
from lodbench.harness.runs.queries import Preparation
from lodbench.harness.runs.requirements import require_surfaces
from lodbench.methods.lodlocv2 import LodLocV2, LodLocV2Params
from lodbench.rendering.raster import RasterRenderer
from lodbench.segmentation import ClassSegmenter, binary_mask, check_classes, resized_classes
from lodbench.segmentation.masks import ClassFiles, ClassFilesParams, MaskFiles, MasksParams, read_mask
from lodbench.segmentation.oracle import NoisyOracle, NoisyOracleParams, Oracle, OracleParams
from lodbench.segmentation.packaged import CompactClasses, CompactClassesParams
from lodbench.segmentation.protocol import chosen_segmenter
from lodbench.synthesis.mask_degradation import mask_iou
from tests.town import CAMERA, write_dataset


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


def test_surfaces_are_separated_by_slope(town):
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
    from lodbench.methods.fits import make_fit

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
