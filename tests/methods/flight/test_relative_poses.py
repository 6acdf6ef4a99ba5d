"""Relative poses: slopes against differences, two views from points, reconstructions up to a similarity."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lodbench.datasets.query import Query
from lodbench.errors import ConfigError
from lodbench.evaluation import pose_error
from lodbench.geometry import Camera, Pose
from lodbench.geometry.pose import pose_from_vector, rotation_derivatives
from lodbench.methods.flight import FlightMethod, FlightParams
from lodbench.methods.flight.joint import State, solve
from lodbench.methods.flight.photo_terms import RoofParts
from lodbench.methods.flight.relative_poses import (
    RelativePose,
    placed,
    relative_poses,
    rotation_vector,
    tangents,
    two_view,
    width_looked_at,
)
from lodbench.storage import random_stream
from tests.methods.flight.test_joint import flight

VECTORS = np.array(
    [
        [0.0, 0.0, 90.0, 30.0, 0.5, 10.0],
        [20.0, 5.0, 92.0, 33.0, -0.4, 22.0],
        [41.0, 2.0, 88.0, 28.0, 0.2, 35.0],
    ]
)


def slopes_by_differences(residuals, vectors, photos, rest):
    """Returns the change of residuals per unit of some photos' numbers, then of further ones."""
    columns = []
    for photo in photos:
        for number in range(6):
            moved = vectors.copy()
            moved[photo, number] += 1e-5
            columns.append((residuals(moved, np.zeros(rest)) - residuals(vectors, np.zeros(rest))) / 1e-5)
    for number in range(rest):
        step = np.zeros(rest)
        step[number] = 1e-6
        columns.append((residuals(vectors, step) - residuals(vectors, np.zeros(rest))) / 1e-6)
    return np.stack(columns, axis=1)


def true_tie(vectors, first=0, second=1):
    here, there = (pose_from_vector(vectors[k]) for k in (first, second))
    direction = there.rotation @ (here.center - there.center)
    direction /= np.linalg.norm(direction)
    return RelativePose(
        first, second, there.rotation @ here.rotation.T, direction, np.eye(5), np.arange(5) * 0.1
    )


def test_slopes_of_a_pair_are_its_differences():
    tie = true_tie(VECTORS)
    near = VECTORS + np.random.default_rng(0).normal(scale=0.05, size=VECTORS.shape)

    def residuals(vectors, focal):
        return tie.linearize(vectors, [rotation_derivatives(v) for v in vectors], float(focal[0]))[0]

    derivatives = [rotation_derivatives(v) for v in near]
    at_truth, _ = tie.linearize(VECTORS, [rotation_derivatives(v) for v in VECTORS], 0.0)
    np.testing.assert_allclose(at_truth, 0.0, atol=1e-12)
    expected = slopes_by_differences(residuals, near, (0, 1), 1)
    np.testing.assert_allclose(tie.linearize(near, derivatives, 0.0)[1], expected, atol=2e-4)


def test_slopes_of_a_reconstruction_are_its_differences():
    poses = {k: pose_from_vector(v) for k, v in enumerate(VECTORS)}
    found = placed(poses, VECTORS, np.eye(6))
    near = VECTORS + np.random.default_rng(1).normal(scale=0.02, size=VECTORS.shape)

    def residuals(vectors, step):
        return found.moved(step).linearize(1, vectors, [rotation_derivatives(v) for v in vectors])[0]

    expected = slopes_by_differences(residuals, near, (1,), 10)
    _, jacobian = found.linearize(1, near, [rotation_derivatives(v) for v in near])
    np.testing.assert_allclose(jacobian, expected, atol=2e-3)


def similar(pose):
    """Returns a pose in the frame of a reconstruction."""
    turn = Rotation.from_rotvec([0.3, -0.8, 1.1]).as_matrix()
    return Pose.from_center(pose.rotation @ turn.T, 0.037 * turn @ pose.center + [5.0, -2.0, 9.0])


def test_a_reconstruction_is_placed_where_photos_are_but_for_one_that_is_not():
    poses = {k: similar(pose_from_vector(v)) for k, v in enumerate(VECTORS)}
    found = placed(poses, VECTORS, np.eye(6))
    for photo, vector in enumerate(VECTORS):
        error = pose_error(found.poses[photo], pose_from_vector(vector))
        assert error.translation_m < 1e-6
        assert error.rotation_deg < 1e-6
    assert placed({0: poses[0], 1: poses[1]}, VECTORS, np.eye(6)) is None


@pytest.mark.parametrize("known", [0, 2])
def test_photos_of_which_a_reconstruction_has_too_few_are_solved_without_it(known):
    # Of a long flight those in its middle start again: the reconstruction may end before them.
    poses = {k: similar(pose_from_vector(v)) for k, v in enumerate(VECTORS)}
    vectors = np.concatenate([VECTORS, VECTORS + 50.0])
    state = State(vectors, vectors, RoofParts(20.0, 1), np.zeros(1), np.ones(6))
    state.reconstruction = placed(poses, vectors, np.eye(6))
    part = state.begun(np.arange(3 - known, 6 - known), np.ones(6))
    assert part.reconstruction is None
    assert np.isfinite(solve(part, [None] * 3, FlightParams()).photo_steps).all()


def test_places_and_turns_of_a_reconstruction_have_shares_of_their_own():
    generator = np.random.default_rng(3)
    angles = np.radians(np.arange(0, 360, 18.0))
    around, level = 90.0 * np.array([np.cos(angles), np.sin(angles)]), np.full((20, 3), [80.0, 40.0, 0.0])
    vectors = np.column_stack([*around, level, np.degrees(angles) + 90.0])
    poses = {}
    for k, vector in enumerate(vectors):
        pose = similar(pose_from_vector(vector))
        turn = Rotation.from_rotvec(np.radians(generator.normal(0, 0.05, 3))).as_matrix()
        poses[k] = Pose.from_center(turn @ pose.rotation, pose.center)
    # Sensors are right to centimetres: how far the reconstruction errs is there to be seen.
    params = FlightParams(own_m=0.02, own_tilt_deg=0.002, own_yaw_deg=0.002)
    state = State(vectors, vectors, RoofParts(20.0, 0), np.zeros(0), np.ones(20))
    state.reconstruction = placed(poses, vectors, params.reconstruction_information())
    for _ in range(12):
        solution = solve(state, [None] * len(vectors), params)
        state.scales = solution.scales()
        state.step(solution)
    of_places, of_turns = state.scales[3:5]
    assert of_places < 0.2
    assert 0.7 < of_turns <= 1.0


@pytest.mark.parametrize(("photos", "width"), [(0, 2048), (20, 2048), (100, 2048), (200, 1448), (2000, 1024)])
def test_many_photos_are_looked_at_less_closely_each(photos, width):
    assert width_looked_at(photos) == width


def test_two_views_are_what_their_points_say():
    generator = np.random.default_rng(3)
    here, there = (pose_from_vector(v) for v in VECTORS[:2])
    # Ground and roofs, with some points that match by mistake.
    points = np.column_stack(
        [
            generator.uniform(-40, 60, 300),
            generator.uniform(20, 120, 300),
            generator.choice([0.0, 8.0, 15.0], 300),
        ]
    )
    rays = [(points - pose.center) @ pose.rotation.T for pose in (here, there)]
    first, second = ((ray / ray[:, 2:])[:, :2] + generator.normal(0, 0.3 / 900, (300, 2)) for ray in rays)
    second[:40] += generator.normal(0, 0.1, (40, 2))
    tie = true_tie(VECTORS)
    rotation, direction, information, per_focal, agrees = two_view(first, second, 900.0, tie.rotation)
    assert agrees.shape == (300,)
    assert agrees[40:].mean() > 0.95
    assert agrees[:40].mean() < 0.2
    error = np.concatenate([rotation_vector(rotation @ tie.rotation.T), tangents(tie.direction) @ direction])
    assert np.degrees(np.abs(error)).max() < 0.4
    assert (error @ information @ error) / 5 < 6.0
    # A lens 1 % longer than told: the same points at other rays.
    longer = two_view(first * 1.01, second * 1.01, 900.0, tie.rotation)
    told_short = np.concatenate([rotation_vector(rotation @ longer[0].T), tangents(longer[1]) @ direction])
    np.testing.assert_allclose(0.01 * per_focal, told_short, atol=0.3 * np.abs(told_short).max())
    assert two_view(first[:10], second[:10], 900.0, tie.rotation) is None
    # Turned another way than sensors could be wrong about.
    assert (
        two_view(first, second, 900.0, Rotation.from_rotvec([0, 0, 1.0]).as_matrix() @ tie.rotation) is None
    )


def drawn(pose, camera, texture):
    """Returns a view of a ground and of blocks with the same texture, a fifth of a metre a pixel."""
    kinds = {0.0: np.full(texture.shape[:2], 255, np.uint8), 15.0: np.zeros(texture.shape[:2], np.uint8)}
    for x, y in ((150, 100), (400, 300), (150, 500), (500, 600), (300, 200)):
        kinds[15.0][y : y + 80, x : x + 80] = 255
    lens = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    view = np.zeros((camera.height, camera.width, 3), np.uint8)
    for height, kept in kinds.items():
        place = np.array([[0.2, 0, -60], [0, 0.2, -20], [0, 0, 1]])
        above = np.outer(np.array([0.0, 0.0, height]) - pose.center, [0, 0, 1])
        matrix = lens @ pose.rotation @ (np.diag([1.0, 1.0, 0.0]) + above) @ place
        size = camera.width, camera.height
        is_here = cv2.warpPerspective(kept, matrix, size) > 127
        view[is_here] = cv2.warpPerspective(texture, matrix, size)[is_here]
    return view


@pytest.mark.parametrize("has_moved", [True, False])
def test_text_burned_into_both_photos_says_no_turn_and_photos_from_one_place_are_tied(tmp_path, has_moved):
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    noise = np.random.default_rng(0).integers(0, 256, (900, 900, 3), dtype=np.uint8)
    texture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 4.0), None, 0, 255, cv2.NORM_MINMAX)
    vectors, queries = VECTORS[:2] if has_moved else VECTORS[[0, 0]], []
    for k, vector in enumerate(vectors):
        view = drawn(pose_from_vector(vector), camera, texture)
        for line in range(9):
            words = f"{line} 2023-10-18 H 120.3m Survey Ltd"
            place, font = (10, 470 - 28 * line), cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(view, words, place, font, 1.0, (255, 255, 255), 2)
        view = cv2.add(view, np.random.default_rng(k).integers(0, 8, view.shape, dtype=np.uint8))
        cv2.imwrite(str(tmp_path / f"{k}.png"), view)
        pose = pose_from_vector(vector)
        queries.append(Query(f"{k}.png", "all", camera, pose, image=tmp_path / f"{k}.png"))
    (tie,), (shared,) = relative_poses(queries, vectors)
    assert (shared.first, shared.second) == (0, 1)
    # Rays are those of its pixels, and all but a few move where the camera did.
    back = shared.rays * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    np.testing.assert_allclose(back, shared.pixels, atol=1e-3)
    moves = np.linalg.norm(shared.pixels[0] - shared.pixels[1], axis=1)
    assert (np.median(moves) > 2.0) == has_moved
    truth = pose_from_vector(vectors[1]).rotation @ pose_from_vector(vectors[0]).rotation.T
    assert np.degrees(np.linalg.norm(rotation_vector(tie.rotation @ truth.T))) < 0.5


@pytest.mark.slow
def test_photos_tied_by_a_reconstruction_are_found_better_even_one_whose_mask_is_wrong(city_map):
    queries, poses = flight(city_map, count=6)
    tied = []
    for k, (query, pose) in enumerate(zip(queries, poses, strict=True)):
        rough = np.asarray(query.building_probability).copy()
        rough[:, : 40 + 20 * (k % 3)] = 0.0
        tied.append(replace(query, building_probability=rough, reconstructed=similar(pose)))
    tied[3] = replace(tied[3], building_probability=np.roll(tied[3].building_probability, 90, axis=1))
    streams = [partial(random_stream, 0, query.name) for query in tied]
    errors = {}
    for kind in ("none", "auto"):
        found = (
            FlightMethod(FlightParams(relative_poses=kind)).localize_flight(tied, city_map, streams).estimates
        )
        errors[kind] = [pose_error(f.pose, p).translation_m for f, p in zip(found, poses, strict=True)]
    assert np.max(errors["auto"]) < 0.7
    assert np.median(errors["auto"]) < np.median(errors["none"])


@pytest.mark.slow
def test_a_reconstruction_whose_cameras_all_lean_alike_places_photos_no_worse(city_map):
    # A focal length that a reconstruction has wrong tips all its cameras about their own axes.
    tip = Rotation.from_rotvec([np.radians(0.5), 0.0, 0.0]).as_matrix()
    queries, poses = flight(city_map, count=6)
    errors_deg = {}
    for mount_deg in (0.4, 1e-3):
        tied = []
        for query, pose in zip(queries, poses, strict=True):
            there = similar(pose)
            leaning = Pose.from_center(tip @ there.rotation, there.center)
            tied.append(replace(query, reconstructed=leaning))
        streams = [partial(random_stream, 0, query.name) for query in tied]
        method = FlightMethod(FlightParams(reconstruction_mount_deg=mount_deg))
        found = method.localize_flight(tied, city_map, streams).estimates
        errors_deg[mount_deg] = np.median(
            [pose_error(f.pose, p).rotation_deg for f, p in zip(found, poses, strict=True)]
        )
    assert errors_deg[0.4] < 0.2
    assert errors_deg[0.4] < errors_deg[1e-3]


def test_a_reconstruction_that_is_asked_for_and_not_there_is_refused(city_map):
    queries, _ = flight(city_map, count=4)
    with pytest.raises(ConfigError, match="0 of 4 photos of the flight of q0 are in a reconstruction"):
        FlightMethod(FlightParams(relative_poses="reconstruction")).localize_flight(queries, city_map, [])


def test_kinds_of_relative_poses_are_told():
    with pytest.raises(ConfigError, match="relative_poses=colmap"):
        FlightParams(relative_poses="colmap")
