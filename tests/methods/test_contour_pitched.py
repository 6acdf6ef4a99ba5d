"""`contour_alignment` over blocks of roofs that are told to be pitched."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymap.corrected_map import corrected_map
from lodbench.datasets.query import Query
from lodbench.evaluation import pose_error
from lodbench.methods.contour_alignment import ContourAlignment, ContourAlignmentParams
from lodbench.methods.contour_alignment.method import expected_map
from lodbench.storage import random_stream
from tests.town import CAMERA, prior_of


@pytest.fixture
def told(scene):
    """The town's map, of whose buildings every other one is told to have a pitched roof."""
    return CityMap(replace(scene, pitched=np.arange(scene.num_buildings) % 2 == 0), threads=1)


def tops(scene):
    return np.maximum.reduceat(scene.vertices[:, 2], scene.vertex_starts[:-1])


def test_it_is_made_once_for_a_map(told, scene):
    expected = expected_map(told, 0.3)
    np.testing.assert_allclose(tops(scene) - tops(expected.scene), 0.3 * told.scene.pitched, atol=1e-4)
    assert expected_map(told, 0.3) is expected
    assert expected_map(told, 1.0) is not expected


def test_a_map_of_which_nothing_is_told_stays(told, city_map):
    for _ in range(2):
        assert expected_map(city_map, 1.0) is city_map
        assert expected_map(told, 0.0) is told


def test_a_map_that_is_no_longer_needed_is_freed(scene):
    for pitched in (None, np.ones(scene.num_buildings, bool)):
        city_map = CityMap(replace(scene, pitched=pitched), threads=1)
        expected_map(city_map, 1.0)
        reference = weakref.ref(city_map)
        del city_map
        gc.collect()
        assert reference() is None


@pytest.mark.slow
def test_told_roofs_bring_the_answer_nearer(told, truths):
    """Masks of a town whose every other roof is two metres lower than in the map, which tells which."""
    town, _ = corrected_map(told, np.where(told.scene.pitched, -2.0, 0.0))
    errors = {0.0: [], 2.0: []}
    for number, truth in enumerate(truths):
        mask = town.render(CAMERA, truth).astype(np.float32)
        query = Query(f"q{number}", "all", CAMERA, prior_of(truth), mask)
        for lower_m, found in errors.items():
            method = ContourAlignment(ContourAlignmentParams(pitched_lower_m=lower_m))
            estimate = method.localize(query, told, partial(random_stream, 0, "test"))
            found.append(pose_error(estimate.pose, truth).translation_m)
    assert np.mean(errors[2.0]) < 0.5 * np.mean(errors[0.0])
