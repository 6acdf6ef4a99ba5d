"""Points on the lines of a model, where a view and a camera that errs show them, and how they move."""

from dataclasses import astuple

import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.estimation.edge_alignment import NUM_POSE_AND_LENS as COLUMNS
from lodbench.estimation.edge_alignment import (
    LensErrors,
    lines_in_view,
    project,
    project_lines,
    projection_slopes,
    relative_heights,
)
from lodbench.geometry import Camera
from lodbench.geometry.pose import vector_from_pose
from tests.town import BOXES, CAMERA, box_obj, true_poses

ERRORS = LensErrors(focal=0.02, k1=-0.06, right=0.01, down=-0.02)
POINTS = np.random.default_rng(0).uniform([-20, -15, 30], [20, 15, 90], (40, 3))


def test_without_errors_it_is_the_pinhole():
    np.testing.assert_allclose(project(POINTS, CAMERA), CAMERA.project(POINTS), rtol=1e-12)


def test_errors_are_those_of_the_camera_model():
    pinhole = ERRORS.pinhole(CAMERA)
    sizes = pinhole.width, pinhole.height
    bent = Camera(*sizes, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, (ERRORS.k1, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(project(POINTS, CAMERA, ERRORS), bent.project(POINTS), rtol=1e-12)


def test_any_shape_of_points_will_do():
    grid = POINTS.reshape(4, 10, 3)
    np.testing.assert_array_equal(
        project(grid, CAMERA, ERRORS).reshape(-1, 2), project(POINTS, CAMERA, ERRORS)
    )


@pytest.mark.parametrize("errors", [LensErrors(), ERRORS])
def test_slopes_are_those_of_finite_differences(errors):
    numbers = np.array([0.0, 0.0, 0.0, errors.focal, errors.k1, errors.right, errors.down])

    def pixels(moved):
        return project(POINTS + moved[:3], CAMERA, LensErrors(*moved[3:]))

    steps = 1e-6 * np.eye(7)
    expected = np.stack([(pixels(numbers + s) - pixels(numbers - s)) / 2e-6 for s in steps], axis=2)
    slopes = projection_slopes(POINTS, CAMERA, errors)
    np.testing.assert_allclose(slopes, expected, rtol=1e-5, atol=1e-5)


LENS = LensErrors(0.02, 0.04, -0.01, 0.006)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("town") / "city.obj"
    # Beside the boxes one outline without any height.
    path.write_text(box_obj([*BOXES, (75, 20, 90, 40, 2, 2)]))
    return open_scene(path)


@pytest.fixture(scope="module")
def city_map(scene):
    return CityMap(scene, threads=1)


@pytest.fixture(scope="module")
def pose():
    return next(iter(true_poses(1).values()))


@pytest.fixture(scope="module")
def lines(city_map, pose):
    return lines_in_view(city_map, CAMERA, pose, 4.0)


@pytest.mark.parametrize("lens", [LensErrors(), LENS])
def test_slopes_are_differences_along_the_normals(lines, pose, lens):
    vector, numbers = vector_from_pose(pose), np.array(astuple(lens))
    laid = project_lines(lines.points, lines.along, CAMERA, vector, lens)
    assert laid.by_camera.shape == (len(lines), COLUMNS)

    def moved(step, place=(0.0, 0.0, 0.0)):
        errors = LensErrors(*(numbers + step[6:]))
        points = lines.points + np.array(place)
        return project_lines(points, lines.along, CAMERA, vector + step[:6], errors).pixels

    def slope(size, **change):
        away = moved(size * change["step"], size * change["place"])
        back = moved(-size * change["step"], -size * change["place"])
        return ((away - back) * laid.normals).sum(axis=1) / (2.0 * size)

    for number, step in enumerate(np.eye(COLUMNS)):
        expected = slope(1e-5, step=step, place=np.zeros(3))
        scale = np.abs(expected).max()
        np.testing.assert_allclose(laid.by_camera[:, number], expected, atol=1e-5 * scale)
    for axis, place in enumerate(np.eye(3)):
        expected = slope(1e-4, step=np.zeros(COLUMNS), place=place)
        np.testing.assert_allclose(laid.by_place[:, axis], expected, atol=1e-6)


def test_a_lens_without_distortion_is_the_camera_it_is_drawn_with(lines, pose):
    lens = LensErrors(focal=0.03, right=0.01, down=-0.02)
    laid = project_lines(lines.points, lines.along, CAMERA, vector_from_pose(pose), lens)
    away = (lines.points - pose.center) @ pose.rotation.T
    np.testing.assert_allclose(laid.pixels, lens.pinhole(CAMERA).project(away))


def test_points_lie_evenly_on_lines_that_the_view_shows(lines, city_map, scene, pose):
    (view,) = city_map.edges(CAMERA, pose.rotation[None], pose.center[None], 25.0)
    lengths = np.linalg.norm(view.pixels[:, 1] - view.pixels[:, 0], axis=1)
    shown = view.is_visible & (lengths > 6.0)
    # All of the lines' length is spoken for, by building and by whether something ends there.
    for kind in (True, False):
        mine = shown & ((view.kind == 1) == kind)
        expected = np.bincount(view.building[mine], lengths[mine], scene.num_buildings)
        of_kind = lines.is_contour == kind
        found = np.bincount(lines.buildings[of_kind], lines.lengths_px[of_kind], scene.num_buildings)
        np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert lines.lengths_px.min() >= 4.0
    assert lines.lengths_px.max() < 8.0
    # Neighbours on a line are as far apart as each stands for, up to perspective.
    laid = project_lines(lines.points, lines.along, CAMERA, vector_from_pose(pose), LensErrors())
    together = np.flatnonzero(np.diff(lines.lines) == 0)
    apart = np.linalg.norm(laid.pixels[together + 1] - laid.pixels[together], axis=1)
    assert np.abs(apart / lines.lengths_px[together] - 1.0).max() < 0.3
    # A normal is across its line.
    steps = laid.pixels[together + 1] - laid.pixels[together]
    assert np.abs((steps * laid.normals[together]).sum(axis=1)).max() < 1e-3
    some = lines.of(lines.relative_heights > 0.5)
    assert 0 < len(some) == np.count_nonzero(lines.relative_heights > 0.5)


def test_points_rise_by_their_share_of_the_height_and_flat_outlines_with_the_roof(scene):
    boxes = [*BOXES, (75, 20, 90, 40, 2, 2)]
    low, high = np.array([box[4:] for box in boxes], dtype=np.float64).T
    buildings = np.repeat(np.arange(len(boxes)), 4)
    shares = np.tile([-0.2, 0.0, 0.25, 1.0], len(boxes))
    heights = low[buildings] + shares * (high - low)[buildings]
    expected = np.where((high > low)[buildings], np.clip(shares, 0.0, 1.0), 1.0)
    np.testing.assert_allclose(relative_heights(scene, heights, buildings), expected, atol=1e-6)


def test_lines_far_away_are_none(city_map, pose):
    assert len(lines_in_view(city_map, CAMERA, pose.shifted([5000.0, 0.0, 0.0]), 4.0)) == 0
