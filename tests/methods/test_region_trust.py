"""`region`: photos' views, tilts, and the model of trust."""

import gc
import time
import weakref
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.methods.fits import query_photo
from lodbench.methods.region import Region, RegionParams
from lodbench.methods.region import posteriors as photo_module
from lodbench.methods.region.posteriors import Photo
from lodbench.methods.region.trust import ConfidenceFeatures, success_probability
from lodbench.rendering.photo_bins import directed_edge_levels
from lodbench.storage import random_stream
from tests.methods.test_region import WIDE
from tests.methods.test_region_lines import shaded_photo
from tests.methods.test_region_roofs import FAST
from tests.town import CAMERA, prior_of, true_poses

BELIEVING = replace(FAST, tilt_doubt_deg=0.0)


def estimates_of(city_map, folder, tilt_deg, params):
    """Returns the estimates of photos whose prior is tilted so far off, and their errors in place, metres."""
    estimates, errors = [], []
    for number, truth in enumerate(true_poses(2).values()):
        path = folder / f"{number}.png"
        cv2.imwrite(str(path), shaded_photo(city_map, truth, number))
        query = Query(path.name, "all", WIDE, tilted(prior_of(truth), tilt_deg), None, path)
        estimates.append(Region(params).localize(query, city_map, partial(random_stream, 0, "test")))
        errors.append(pose_error(estimates[-1].pose, truth).translation_m)
    return estimates, np.array(errors)


def tilted(pose, tilt_deg):
    """Returns a pose that looks so much higher up and leans half as far."""
    pitch, roll, yaw = pose.euler
    return Pose.from_euler(EulerAngles(pitch + tilt_deg, roll + 0.5 * tilt_deg, yaw), pose.center)


@pytest.mark.slow
@pytest.mark.parametrize("tilt_deg", [pytest.param(-4.0, marks=pytest.mark.slow), 4.0])
def test_a_tilt_worse_than_told_is_found_and_told(city_map, tmp_path, tilt_deg):
    _, believing = estimates_of(city_map, tmp_path, tilt_deg, BELIEVING)
    estimates, doubting = estimates_of(city_map, tmp_path, tilt_deg, FAST)
    assert believing.max() > 3.0
    assert doubting.max() < 1.0
    assert any(
        "outside the stated range" in note and "pitch" in note for each in estimates for note in each.notes
    )


@pytest.mark.slow
@pytest.mark.parametrize("params", [FAST, replace(FAST, range_tilt_deg=0.0)], ids=["as told", "exact"])
def test_a_tilt_as_told_is_left_alone(city_map, tmp_path, params):
    """A range of 0 is believed even where it is wrong: whoever says so knows."""
    tilt_deg = 0.5 if params.range_tilt_deg else 4.0
    doubting, _ = estimates_of(city_map, tmp_path, tilt_deg, params)
    believing, _ = estimates_of(city_map, tmp_path, tilt_deg, replace(params, tilt_doubt_deg=0.0))
    for one, other in zip(doubting, believing, strict=True):
        np.testing.assert_array_equal(one.pose.center, other.pose.center)


shares = st.floats(0.0, 1.0)
some_signs = st.builds(
    ConfidenceFeatures,
    shares,
    st.floats(0.0, 100.0),
    st.floats(-50.0, 900.0),
    st.floats(-1.0, 1.5),
    st.floats(0.0, 9.0),
)
BETTER = {"probability": 1, "apart_m": -1, "line_log_ratio_nats": 1, "sharpness": 1, "beyond": -1}


@given(some_signs, st.sampled_from(sorted(BETTER)), st.floats(0.0, 5.0))
def test_a_better_sign_never_lowers_it(features, name, step):
    value = max(
        getattr(features, name) + BETTER[name] * step,
        {"line_log_ratio_nats": -50.0, "sharpness": -1.0}.get(name, 0.0),
    )
    assert success_probability(features._replace(**{name: value})) >= success_probability(features)


@given(some_signs)
def test_it_is_a_probability(features):
    assert 0.0 <= success_probability(features) <= 1.0


def test_no_sign_alone_makes_an_answer_sure():
    good = ConfidenceFeatures(0.95, 0.6, 200.0, 0.6, 0.0)
    assert success_probability(good) > 0.95
    # Far below the prior's range, or where no edges lie along the lines: not trusted. Far from the best by
    # regions: less.
    assert success_probability(good._replace(beyond=0.4)) < 0.1
    assert success_probability(good._replace(line_log_ratio_nats=0.0)) < 0.5
    assert success_probability(good._replace(apart_m=30.0)) < success_probability(good)
    # Edges beside the lines, not on them: another map than this.
    assert success_probability(good._replace(sharpness=0.1)) < 0.8


def test_thousands_of_nats_outweigh_nothing_else():
    """Towards the horizon lines find edges anywhere: what all else speaks against stays untrusted."""
    lost = ConfidenceFeatures(0.07, 7.5, 7500.0, 0.12, 0.0)
    assert success_probability(lost) < 0.5
    assert success_probability(lost) == success_probability(lost._replace(line_log_ratio_nats=300.0))


PARAMS = RegionParams(coarse_width=60, fine_width=100, lines_width=160)


@pytest.fixture
def pixels():
    noise = random_stream(0, "photo").integers(0, 256, (CAMERA.height, CAMERA.width, 3))
    return noise.astype(np.uint8)


@pytest.mark.parametrize("threads", [1, 2])
def test_each_view_is_made_once(pixels, threads, monkeypatch):
    made = []

    def counted(picture, size, blur_px):
        made.append((size[0], blur_px))
        return directed_edge_levels(picture, size, blur_px)

    monkeypatch.setattr(photo_module, "directed_edge_levels", counted)
    photo = Photo(pixels, CAMERA, PARAMS, threads, blurs_px=(2.0, 1.0))
    for blur_px in (1.0, 2.0, 1.0):
        expected = directed_edge_levels(pixels, (160, round(160 * CAMERA.height / CAMERA.width)), blur_px)
        np.testing.assert_array_equal(photo.levels(blur_px), expected)
    assert photo.levels(1.0, 40).shape[1] == 40
    assert sorted(made) == [(40, 1.0), (160, 1.0), (160, 2.0)]
    assert photo.fit(100, is_coarse=False) is photo.fit(100, is_coarse=False)
    assert photo.fit(100, is_coarse=True).edge_weight == PARAMS.coarse_edge_weight


def test_what_goes_wrong_meanwhile_is_said_when_asked(pixels, monkeypatch):
    def broken(*_):
        raise ValueError("no edges today")

    monkeypatch.setattr(photo_module, "directed_edge_levels", broken)
    photo = Photo(pixels, CAMERA, PARAMS, 2, blurs_px=(1.0,))
    assert photo.fit(100, is_coarse=False).size[0] == 100
    with pytest.raises(ValueError, match="no edges today"):
        photo.levels(1.0)


def test_a_photo_is_let_go_at_once(pixels):
    """Its levels are megabytes, and its threads wait: no cycle may keep them until a collection."""
    gc.disable()
    try:
        photo = Photo(pixels, CAMERA, PARAMS, 2, blurs_px=(1.0,))
        photo.levels(1.0)
        photo.fit(100, is_coarse=False)
        # The last of what was begun may be in its thread's hands for a moment yet.
        left, until = weakref.ref(photo), time.monotonic() + 20.0
        del photo
        while left() is not None and time.monotonic() < until:
            time.sleep(0.01)
        assert left() is None
    finally:
        gc.enable()


def test_a_photo_of_one_colour_is_told_as_that(tmp_path):
    """Not as a prior that is far from the city."""
    path = tmp_path / "blank.png"
    query = SimpleNamespace(image=path)
    blank = np.full((65, 97, 3), 90, np.uint8)
    assert cv2.imwrite(str(path), blank)
    with pytest.raises(QueryFault, match=r"blank\.png has one colour everywhere"):
        query_photo(query)
    # Between the pixels that are looked at first.
    blank[33, 33] = 91
    assert cv2.imwrite(str(path), blank)
    assert (query_photo(query) == blank).all()
