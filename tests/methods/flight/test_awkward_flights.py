"""Flights that leave something open, and photos that do not belong: said, and the rest is solved."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymap.city_map import corrected_map
from lodbench.datasets.query import Query
from lodbench.errors import RenderingError
from lodbench.evaluation import pose_error
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.flight import FlightParams, aligning
from lodbench.methods.flight.photo_terms import flight_terms
from lodbench.synthesis.flights import MapErrors, change_map
from tests.methods.flight.test_joint import flight, localize
from tests.town import CAMERA

pytestmark = pytest.mark.nightly


def errors_m(answer, poses):
    return [
        pose_error(each.pose, pose).translation_m for each, pose in zip(answer.estimates, poses, strict=True)
    ]


def straight_down(city_map, pitch_deg, focal=1.0, count=6):
    """Returns the queries and true poses of a strip that looks down, or ahead."""
    generator = np.random.default_rng(0)
    shared, queries, poses = np.array([3.0, -2.0, 8.0, 0.4, -0.3, 2.0]), [], []
    lens = replace(CAMERA, fx=CAMERA.fx * focal, fy=CAMERA.fy * focal)
    for k in range(count):
        vector = np.array(
            [-20.0 + 8 * k, 5.0 * (k % 2) - (70 if pitch_deg else 0), 90.0, pitch_deg, 0.0, 0.0]
        )
        pose = pose_from_vector(vector + generator.normal(0, [0.5, 0.5, 0.5, 0.3, 0.3, 1.0]))
        mask = city_map.render(lens, pose).astype(np.float32)
        queries.append(Query(f"q{k}", "all", CAMERA, pose_from_vector(vector_from_pose(pose) - shared), mask))
        poses.append(pose)
    return queries, poses


def test_a_flight_that_looks_straight_down_leaves_the_focal_length_as_stated(city_map):
    queries, poses = straight_down(city_map, 0.0)
    answer = localize(queries, city_map)
    assert "cannot be separated" in answer.findings["notes"][0]
    assert "focal length" not in answer.findings["constants"]
    assert max(errors_m(answer, poses)) < 1.0


def test_a_flight_that_looks_ahead_tells_the_focal_length(city_map):
    queries, _ = straight_down(city_map, 40.0, focal=1.02)
    findings = localize(queries, city_map).findings
    assert "notes" not in findings
    assert findings["constants"]["focal length"]["value"] == pytest.approx(0.02, abs=0.005)


def test_a_clock_that_jumps_loses_one_photo_and_no_other(city_map):
    queries, poses = flight(city_map, focal=1.0)
    # The position of half a minute later, at 10 m/s.
    late = queries[4].prior.shifted([180.0, -240.0, 0.0])
    queries[4] = replace(queries[4], prior=late)
    answer = localize(queries, city_map)
    assert answer.findings["lost"] == ["q4"]
    assert "the other photos" in answer.findings["reasons"]["q4"]
    assert answer.estimates[4].probability < 0.5
    assert max(errors_m(answer, poses)[k] for k in (0, 1, 2, 3, 5)) < 1.0


def test_photos_of_one_wall_are_as_sure_as_one_wall_makes_them(city_map):
    queries, poses = flight(city_map, focal=1.0)
    walls = []
    for query in queries:
        mask = np.zeros((240, 320), dtype=np.float32)
        mask[:, 160:] = 1.0
        walls.append(replace(query, building_probability=mask))
    answer = localize(walls, city_map)
    assert len(answer.estimates) == len(poses)
    assert max(each.probability for each in answer.estimates) < 0.5


def test_the_map_is_drawn_as_high_as_photos_say(city_map):
    scene = city_map.scene
    heights = np.zeros(scene.num_buildings)
    heights[[0, 1, 2]] = 3.0, 0.2, -40.0
    drawn, changed = corrected_map(city_map, heights)
    rows = [slice(scene.vertex_starts[b], scene.vertex_starts[b + 1]) for b in range(3)]
    before, after = ([s.vertices[row, 2] for row in rows] for s in (scene, drawn.scene))
    assert after[0].max() == pytest.approx(before[0].max() + 3.0)
    assert after[0].min() == before[0].min()
    # Too little to be drawn again; and no building is lower than two metres.
    assert changed[1] == 0.0
    assert np.ptp(after[2]) == pytest.approx(2.0)
    assert drawn.usage is city_map.usage
    assert isinstance(drawn, CityMap)
    assert corrected_map(city_map, np.zeros(scene.num_buildings))[0] is city_map


def test_what_photos_share_may_be_held(city_map):
    queries, _ = flight(city_map, focal=1.0)
    held = localize(queries, city_map, FlightParams(focal=0.0, distortion=0.0, mask_px=0.0)).findings[
        "constants"
    ]
    assert not {"focal length", "radial distortion k1", "masks too large by"} & set(held)


def test_one_thread_draws_where_it_is_asked_to(city_map, monkeypatch):
    # A context of OpenGL belongs to the thread that opened it.
    alone, drawn_by = CityMap(city_map.scene, threads=1), set()
    render = alone.scorer.render

    def noting(camera, pose):
        drawn_by.add(threading.get_ident())
        return render(camera, pose)

    monkeypatch.setattr(alone.scorer, "render", noting)
    queries, _ = flight(city_map, count=3, focal=1.0)
    localize(queries, alone, FlightParams(restarts=0))
    assert drawn_by == {threading.get_ident()}


def test_roofs_that_were_drawn_higher_are_measured_from_where_they_are_drawn(scene, monkeypatch):
    # A focal length that is held has all photos aligned once more, from the first heights on.
    low, _ = change_map(scene, MapErrors(heights=0.4), np.random.default_rng(0))
    queries, _ = straight_down(CityMap(scene), 0.0)
    seen = []

    def noting(aligners, vectors, lens, roofs, *rest):
        drawn = aligners[0].city_map.scene.vertices
        seen.append((bool((drawn != low.vertices).any()), bool(roofs.drawn_m.any())))
        return flight_terms(aligners, vectors, lens, roofs, *rest)

    monkeypatch.setattr(aligning, "flight_terms", noting)
    answer = localize(queries, CityMap(low), FlightParams(restarts=0))
    assert "cannot be separated" in answer.findings["notes"][0]
    assert (True, True) in seen
    assert all(changed == told for changed, told in seen)


@pytest.mark.nightly
def test_a_flight_is_drawn_by_opengl(city_map):
    try:
        drawn = CityMap(city_map.scene, "pyrender")
        drawn.render(CAMERA, pose_from_vector(np.array([0.0, 0.0, 90.0, 0.0, 0.0, 0.0])))
    except RenderingError as error:
        pytest.skip(f"no pyrender here: {error}")
    queries, poses = flight(city_map, count=3, focal=1.0)
    answer = localize(queries, drawn, FlightParams(restarts=0, steps=4))
    assert max(errors_m(answer, poses)) < 1.5


def test_a_flight_over_few_buildings_is_as_unsure_as_their_footprints(city_map):
    queries, _ = flight(city_map, count=3, focal=1.0)
    sigmas = {}
    for footprint_m in (0.0, 1.0):
        params = FlightParams(restarts=0, steps=4, footprint_m=footprint_m)
        found = localize(queries, city_map, params)
        east = found.findings["constants"]["east"]["sigma"]
        sigmas[footprint_m] = np.sqrt(found.estimates[0].covariance[0, 0]), east
        assert found.estimates[0].covariance[2, 2] < 4.0
    # Seven buildings, some seen more than others: between one and seven alike.
    added = np.sqrt(np.array(sigmas[1.0]) ** 2 - np.array(sigmas[0.0]) ** 2)
    assert (added > 1.0 / np.sqrt(7.0) - 1e-6).all()
    assert (added < 0.6).all()
    assert added[0] == pytest.approx(added[1])


def test_threads_change_nothing(city_map):
    queries, _ = flight(city_map, count=4, focal=1.0)
    found = [
        localize(
            queries, CityMap(city_map.scene, threads=threads), FlightParams(restarts=1, steps=4)
        ).estimates
        for threads in (1, 3)
    ]
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one.pose.cam_from_world, other.pose.cam_from_world)
        np.testing.assert_array_equal(one.covariance, other.covariance)
        assert one.probability == other.probability
