"""What photos say, the joint problem against a dense one, what photos share, photos astray, other starts."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, QueryFault
from lodbench.estimation.outline_alignment import Aligner
from lodbench.evaluation import pose_error
from lodbench.geometry.camera import CALIBRATED, MAKER, STATED, UNKNOWN, CameraSigmas
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.flight import FlightMethod, FlightParams, aligning, photo_terms
from lodbench.methods.flight.aligning import align, ends_of, restarted
from lodbench.methods.flight.joint import State, photo_covariance, shared_covariance, solve
from lodbench.methods.flight.photo_terms import LENS, PhotoTerms, RoofParts, flight_terms
from lodbench.methods.flight.relative_poses import placed
from lodbench.methods.protocol import SupportsFlights
from lodbench.storage import random_stream
from lodbench.synthesis.flights import MapErrors, change_map
from tests.town import CAMERA, true_poses


@pytest.mark.parametrize("reach_px", [8.0, None])
def test_points_speak_of_their_own_parts_as_the_dense_problem_has_it(city_map, monkeypatch, reach_px):
    # Subsets that show some of the parts each.
    monkeypatch.setattr(photo_terms, "_MOST_POINTS", 40)
    (query,), (pose,) = flight(city_map, count=1, focal=1.0)
    params, heat = FlightParams().photo().outline_model(), 1.5
    vector, lens = vector_from_pose(pose), np.zeros(LENS)
    aligner, roofs = Aligner(query, city_map, params), RoofParts(20.0, city_map.scene.num_buildings)
    asked = roofs, reach_px, (0.5, heat), None
    (term,) = flight_terms([aligner], vector[None], lens, *asked)
    seen, _, rows = photo_terms._look(aligner, vector, lens, False)
    numbers = roofs.numbers_of(rows, seen.places), roofs.numbers_of(-1 - rows, seen.places)
    _, weights = photo_terms._outline_noise(seen, reach_px)
    subsets = -(-len(rows) // 40)
    used = min(subsets, 1 if reach_px else 4)
    np.testing.assert_array_equal(term.buildings, np.unique(rows))
    count, size = len(term.parts), 6 + LENS + len(term.parts) + 2 * len(term.buildings)
    dense, gradient = np.zeros((size, size)), np.zeros(size)
    for k in range(used):
        chosen = slice(k * subsets // used, None, subsets)
        slopes = seen.slopes[chosen]
        is_roof, is_foot = (number[chosen, None] == term.parts for number in numbers)
        heights = is_roof * slopes[:, 7, None] + is_foot * slopes[:, 8, None]
        # A building that stands further east is a camera further west.
        is_building = rows[chosen, None] == term.buildings
        places = -(is_building[..., None] * slopes[:, None, :2]).reshape(len(slopes), -1)
        jacobian = np.hstack([slopes[:, :6], slopes[:, 9 : 9 + LENS], heights, places])
        lengths_px = params.outline_px, params.roof_part_px
        lower = photo_terms._covariance(seen, chosen, (term.noise_px, weights), lengths_px, 0.5, 0.0)
        covariance = np.tril(lower) + np.tril(lower, -1).T
        weighted = np.linalg.solve(covariance, jacobian).T / (used * heat)
        dense += weighted @ jacobian
        gradient += weighted @ seen.distances[chosen]
    assert jacobian.shape[1] == 6 + LENS + count + 2 * len(term.buildings)
    np.testing.assert_allclose(term.information, dense, rtol=1e-6, atol=1e-9 * np.abs(dense).max())
    np.testing.assert_allclose(term.gradient, gradient, rtol=1e-6, atol=1e-9 * np.abs(gradient).max())


def test_errors_of_a_building_s_place_go_together_in_one_view_and_not_with_others(city_map):
    (query,), (pose,) = flight(city_map, count=1, focal=1.0)
    params, vector = FlightParams().photo().outline_model(), vector_from_pose(pose)
    seen, _, _ = photo_terms._look(Aligner(query, city_map, params), vector, np.zeros(LENS), False)
    noise, chosen = (1.0, np.ones(len(seen.distances))), slice(0, None, 7)
    lengths_px = params.outline_px, params.roof_part_px
    without, with_places = (
        np.tril(photo_terms._covariance(seen, chosen, noise, lengths_px, 0.5, place_m))
        for place_m in (0.0, 0.3)
    )
    moves, building = seen.slopes[chosen, :2], seen.buildings[chosen]
    expected = 0.09 * (moves @ moves.T) * (building[:, None] == building)
    np.testing.assert_allclose(with_places - without, np.tril(expected), atol=1e-9)
    assert len(np.unique(building)) > 2


SHARED = np.array([4.0, -5.0, 12.0, 0.6, -0.5, 3.0])
FOCAL = 1.015


def flight(city_map, count=6, focal=FOCAL, seed=1):
    """Returns the queries and true poses of a flight whose gimbal, GPS and focal length are off."""
    generator = np.random.default_rng(seed)
    poses = list(true_poses(count).values())
    true_camera = replace(CAMERA, fx=CAMERA.fx * focal, fy=CAMERA.fy * focal)
    queries = []
    for k, pose in enumerate(poses):
        own = generator.uniform(-1, 1, 6) * [1.5, 1.5, 1.5, 0.2, 0.2, 1.5]
        prior = pose_from_vector(vector_from_pose(pose) - SHARED - own)
        mask = city_map.render(true_camera, pose).astype(np.float32)
        queries.append(Query(f"q{k}", "all", CAMERA, prior, mask, sequence="one"))
    return queries, poses


def localize(queries, city_map, params=None):
    streams = [partial(random_stream, 0, query.name) for query in queries]
    return FlightMethod(params).localize_flight(queries, city_map, streams)


@pytest.fixture(scope="module")
def found(city_map):
    queries, poses = flight(city_map)
    return localize(queries, city_map), poses


@pytest.mark.parametrize("is_tied", [True, False])
@pytest.mark.parametrize("single", ["contour_alignment", "region"])
def test_priors_that_scatter_against_a_block_leave_what_they_share_open(single, is_tied):
    generator = np.random.default_rng(2)
    poses = list(true_poses(8).values())
    vectors = np.array([vector_from_pose(pose) for pose in poses])
    priors = vectors + generator.normal(size=(8, 6)) * [6.0, 6.0, 17.0, 0.6, 0.6, 4.0]
    params = FlightParams(single=single)
    block = placed(dict(enumerate(poses)), vectors, params.reconstruction_information()) if is_tied else None
    state = State(vectors, priors, RoofParts(20.0, 0), np.zeros(0), np.ones(8), reconstruction=block)
    known = FlightMethod(params)._params_of(state)
    solution = solve(state, [None] * 8, known)
    sigma_m = float(np.sqrt(shared_covariance(solution, np.array([2]))[0, 0]))
    if not is_tied:
        assert known == params
        return
    # The flight's error is the mean of independent ones.
    assert 8.0 < known.own_sigmas()[2] < 34.0
    assert sigma_m > 0.6 * 17.0 / np.sqrt(8)


@pytest.mark.slow
def test_a_flight_is_found_with_a_focal_length_and_a_gimbal_that_are_off(found):
    answer, poses = found
    errors = [pose_error(each.pose, pose) for each, pose in zip(answer.estimates, poses, strict=True)]
    assert max(error.translation_m for error in errors) < 0.7
    assert all(each.probability > 0.8 for each in answer.estimates)


def test_each_photo_is_found_with_the_lens_as_told(city_map):
    """However badly that is known: how far off it is all photos tell together."""
    queries, _ = flight(city_map, count=2)
    unsure = [replace(query, lens_percent=3.0) for query in queries]
    streams = [partial(random_stream, 0, "test")] * 2
    told, same = (FlightMethod().localize_alone(each, city_map, streams) for each in (queries, unsure))
    for first, second in zip(told, same, strict=True):
        np.testing.assert_array_equal(first.pose.center, second.pose.center)
        np.testing.assert_array_equal(first.covariance, second.covariance)


@pytest.mark.slow
def test_what_photos_share_is_told_with_its_sigma(found):
    constants = found[0].findings["constants"]
    for name, value, tolerance in (
        ("pitch", SHARED[3], 0.2),
        ("height", SHARED[2], 1.2),
        ("focal length", FOCAL - 1.0, 0.004),
    ):
        told = constants[name]
        assert told["determined"]
        assert told["value"] == pytest.approx(value, abs=tolerance), name
        assert abs(told["value"] - value) < 4.0 * told["sigma"] + 0.1
    assert found[0].findings["lost"] == []


@pytest.mark.slow
def test_a_photo_that_shows_something_else_is_placed_by_the_others(city_map):
    queries, poses = flight(city_map, focal=1.0)
    elsewhere = np.zeros((240, 320), dtype=np.float32)
    elsewhere[:60, :60] = 1.0
    queries[2] = replace(queries[2], building_probability=elsewhere)
    answer = localize(queries, city_map)
    assert answer.findings["lost"] == ["q2"]
    error = pose_error(answer.estimates[2].pose, poses[2])
    # No better than sensors are, but not led astray by its own mask, and it knows.
    assert error.translation_m < 4.0
    assert answer.estimates[2].probability < min(answer.estimates[k].probability for k in (0, 1, 3, 4, 5))


@pytest.mark.slow
def test_a_height_that_the_map_has_wrong_is_measured_but_not_in_doubt_from_one_side(scene):
    errors = MapErrors(heights=0.15)
    wrong, changed = change_map(scene, errors, np.random.default_rng(3))
    queries, _ = flight(CityMap(scene, threads=1), count=8, focal=1.0)
    buildings = localize(queries, CityMap(wrong, threads=1)).findings["buildings"]
    (name, higher_m) = next(iter(changed["heights"].items()))
    told = next(building for building in buildings if building["id"] == name)
    assert told["higher_m"] == pytest.approx(-higher_m, abs=1.0)
    # Its photos look from directions nine degrees apart.
    assert told["apart_deg"] < 20.0
    assert not any(building["doubt"] for building in buildings)


def test_a_flight_of_one_photo_and_one_without_any_building(city_map):
    (query,), (pose,) = flight(city_map, count=1, focal=1.0)
    streams = partial(random_stream, 0, "one")
    assert isinstance(FlightMethod(), SupportsFlights)
    assert pose_error(FlightMethod().localize(query, city_map, streams).pose, pose).translation_m < 3.0
    empty = replace(query, building_probability=np.zeros((240, 320), dtype=np.float32))
    with pytest.raises(QueryFault, match="no building"):
        FlightMethod().localize(empty, city_map, streams)


@pytest.mark.parametrize("wrong", [{"own_m": -1.0}, {"focal": float("inf")}, {"steps": 0}, {"heat": 0.0}])
def test_parameters_out_of_range_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        FlightParams(**wrong)


def random_problem(generator, photos=4):
    """Returns a state and terms with random curvatures over six parts of three buildings."""
    params = FlightParams()
    roofs = RoofParts(10.0, 8)
    places = np.array([[5.0, 5.0], [15.0, 5.0]])
    for building in range(3):
        roofs.numbers_of(np.full(2, building), places)
    roofs.heights_m = generator.normal(size=6)
    state = State(
        vectors=generator.normal(size=(photos, 6)),
        priors=generator.normal(size=(photos, 6)),
        roofs=roofs,
        buildings_m=generator.normal(size=3),
        weights=np.array([1.0, 1.0, 0.0, 1.0])[:photos],
    )
    state.constants = generator.normal(size=len(state.constants)) * 0.1
    terms = []
    for _ in range(photos):
        parts = np.sort(generator.choice(6, 3, replace=False))
        buildings = np.unique(roofs.building[parts])
        size = 6 + LENS + 3 + 2 * len(buildings)
        root = generator.normal(size=(size, size))
        gradient = generator.normal(size=size)
        terms.append(PhotoTerms(root @ root.T, gradient, parts, buildings, 0.5, 0.5, 1.0, 100))
    return state, terms, params


def dense_solution(state, terms, params):
    """Returns the problem's curvature inverted, its step, and how all moves with the buildings' places.

    Photos come first, then what they share.
    """
    photos = len(terms)
    constants, buildings, parts = len(state.constants), 3, 6
    size = 6 * photos + constants + buildings + parts
    matrix, gradient = np.zeros((size, size)), np.zeros(size)
    base, pulls = 6 * photos, np.zeros((size, 2 * buildings))
    own = np.diag(params.own_sigmas() ** -2.0)
    for k, term in enumerate(terms):
        pose, offset = np.arange(6 * k, 6 * k + 6), np.arange(base, base + 6)
        rows = np.concatenate(
            [pose, np.arange(base + 6, base + 6 + LENS), base + constants + buildings + term.parts]
        )
        known = slice(0, len(rows))
        matrix[np.ix_(rows, rows)] += state.weights[k] * term.information[known, known]
        gradient[rows] += state.weights[k] * term.gradient[known]
        for number, building in enumerate(term.buildings):
            places = len(rows) + 2 * number + np.arange(2)
            mixed = state.weights[k] * term.information[known, places]
            pulls[np.ix_(rows, 2 * building + np.arange(2))] += mixed
        tie = np.zeros((6, size))
        tie[np.arange(6), pose], tie[np.arange(6), offset] = 1.0, -1.0
        gap = state.vectors[k] - state.priors[k] - state.offset
        matrix += tie.T @ own @ tie
        gradient += tie.T @ own @ gap
    sigmas = params.constant_sigmas()
    shared = np.arange(base, base + constants)
    matrix[shared, shared] += sigmas**-2.0
    gradient[shared] += state.constants * sigmas**-2.0
    roofs = base + 6 + LENS
    ties = [
        (base + constants + b, roofs, state.buildings_m[b] - state.constants[6 + LENS], params.roof_m)
        for b in range(3)
    ]
    for p in range(parts):
        b = int(state.roofs.building[p])
        gap = state.roofs.heights_m[p] - state.buildings_m[b]
        ties.append((base + constants + buildings + p, base + constants + b, gap, params.part_m))
    for one, other, gap, sigma in ties:
        row = np.zeros(size)
        row[one], row[other] = 1.0, -1.0
        # Student's t with one degree of freedom, as a weight.
        precision = 2.0 / (1.0 + (gap / sigma) ** 2) / sigma**2
        matrix += precision * np.outer(row, row)
        gradient += precision * row * gap
    inverse = np.linalg.inv(matrix)
    return inverse, -inverse @ gradient, -inverse @ pulls


@pytest.mark.parametrize("seed", range(3))
def test_eliminating_photos_gives_what_the_dense_problem_does(seed):
    state, terms, params = random_problem(np.random.default_rng(seed))
    inverse, step, by_places = dense_solution(state, terms, params)
    solution = solve(state, terms, params)
    poses = step[:24].reshape(4, 6)
    longest = np.array([6.0, 6.0, 10.0, 2.0, 2.0, 4.0])
    limited = poses / np.maximum(1.0, np.abs(poses / longest).max(axis=1))[:, None]
    np.testing.assert_allclose(solution.photo_steps, limited, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(solution.shared_step, step[24:], rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(solution.moved_by_places(), by_places, rtol=1e-6, atol=1e-8)
    for k in range(4):
        np.testing.assert_allclose(
            photo_covariance(solution, k),
            inverse[6 * k : 6 * k + 6, 6 * k : 6 * k + 6],
            rtol=1e-6,
            atol=1e-10,
        )


def test_parts_keep_their_numbers():
    roofs = RoofParts(10.0, 8)
    first = roofs.numbers_of(np.array([4, 4, 4]), np.array([[1.0, 1.0], [11.0, 1.0], [2.0, 3.0]]))
    assert first[0] == first[2] != first[1]
    roofs.heights_m[:] = [2.0, 4.0]
    again = roofs.numbers_of(np.array([4, 4, 7]), np.array([[11.0, 1.0], [-1.0, 1.0], [1.0, 1.0]]))
    assert again[0] == first[1]
    # A new part is as high as its building's others; another building starts at the map's height.
    assert roofs.heights_m[again[1]] == 3.0
    assert roofs.heights_m[again[2]] == 0.0
    assert len(roofs) == 4


def test_a_camera_less_known_than_usual_widens_what_is_solved_for():
    edges = FlightParams(single="region")
    found = edges.with_cameras([MAKER, UNKNOWN, None])
    assert found.focal == 0.01 * UNKNOWN.focal_percent > edges.focal
    assert found.distortion == UNKNOWN.k1 > edges.distortion
    assert found.center == 0.01 * UNKNOWN.center_percent


def test_calibrations_and_makers_numbers_narrow_nothing():
    for cameras in ([], [None], [CALIBRATED], [CALIBRATED, MAKER]):
        found = FlightParams().with_cameras(cameras)
        assert (found.focal, found.distortion) == (FlightParams().focal, FlightParams().distortion)


def test_what_a_person_states_is_taken_as_it_is():
    found = FlightParams(single="region").with_cameras([CameraSigmas(0.1, 0.2, 0.001, STATED)])
    assert (found.focal, found.distortion, found.center) == (0.001, 0.001, 0.002)


def test_what_a_person_leaves_out_is_as_usual():
    found = FlightParams(single="region").with_cameras([CameraSigmas(3.0, 0.0, 0.0, STATED)])
    assert (found.focal, found.distortion) == (0.03, FlightParams().distortion)


def test_masks_hold_the_principal_point():
    assert FlightParams().with_cameras([UNKNOWN]).center == 0.0


def test_photos_from_all_over_a_long_flight_start_again():
    spread, middle = restarted(500, tied=False), restarted(500, tied=True)
    assert len(spread) == len(middle) == 40
    assert (spread[0], spread[-1]) == (0, 499)
    assert set(np.diff(middle)) == {1}
    assert middle[0] == 230
    for tied in (False, True):
        np.testing.assert_array_equal(restarted(7, tied), np.arange(7))


def test_ends_that_fit_worse_are_left_out():
    here, there = np.zeros((3, 6)), np.full((3, 6), 0.5)
    kept = ends_of([(here, np.zeros(11), 0.9), (there, np.ones(11), 0.89)])
    assert kept.middle[0] == pytest.approx(np.full(6, 0.25))
    alone = ends_of([(here, np.zeros(11), 0.9), (there, np.ones(11), 0.87)])
    assert alone.middle[0] == pytest.approx(np.zeros(6))
    assert not alone.covariances[0].any()


@pytest.mark.slow
def test_what_some_photos_of_a_long_flight_err_by_moves_not_all_of_it(city_map, monkeypatch):
    queries, _ = flight(city_map, count=6, focal=1.0)

    def some_end_aside(these, *rest):
        found = align(these, *rest)
        if len(these) < len(queries):
            found.state.vectors = found.state.vectors + np.array([0.7, -0.4, 0.0, 0.0, 0.0, 0.0])
        return found

    def places(restarts):
        params = FlightParams(restarts=restarts, steps=3)
        return np.array([found.pose.center for found in localize(queries, city_map, params).estimates])

    alone = places(0)
    monkeypatch.setattr("lodbench.methods.flight.aligning._MOST_PHOTOS", 3)
    undisturbed = places(1)
    monkeypatch.setattr(aligning, "align", some_end_aside)
    assert places(1) == pytest.approx(undisturbed, abs=1e-9)
    assert np.abs(undisturbed - alone).max() < 0.1
