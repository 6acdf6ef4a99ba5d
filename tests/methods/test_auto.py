"""``method=auto``: by pixels, and by a mask where these leave the pose open."""

from dataclasses import replace

import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.harness.conformance.trial import make_trial
from lodbench.methods import Estimate
from lodbench.methods import auto as module
from lodbench.methods.assessment import assessed
from lodbench.methods.auto import Auto, AutoParams
from lodbench.methods.contour_alignment import ContourAlignment
from lodbench.methods.region import Region
from lodbench.storage import random_stream

POSE = Pose.from_euler(EulerAngles(30.0, 0.0, 10.0), (5.0, 6.0, 70.0))


def streams(stage: str, step: int) -> np.random.Generator:
    return random_stream(0, stage, step)


@pytest.fixture
def answers(monkeypatch):
    """Sets what the two methods answer; without an assessment that would need a photo."""
    monkeypatch.setattr(module, "assessed", lambda estimate, *_: replace(estimate, is_assessed=True))

    def set_answers(by_pixels: float, by_mask: float, apart_m: float = 0.0, turned_deg: float = 0.0) -> None:
        other = Pose.from_euler(
            EulerAngles(30.0, 0.0, 10.0 + turned_deg), POSE.center + np.array([apart_m, 0.0, 0.0])
        )
        pixels = Estimate(POSE, 1.0, probability=by_pixels, seconds={"coarse": 1.0})
        mask = Estimate(other, 0.8, probability=by_mask, seconds={"grid": 2.0})
        monkeypatch.setattr(Region, "localize", lambda *_: pixels)
        monkeypatch.setattr(ContourAlignment, "localize", lambda *_: mask)

    return set_answers


def ask(segment) -> Estimate:
    camera = Camera(8, 6, 8.0, 8.0, 4.0, 3.0)
    return Auto().localize(Query("a.jpg", "s", camera, POSE, segment=segment), None, streams)


def mask_of(pose: Pose) -> np.ndarray:
    return np.ones((6, 8), np.float32)


def never(pose: Pose) -> np.ndarray:
    raise AssertionError("a mask was made")


def test_no_mask_is_made_where_pixels_are_to_be_trusted(answers):
    answers(by_pixels=0.5, by_mask=0.99)
    found = ask(never)
    assert (found.probability, found.mask) == (0.5, None)


def test_without_a_segmenter_the_pixels_answer_stands(answers):
    answers(by_pixels=0.1, by_mask=0.99)
    assert ask(None).probability == 0.1


@pytest.mark.parametrize(
    ("by_mask", "apart_m", "turned_deg", "probability"),
    [(0.6, 3.9, 0.0, 0.6), (0.6, 4.1, 0.0, 0.3), (0.6, 0.0, 3.9, 0.6), (0.6, 0.0, 4.1, 0.3)],
)
def test_a_mask_s_answer_counts_half_where_it_is_another_place(
    answers, by_mask, apart_m, turned_deg, probability
):
    answers(0.2, by_mask, apart_m, turned_deg)
    found = ask(mask_of)
    assert found.probability == probability
    assert found.mask is not None
    assert found.alternatives[0] is POSE
    assert found.alternative_probabilities[0] == 0.2
    assert "20 %" in found.notes[-1]
    assert found.seconds == {"coarse": 1.0, "mask: grid": 2.0}


def test_the_less_probable_answer_by_a_mask_is_left(answers):
    answers(0.31, 0.6, apart_m=50.0)
    found = ask(mask_of)
    assert (found.pose, found.mask, found.notes) == (POSE, None, ())


def test_a_mask_that_cannot_be_made_is_a_note(answers):
    def fails(pose: Pose) -> np.ndarray:
        raise QueryFault("the photo is grey.")

    answers(0.3, 0.9)
    found = ask(fails)
    assert found.probability == 0.3
    assert found.notes[-1].endswith("without result: the photo is grey")


def test_both_search_what_the_prior_leaves_open():
    params = Auto().params_for_prior(UniformPrior(40.0, 50.0, 20.0, 90.0, 2.0, 3.0))
    method = Auto(params)
    for part in (method._by_pixels.params, method._by_mask.params):
        ranges = (part.range_x_m, part.range_y_m, part.range_z_m, part.range_yaw_deg, part.range_tilt_deg)
        assert ranges == (80.0, 100.0, 40.0, 180.0, 5.0)
    assert isinstance(params, AutoParams)
    assert Auto(params).params_for_true_tilt().range_tilt_deg == 0.0
    assert Auto(AutoParams(range_tilt_deg=0.0))._by_mask.params.range_tilt_deg == 0.0


def test_an_answer_is_assessed_once(tmp_path):
    trial = make_trial(tmp_path, Region())
    query, city_map = trial.queries[0], CityMap(trial.city_map.scene, threads=1)
    found = Estimate(query.prior, 1.0, covariance=np.eye(6), probability=0.9)
    once = assessed(found, query, city_map)
    assert once.is_assessed
    assert once.probability < 0.9
    assert assessed(once, query, city_map) is once
