"""A lens that is not as told: photos over an exact map say so, and by how much."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from lodbench.datasets.query import Query
from lodbench.estimation.state_vector import views_of
from lodbench.evaluation import pose_error
from lodbench.geometry.pose import vector_from_pose
from lodbench.methods.contour_alignment import ContourAlignment
from lodbench.methods.region import Region, RegionParams
from lodbench.methods.region.evidence import PhotoFit, PosePosterior
from lodbench.rendering import IouFit
from lodbench.storage import random_stream
from tests.methods.test_region_lines import shaded_photo
from tests.town import CAMERA, prior_of, true_poses

FAST = RegionParams(fine_width=200, starts=4, modes=2)
# Few pixels do not tell a longer lens from a lower flight.
WIDE = CAMERA.scaled(960, 720)


def lengthened(camera, percent):
    return replace(camera, fx=camera.fx * (1 + 0.01 * percent), fy=camera.fy * (1 + 0.01 * percent))


@pytest.mark.parametrize("percent", [-4.0, 0.0, 2.5])
def test_another_lens_is_drawn_by_the_told_one(city_map, truths, percent):
    for truth in truths:
        vector = np.append(vector_from_pose(truth), percent)[None]
        of_longer = IouFit(city_map.render(lengthened(CAMERA, percent), truth))
        np.testing.assert_allclose(city_map.fit(CAMERA, *views_of(vector), of_longer), 1.0, atol=2e-3)


def test_a_pose_is_a_camera_with_the_lens_as_told(city_map, queries, truths, shaded_photos):
    params = RegionParams()
    evidence = PosePosterior(
        queries[0], city_map, PhotoFit(shaded_photos[0], (200, 150), params, False), params
    )
    poses = vector_from_pose(truths[0]) + random_stream(0, "poses").normal(0.0, 0.5, (5, 6))
    cameras = np.column_stack([poses, np.zeros(5)])
    np.testing.assert_array_equal(evidence.fits(poses), evidence.fits(cameras))
    assert (evidence.fits(np.column_stack([poses, np.full(5, 3.0)])) != evidence.fits(poses)).all()


@pytest.fixture(scope="module")
def shaded_photos(city_map, truths):
    return [shaded_photo(city_map, truth, number) for number, truth in enumerate(truths)]


def errors_of(city_map, folder, percent, params):
    """Returns the errors in place, metres, of photos whose lens is longer than told, and all notes."""
    errors, notes = [], []
    for number, truth in enumerate(true_poses(3).values()):
        path, lens = folder / f"{number}.png", lengthened(WIDE, percent)
        cv2.imwrite(str(path), shaded_photo(city_map, truth, number, lens))
        query = Query(path.name, "all", WIDE, prior_of(truth), None, path)
        estimate = Region(params).localize(query, city_map, partial(random_stream, 0, "test"))
        errors.append(pose_error(estimate.pose, truth).translation_m)
        notes.extend(estimate.notes)
    return np.array(errors), notes


@pytest.mark.slow
def test_a_longer_lens_is_found_and_told(city_map, tmp_path):
    """4 % are five metres of height, which whoever believes what is told makes up for."""
    believing, _ = errors_of(city_map, tmp_path, 4.0, replace(FAST, lens_doubt_percent=0.0))
    doubting, notes = errors_of(
        city_map, tmp_path, 4.0, replace(FAST, lens_doubt_percent=4.0, doubt_nats=1.0)
    )
    assert np.median(believing) > 3.0
    assert np.median(doubting) < 0.7 * np.median(believing)
    assert any("focal length" in note and "longer" in note for note in notes)


@pytest.mark.parametrize("method", [Region(FAST), ContourAlignment()], ids=["pixels", "mask"])
def test_a_focal_length_known_badly_leaves_the_height_open(
    city_map, queries, shaded_photos, tmp_path, method
):
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), shaded_photos[0])
    known = replace(queries[0], image=path)
    sigmas, probabilities = [], []
    for percent in (None, 0.1, 3.0):
        query = replace(known, lens_percent=percent)
        estimate = method.localize(query, city_map, partial(random_stream, 0, "test"))
        sigmas.append(np.sqrt(np.diagonal(estimate.covariance)))
        probabilities.append(estimate.probability)
    np.testing.assert_array_equal(sigmas[0], sigmas[1])
    assert sigmas[2][2] > 1.5 * sigmas[0][2]
    assert probabilities[2] < probabilities[0] == probabilities[1]


@pytest.mark.slow
def test_a_lens_as_told_is_left_alone(city_map, tmp_path):
    errors, notes = errors_of(city_map, tmp_path, 0.0, FAST)
    assert not any("focal length" in note for note in notes)
    assert np.median(errors) < 1.0
