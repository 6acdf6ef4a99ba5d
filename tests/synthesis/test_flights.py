"""`dataset=flights`: seeded flights, the errors their photos share, maps made wrong on purpose."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.citymodel.cache import open_cached_city
from lodbench.datasets.exchange.colmap import write_colmap
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.pose_text import FoundPose
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, DatasetError
from lodbench.evaluation import pose_error
from lodbench.geometry.pose import pose_from_vector, rotation_derivatives, vector_from_pose
from lodbench.methods.flight.relative_poses import placed, relative_poses
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.segmentation.masks import read_mask
from lodbench.synthesis.camera_paths import FLIGHT_PATHS
from lodbench.synthesis.flights import (
    MAP_TRUTH_FILE,
    FlightsParams,
    MapErrors,
    SensorErrors,
    _silhouette,
    change_map,
    drone_errors,
    open_flights,
)
from lodbench.synthesis.mask_degradation import mask_iou
from lodbench.synthesis.views import FINE_SIZE, RGB_CAMERA
from tests.town import box_obj


@pytest.fixture(scope="module")
def city(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("town") / "city.obj"
    path.write_text(box_obj())
    return path


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch) -> None:
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path_factory.getbasetemp() / "flights-cache"))


def params(city, **more) -> FlightsParams:
    return FlightsParams(str(city), **{"num_flights": 2, "num_photos": 4, "path": "orbit", **more})


def test_photos_share_a_flight_s_errors_and_have_their_own(city):
    dataset = open_flights(params(city))
    assert [entry.sequence for entry in dataset.entries] == ["flight_00"] * 4 + ["flight_01"] * 4
    means = []
    for flight in ("flight_00", "flight_01"):
        entries = [entry for entry in dataset.entries if entry.sequence == flight]
        errors = np.array(
            [
                [
                    *(e.prior.center - dataset.truth[e.key].center),
                    *np.subtract(e.prior.euler, dataset.truth[e.key].euler),
                ]
                for e in entries
            ]
        )
        errors[:, 3:] = (errors[:, 3:] + 180.0) % 360.0 - 180.0
        # Twice the own half width is the widest that two photos of one flight can differ by.
        assert (np.ptp(errors, axis=0) <= 2.0 * np.array([2, 2, 2, 0.3, 0.3, 2.5]) + 1e-6).all()
        assert (np.abs(errors) <= np.array([10, 10, 30, 1.1, 1.1, 7.5]) + 1e-6).all()
        means.append(errors.mean(axis=0))
    assert np.abs(means[0] - means[1])[:3].max() > 2.0


def test_more_flights_keep_the_first_ones(city):
    few, more = open_flights(params(city, num_flights=1)), open_flights(params(city))
    for one, same in zip(few.entries, more.entries, strict=False):
        assert one.name == same.name
        np.testing.assert_array_equal(one.prior.center, same.prior.center)
        np.testing.assert_array_equal(read_mask(one.mask), read_mask(same.mask))


@pytest.mark.parametrize("path", sorted(FLIGHT_PATHS))
def test_paths_go_on_and_look_at_the_place(path):
    target = np.array([10.0, -5.0, 2.0])
    poses = list(FLIGHT_PATHS[path](target, np.random.default_rng(0), 20))
    assert len(poses) >= 40
    middle = poses[len(poses) // 2 - 10 : len(poses) // 2 + 10]
    steps = np.linalg.norm(np.diff([pose.center for pose in middle], axis=0), axis=1)
    assert np.median(steps) < 60.0
    # Each camera looks down, to within a photo's width of the place for some.
    assert all(pose.rotation[2, 2] < 0 for pose in poses)
    hits = [pose.center + pose.rotation[2] * (pose.center[2] - 2.0) / -pose.rotation[2, 2] for pose in middle]
    assert min(np.linalg.norm(hit[:2] - target[:2]) for hit in hits) < 60.0


def test_a_map_made_wrong_says_how(city):
    scene = open_scene(city)
    wrong, changed = change_map(scene, MapErrors(0.3, 0.15, 0.15), np.random.default_rng(5))
    assert len(changed["heights"]) == 2
    (gone,) = changed["missing"]
    assert gone in scene.building_ids
    assert gone not in wrong.building_ids
    (extra,) = changed["extra"]
    assert extra not in scene.building_ids
    assert extra in wrong.building_ids
    for name, higher_m in changed["heights"].items():
        tops = []
        for each in (scene, wrong):
            row = each.building_ids.index(name)
            part = each.vertices[each.vertex_starts[row] : each.vertex_starts[row + 1], 2]
            tops.append((part.min(), part.max()))
        assert tops[0][0] == tops[1][0]
        assert tops[1][1] - tops[0][1] == pytest.approx(higher_m, abs=1e-4)
        assert 1.5 <= abs(higher_m) <= 5.0


def test_the_map_to_localise_on_is_the_wrong_one_and_masks_are_of_the_right_one(city):
    dataset = open_flights(params(city, wrong_heights=0.3, mask_iou=1.0, num_flights=1))
    assert json.loads((dataset.root / MAP_TRUTH_FILE).read_text())["heights"]
    right, wrong = open_scene(city), open_cached_city(dataset.city_model, lod=dataset.lod).scene
    camera = RGB_CAMERA.scaled(*FINE_SIZE)
    for entry in dataset.entries:
        truth, mask = dataset.truth[entry.key].shifted(-right.origin), read_mask(entry.mask) >= 0.5
        assert mask_iou(SilhouetteRenderer(right).render(camera, truth), mask) == 1.0
        assert mask_iou(SilhouetteRenderer(wrong).render(camera, truth), mask) < 1.0


def test_flights_over_a_wrong_map_are_found_again_by_that_map(city):
    dataset = open_flights(params(city, wrong_heights=0.3, num_flights=1))
    again = open_flights(params(dataset.city_model, wrong_heights=0.3, num_flights=1))
    assert again.root == dataset.root
    assert again.city_model == dataset.city_model


def test_a_distorted_silhouette_is_what_opencv_draws(city):
    scene = open_scene(city)
    renderer = SilhouetteRenderer(scene)
    camera = RGB_CAMERA.scaled(301, 224)
    pose = next(iter(FLIGHT_PATHS["orbit"](np.zeros(3), np.random.default_rng(1), 4)))
    bent = _silhouette(renderer, camera, pose, -0.25)
    # Points of roofs, projected by OpenCV with the same lens, are building wherever they are seen.
    row = scene.vertices[scene.vertices[:, 2] > 5.0].astype(np.float64)
    inner = row * 0.999 + row.mean(axis=0) * 0.001
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    seen, _ = cv2.projectPoints(inner, pose.rotation, pose.translation, matrix, np.array([-0.25, 0, 0, 0]))
    u, v = np.floor(seen[:, 0]).astype(int).T
    within = (u > 1) & (u < camera.width - 2) & (v > 1) & (v < camera.height - 2)
    assert within.sum() > 4
    near = cv2.dilate(bent.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert near[v[within], u[within]].all()
    assert mask_iou(bent, renderer.render(camera, pose)) < 1.0


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"path": "spiral"}, "dataset.path=spiral"),
        ({"num_photos": 0}, "num_photos"),
        ({"mask_iou": 0.0}, "mask_iou"),
        ({"focal": 0.5}, "focal"),
        ({"reconstruct": True}, "dataset.look=plain"),
        ({"look": "plain", "distortion": 0.1}, "without distortion"),
        ({"missing": 0.9}, "dataset.missing=0.9 is not"),
        ({"missing": 0.5, "extra": 0.5, "wrong_heights": 0.1}, "more than all there are"),
        ({"own_m": -1.0}, "dataset.own_m=-1 is not at least 0"),
        ({"shared_yaw_deg": float("nan")}, "dataset.shared_yaw_deg=nan is not finite"),
    ],
)
def test_settings_out_of_range_are_refused(city, wrong, told):
    with pytest.raises(ConfigError) as caught:
        params(city, **wrong)
    assert told in f"{caught.value.message} {caught.value.hint}"


@pytest.mark.slow
def test_a_city_that_is_not_there_and_one_without_room(city, tmp_path):
    with pytest.raises(DatasetError, match="does not exist"):
        open_flights(FlightsParams(str(tmp_path / "no.obj")))
    with pytest.raises(DatasetError, match="No facade flight"):
        open_flights(params(city, path="facade", num_photos=60))


@pytest.mark.slow
def test_photos_of_a_flight_show_the_same_place_from_where_they_were_taken(city):
    dataset = open_flights(params(city, look="plain", num_flights=1, num_photos=6, focal=0.02))
    assert all(entry.image.suffix == ".jpg" and entry.camera.width == 1204 for entry in dataset.entries)
    truth = np.array([vector_from_pose(dataset.truth[entry.key]) for entry in dataset.entries])
    queries = [Query(e.name, e.split, e.camera, e.prior, image=e.image) for e in dataset.entries]
    ties, _ = relative_poses(queries, truth)
    assert len(ties) >= 3
    focal = drone_errors(params(city, focal=0.02), 0).focal - 1.0
    derivatives = [rotation_derivatives(vector) for vector in truth]
    away = np.array([tie.linearize(truth, derivatives, focal)[0] for tie in ties])
    # Features agree with the true poses; with the focal length as told they agree less.
    assert np.degrees(np.median(np.abs(away[:, :3]))) < 0.1
    short = np.array([tie.linearize(truth, derivatives, 0.0)[0] for tie in ties])
    assert np.median(np.abs(short[:, :3])) > np.median(np.abs(away[:, :3]))
    # Without the photos, masks are the same.
    plain = open_flights(params(city, num_flights=1, num_photos=6, focal=0.02))
    for one, same in zip(plain.entries, dataset.entries, strict=True):
        np.testing.assert_array_equal(read_mask(one.mask), read_mask(same.mask))


def test_a_reconstruction_in_the_folder_is_read(city, tmp_path):
    dataset = open_flights(params(city))
    root = tmp_path / "own"
    shutil.copytree(dataset.root / "flights", root / "all")
    flight = [entry for entry in dataset.entries if entry.sequence == "flight_01"]
    found = [FoundPose(e.name, "", dataset.truth[e.key], e.camera) for e in flight[:3]]
    write_colmap(found, root / "all" / "reconstruction" / "flight_01")
    entries = open_folder(FolderParams(str(root), str(city))).entries
    known = {entry.name: entry.reconstructed for entry in entries if entry.reconstructed is not None}
    assert sorted(known) == sorted(each.name for each in found)
    np.testing.assert_allclose(known[found[0].name].center, found[0].pose.center, atol=1e-6)


@pytest.mark.nightly
def test_colmap_s_reconstruction_is_the_truth_but_for_a_similarity(city):
    pytest.importorskip("pycolmap")
    dataset = open_flights(params(city, look="plain", num_flights=1, num_photos=8, reconstruct=True))
    known = {k: e.reconstructed for k, e in enumerate(dataset.entries) if e.reconstructed is not None}
    assert len(known) >= 6
    truth = np.array([vector_from_pose(dataset.truth[entry.key]) for entry in dataset.entries])
    moved = placed(known, truth, np.eye(6))
    for photo, pose in moved.poses.items():
        error = pose_error(pose, pose_from_vector(truth[photo]))
        assert error.translation_m < 1.0
        assert error.rotation_deg < 0.3


def test_sensor_errors_stay_within_their_widths():
    widths = SensorErrors(3.0, 20.0, 0.5, 4.0)
    drawn = np.array([widths.draw(np.random.default_rng(k)) for k in range(200)])
    limits = np.array([3, 3, 20, 0.5, 0.5, 4])
    assert (np.abs(drawn) <= limits).all()
    assert (np.abs(drawn).max(axis=0) > 0.9 * limits).all()
    assert (replace(widths, height_m=0.0).draw(np.random.default_rng(0))[2]) == 0.0
