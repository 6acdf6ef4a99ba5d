"""How far answers are trusted: by their covariance, the camera, the photo's edges and the search's bounds."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from lodbench.datasets.query import Query
from lodbench.estimation.lens import LensErrors
from lodbench.estimation.model_lines import lines_in_view, project_lines
from lodbench.estimation.photo_edges import PhotoEdges
from lodbench.estimation.probability import probability_within
from lodbench.geometry.camera import CALIBRATED, UNKNOWN, CameraSigmas
from lodbench.geometry.pose import vector_from_pose
from lodbench.methods.assessment import assessed, camera_columns, edge_excess
from lodbench.methods.protocol import Estimate
from tests.methods.flight.test_shared_looks import painted
from tests.town import CAMERA, prior_of

SURE = np.diag([0.05, 0.05, 0.05, 0.02, 0.02, 0.05]) ** 2
# Photos are looked at no wider than 1200 pixels.
WIDE = CAMERA.scaled(960, 720)
PRIOR_SIGMAS = np.array([5.0, 5.0, 15.0, 0.5, 0.5, 4.0])


@pytest.fixture(scope="module")
def photos(city_map, truths, tmp_path_factory):
    """Returns queries with a photo each, whose cameras are calibrated."""
    folder, generator = tmp_path_factory.mktemp("photos"), np.random.default_rng(3)
    found = []
    for number, truth in enumerate(truths):
        path = folder / f"q{number}.png"
        cv2.imwrite(str(path), painted(city_map, truth, 1.0, generator, WIDE))
        found.append(Query(path.name, "all", WIDE, prior_of(truth), image=path))
    return found


@pytest.fixture(scope="module")
def bare(truths):
    """Returns a query without a photo."""
    return Query("q", "all", CAMERA, prior_of(truths[0]))


def answer(pose, covariance=SURE, probability=0.99, **rest):
    return Estimate(pose, 1.0, covariance=covariance, probability=probability, **rest)


def at_answer(city_map, pose, camera=CAMERA):
    lines = lines_in_view(city_map, camera, pose, 4.0)
    lines = lines.of(lines.rises > 0.2)
    return lines, project_lines(lines.points, lines.along, camera, vector_from_pose(pose), LensErrors())


@pytest.mark.parametrize("spread", [0.2, 1.0, 3.0, 10.0])
@pytest.mark.parametrize("is_camera_solved", [True, False])
def test_no_probability_exceeds_what_the_covariance_allows(city_map, bare, truths, spread, is_camera_solved):
    covariance = np.diag([spread, spread, spread, 0.2 * spread, 0.2 * spread, 0.3 * spread]) ** 2
    found = assessed(answer(truths[0], covariance), bare, city_map, None, is_camera_solved)
    vector = vector_from_pose(truths[0])
    # Independent draws: within 2 m, with half of the variance, whatever the angles say.
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(3), 0.5 * covariance[:3, :3], 200_000)
    most = float((np.linalg.norm(drawn, axis=1) < 2.0).mean())
    assert found.probability <= min(0.99, most + 0.02)
    assert found.probability <= probability_within(0.5 * covariance, vector) + 1e-9
    # Nor does it rise: a method that is less sure knows why.
    doubtful = assessed(answer(truths[0], covariance, 0.0005), bare, city_map, None, is_camera_solved)
    assert doubtful.probability == 0.0005
    np.testing.assert_array_equal(found.pose.center, truths[0].center)


def test_an_answer_without_a_probability_or_a_covariance_states_none_afterwards(city_map, bare, truths):
    silent = Estimate(truths[0], 1.0, covariance=SURE)
    assert assessed(silent, bare, city_map) is silent
    found = assessed(answer(truths[0], None, 0.7), bare, city_map)
    assert found.covariance is None
    assert found.probability == 0.7


def test_columns_of_the_camera_are_where_least_squares_ends_with_another_camera(city_map, truths):
    """Gauss-Newton on the same lines, which the solver takes to be seen through another lens."""
    for truth in truths:
        lines, laid = at_answer(city_map, truth)
        columns = camera_columns(laid, lines, PRIOR_SIGMAS)
        weights = lines.lengths_px / (40.0 * 2.0**2)
        start, seen = vector_from_pose(truth), laid.pixels
        for number, size in enumerate((0.002, 0.002, 0.001, 0.001)):
            lens = LensErrors(*(size * np.eye(4)[number]))
            vector = start
            for _ in range(6):
                here = project_lines(lines.points, lines.along, CAMERA, vector, lens)
                off = ((here.pixels - seen) * here.normals).sum(axis=1)
                slopes = here.by_camera[:, :6]
                curvature = (slopes.T * weights) @ slopes + np.diag(PRIOR_SIGMAS**-2.0)
                pull = (slopes.T * weights) @ off + PRIOR_SIGMAS**-2.0 * (vector - start)
                vector = vector - np.linalg.solve(curvature, pull)
            moved = vector - start
            np.testing.assert_allclose(
                size * columns[:, number], moved, atol=0.06 * np.abs(moved).max(), err_msg=str(number)
            )


def test_a_camera_that_is_little_known_costs_probability_and_stands_in_the_covariance(city_map, bare, truths):
    calibrated = assessed(answer(truths[0]), replace(bare, camera_sigmas=CALIBRATED), city_map)
    unsaid = assessed(answer(truths[0]), bare, city_map)
    unknown = assessed(answer(truths[0]), replace(bare, camera_sigmas=UNKNOWN), city_map)
    np.testing.assert_array_equal(calibrated.covariance, SURE)
    assert calibrated.probability == unsaid.probability
    # Even a calibrated one may be of another camera: one in seven.
    assert 0.85 <= calibrated.probability < 0.95
    assert calibrated.notes == ()
    assert unknown.probability < 0.8 * calibrated.probability
    added = unknown.covariance - SURE
    assert np.linalg.eigvalsh(added).min() > -1e-9
    lines, laid = at_answer(city_map, truths[0])
    columns = camera_columns(laid, lines, np.array([10.0, 10.0, 30.0, 1.0, 1.0, 7.5]) / np.sqrt(3.0))
    columns = columns * np.array([0.015, 0.03, 0.007, 0.007])
    np.testing.assert_allclose(added, columns @ columns.T, rtol=1e-6, atol=1e-9)
    (note,) = unknown.notes
    worst = np.linalg.norm(columns[:3], axis=0).max()
    assert f"is {worst:.1f} m here" in note
    # A flight has solved for it.
    solved = assessed(answer(truths[0]), replace(bare, camera_sigmas=UNKNOWN), city_map, None, True)
    np.testing.assert_array_equal(solved.covariance, SURE)
    assert solved.probability == 0.99


def test_what_the_method_has_allowed_for_counts_once(city_map, bare, truths):
    sigmas = CameraSigmas(1.5, 0.0, 0.0, "nominal")
    known = replace(bare, camera_sigmas=sigmas, lens_percent=1.5)
    np.testing.assert_array_equal(assessed(answer(truths[0]), known, city_map).covariance, SURE)
    half = replace(bare, camera_sigmas=sigmas, lens_percent=1.2)
    whole = replace(bare, camera_sigmas=sigmas)
    added = [assessed(answer(truths[0]), query, city_map).covariance - SURE for query in (half, whole)]
    np.testing.assert_allclose(added[0], (0.9 / 1.5) ** 2 * added[1], rtol=1e-6, atol=1e-9)


def test_an_answer_that_the_photos_edges_contradict_is_in_doubt_and_the_true_one_is_not(
    city_map, photos, truths
):
    for query, truth in zip(photos, truths, strict=True):
        right = assessed(answer(truth), query, city_map)
        assert right.probability > 0.8
        assert right.notes == ()
        # Aside of both directions that walls run in: lines moved along themselves stay on their edges.
        for offset in ([3.5, -3.5, 0.0], [-3.0, 3.0, 3.0], [3.0, 3.0, 3.0]):
            wrong = assessed(answer(truth.shifted(offset)), query, city_map)
            assert wrong.probability == 0.45
            assert "poor fit: edges in the photo" in wrong.notes[-1]


def test_lines_on_edges_are_more_than_by_chance_at_the_truth_and_few_lines_say_nothing(
    city_map, photos, truths
):
    picture = PhotoEdges(cv2.imread(str(photos[0].image)), (WIDE.width, WIDE.height))
    lines, laid = at_answer(city_map, truths[0], WIDE)
    assert edge_excess(picture, laid) > 0.4
    noise = np.random.default_rng(0).integers(0, 256, (WIDE.height, WIDE.width, 3), dtype=np.uint8)
    assert abs(edge_excess(PhotoEdges(noise, picture.size), laid)) < 0.1
    blank = np.full(noise.shape, 120, dtype=np.uint8)
    assert edge_excess(PhotoEdges(blank, picture.size), laid) is None
    few = lines.of(np.arange(len(lines)) < 29)
    laid = project_lines(few.points, few.along, WIDE, vector_from_pose(truths[0]), LensErrors())
    assert edge_excess(picture, laid) is None


@pytest.mark.parametrize(("higher_m", "is_at_bound"), [(14.9, True), (-14.9, True), (14.0, False)])
def test_a_height_at_the_bound_of_the_search_is_in_doubt(city_map, bare, truths, higher_m, is_at_bound):
    query = replace(bare, prior=truths[0].shifted([0.0, 0.0, -higher_m]))
    found = assessed(answer(truths[0]), query, city_map, SimpleNamespace(range_z_m=30.0))
    assert (found.probability == 0.45) == is_at_bound
    assert any(f"{higher_m:+.1f} m from the prior" in note for note in found.notes) == is_at_bound
    # A method that states no range has no bound.
    assert assessed(answer(truths[0]), query, city_map).notes == ()
