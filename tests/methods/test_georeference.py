"""A reconstruction laid on poses that another method finds: which similarity, for which photos, how sure."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, QueryFault
from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.pose import vector_from_pose
from lodbench.geometry.similarity import Similarity, fit_similarity
from lodbench.methods.flight import FlightMethod, FlightParams
from lodbench.methods.georeference import PLACEMENT, SIGMAS, Georeference, GeoreferenceParams, pose_covariance
from lodbench.methods.localize import localize_flight
from lodbench.methods.protocol import Estimate, FlightEstimate
from lodbench.storage import random_stream
from tests.town import CAMERA, prior_of

SURE = np.diag([0.2, 0.2, 0.4, 0.1, 0.1, 0.2]) ** 2
COUNT = 6


class Known:
    """Answers each photo of a flight with a pose that is known, or with a reason."""

    name, params, requires = "known", None, frozenset({"mask"})

    def __init__(self, answers, lost=()):
        self.answers, self.lost, self.given = answers, list(lost), []

    def localize_flight(self, queries, city_map, streams):
        self.given = [query.name for query in queries]
        found = [self.answers[query.name] for query in queries]
        findings = {"lost": self.lost, "reasons": dict.fromkeys(self.lost[:1], "it shows a lake")}
        return FlightEstimate(found, findings)


def similarity_of(seed: int) -> Similarity:
    generator = np.random.default_rng(seed)
    turn = Rotation.random(random_state=seed).as_matrix()
    return Similarity(float(np.exp(generator.uniform(-3, 3))), turn, generator.uniform(-50, 50, 3))


def orbit(count: int = COUNT) -> dict[str, Pose]:
    """Returns cameras around the town that look at it, scene frame."""
    angles = np.linspace(0.0, 300.0, count)
    return {
        f"q{k}": Pose.from_euler(
            EulerAngles(40.0, 0.5, angle),
            (90 * np.sin(np.radians(angle)), -90 * np.cos(np.radians(angle)), 100.0 + 3 * k),
        )
        for k, angle in enumerate(angles)
    }


def flight(poses: dict[str, Pose], own: Similarity, mask=None) -> list[Query]:
    mask = np.ones((24, 32), np.float32) if mask is None else mask
    return [
        Query(name, "all", CAMERA, prior_of(pose), mask, sequence="a", reconstructed=own.pose(pose))
        for name, pose in poses.items()
    ]


def answers_at(poses: dict[str, Pose], covariance=SURE) -> dict[str, Estimate]:
    return {name: Estimate(pose, 0.9, covariance=covariance, probability=0.9) for name, pose in poses.items()}


def solved(inner, queries, city_map) -> FlightEstimate:
    method = Georeference()
    method.inner = inner
    return localize_flight(method, queries, city_map, [partial(random_stream, 0, q.name) for q in queries])


@given(seed=st.integers(0, 10_000))
@settings(max_examples=10, deadline=None)
def test_the_answer_is_the_same_in_whatever_frame_the_reconstruction_is(city_map, seed):
    generator = np.random.default_rng(7)
    truth = orbit()
    off = {name: pose.shifted(generator.normal(0, 0.3, 3)) for name, pose in truth.items()}
    first, other = (
        solved(Known(answers_at(off)), flight(truth, own), city_map)
        for own in (Similarity(1.0, np.eye(3), np.zeros(3)), similarity_of(seed))
    )
    for one, two, pose in zip(first.estimates, other.estimates, truth.values(), strict=True):
        assert pose_error(one.pose, two.pose).translation_m < 1e-4
        assert one.covariance == pytest.approx(two.covariance, rel=1e-3, abs=1e-5)
        # The mean of six errors of 0.3 m, and the reconstruction is exact.
        assert pose_error(one.pose, pose).translation_m < 0.6
    away = [each["distance_m"] for each in other.findings[PLACEMENT]["used"].values()]
    assert 0.1 < max(away) < 1.5


def test_findings_hold_the_similarity_to_the_city_s_coordinates(city_map):
    truth, own = orbit(), similarity_of(1)
    found = solved(Known(answers_at(truth)), flight(truth, own), city_map)
    placement = json.loads(json.dumps(found.findings[PLACEMENT]))
    laid = placement["similarity"]
    back = Similarity(laid["scale"], np.array(laid["rotation"]), np.array(laid["translation"]))
    assert laid["scale"] * own.scale == pytest.approx(1.0, rel=1e-6)
    for pose in truth.values():
        there = back.pose(own.pose(pose))
        assert pose_error(there, pose.shifted(city_map.scene.origin)).translation_m < 1e-3
    assert tuple(placement["sigmas"]) == SIGMAS
    assert placement["left_out"] == []
    assert {name: each["score"] for name, each in placement["used"].items()} == dict.fromkeys(truth, 0.9)


def test_photos_that_the_inner_method_cannot_place_are_placed_by_the_others(city_map):
    truth, own = orbit(), similarity_of(2)
    answers = answers_at(truth)
    answers["q1"] = replace(answers["q1"], pose=truth["q1"].shifted((30.0, 0.0, 0.0)))
    answers["q2"] = QueryFault("the mask holds no building")
    inner = Known(answers, lost=["q1"])
    queries = flight(truth, own)

    def no_mask(prior):
        raise QueryFault("q3.png is no mask.")

    queries[3] = replace(queries[3], building_probability=None, segment=no_mask)
    queries[4] = replace(queries[4], reconstructed=None)
    queries += flight({"q9": truth["q5"].shifted((1.0, 2.0, 0.0))}, own)
    inner.answers["q9"] = replace(answers["q5"], pose=truth["q5"].shifted((1.0, 2.0, 0.0)))
    found = solved(inner, queries, city_map)
    assert inner.given == ["q0", "q1", "q2", "q5", "q9"]
    left_out = dict(found.findings[PLACEMENT]["left_out"])
    assert left_out == {
        "q1": "it shows a lake",
        "q2": "the mask holds no building",
        "q3": "q3.png is no mask",
        "q4": "no reconstruction has a pose of it",
    }
    for name in ("q1", "q2", "q3"):
        estimate = found.estimates[int(name[1:])]
        assert pose_error(estimate.pose, truth[name]).translation_m < 0.01
        assert left_out[name] in estimate.notes[0]
    assert np.isnan(found.estimates[2].score)
    assert isinstance(found.estimates[4], QueryFault)


def test_a_flight_of_which_too_few_are_found_has_no_answer_and_says_why(city_map):
    truth = orbit(4)
    answers = answers_at(truth) | dict.fromkeys(["q1", "q3"], QueryFault("the mask holds no building"))
    found = solved(Known(answers), flight(truth, similarity_of(3)), city_map)
    (reason,) = {each.message for each in found.estimates}
    assert reason.startswith("2 of 4 photos of the flight can be used, and 3 are needed: q1: the mask holds")
    assert list(found.findings[PLACEMENT]["used"]) == ["q0", "q2"]
    bare = [replace(query, reconstructed=None) for query in flight(truth, similarity_of(3))]
    inner = Known(answers_at(truth))
    assert "q0: no reconstruction has a pose of it" in solved(inner, bare, city_map).estimates[0].message
    assert inner.given == []
    bare[0] = replace(bare[0], reconstructed=flight(truth, similarity_of(3))[0].reconstructed)
    assert solved(inner, bare, city_map).estimates[0].message.startswith("1 of 4 photos")
    with pytest.raises(QueryFault, match=r"1 of 1 photos of the flight can be used, and 3 are needed$"):
        Georeference().localize(bare[0], city_map, partial(random_stream, 0, "q"))


def test_more_photos_make_a_place_no_surer(city_map):
    sigmas = []
    for count in (6, 24):
        truth = orbit(count)
        found = solved(Known(answers_at(truth)), flight(truth, similarity_of(4)), city_map)
        sigmas.append([found.findings[PLACEMENT]["sigmas"][name] for name in SIGMAS[:3]])
    assert sigmas[1] == pytest.approx(sigmas[0], rel=0.2)
    assert sigmas[0] == pytest.approx(np.sqrt(np.diag(SURE))[:3], rel=0.2)


def test_a_pose_s_covariance_is_that_of_similarities_drawn_from_their_own():
    truth, own = orbit(), similarity_of(5)
    mine = [own.pose(pose) for pose in truth.values()]
    sigma_m, sigma_deg = np.full((COUNT, 3), 0.05), np.full(COUNT, 0.05)
    fitted = fit_similarity(mine, list(truth.values()), sigma_m, sigma_deg)
    assert np.sqrt(np.diag(fitted.covariance)) == pytest.approx(fitted.sigmas)
    pose = truth["q1"]
    generator = np.random.default_rng(0)
    drawn = []
    for step in generator.multivariate_normal(np.zeros(7), fitted.covariance, 4000):
        turn = Rotation.from_rotvec(step[3:6], degrees=True).as_matrix()
        center = fitted.middle + step[:3] + np.exp(step[6]) * turn @ (pose.center - fitted.middle)
        drawn.append(vector_from_pose(Pose.from_center(pose.rotation @ turn.T, center)))
    away = np.array(drawn) - vector_from_pose(pose)
    expected = pose_covariance(fitted, pose)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.cov(away.T) / scale == pytest.approx(expected / scale, abs=0.08)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"inner": "region"}, "finds no poses"),
        ({"inner": "georeference"}, "finds no poses"),
        ({"settings": {"name": "region"}}, "is not a setting"),
        ({"settings": {"singel": "region"}}, "method.settings.singel"),
        ({"inner": "flihgt"}, "flihgt"),
    ],
)
def test_what_solves_no_flight_is_refused(params, message):
    with pytest.raises(ConfigError, match=message):
        Georeference(GeoreferenceParams(**params))


def test_what_the_inner_method_requires_is_required():
    assert Georeference().requires == {"mask", "reconstruction"}
    by_pixels = Georeference(GeoreferenceParams(settings={"single": "region"}))
    assert by_pixels.requires == {"image", "reconstruction"}


def test_without_masks_a_flight_places_its_reconstruction_where_photos_find_themselves(city_map):
    generator, truth, off_m = np.random.default_rng(2), orbit(), {}
    queries = [
        replace(query, prior=truth[query.name].shifted(generator.uniform((-10, -10, -30), (10, 10, 30))))
        for query in flight(truth, similarity_of(6))
    ]
    alone = [Estimate(pose.shifted(generator.normal(0.0, 0.3, 3)), 1.0) for pose in truth.values()]
    alone[1] = QueryFault("the photo fits no view of the map")
    for single in ("region", "contour_alignment"):
        begun = FlightMethod(FlightParams(single=single))._start(queries, city_map, alone).vectors
        off = begun[:, :3] - [pose.center for pose in truth.values()]
        off_m[single] = np.linalg.norm(off, axis=1)
    assert off_m["region"].max() < 2.0
    # Masks vote on what photos err by alike: there the priors say where it begins.
    assert off_m["contour_alignment"].max() > 4.0
