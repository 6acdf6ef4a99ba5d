"""Starts where the map's lines lie along edges: found where regions have no top."""

from copy import copy
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
import scipy.ndimage

from lodbench.datasets.prior_sources import UniformPrior
from lodbench.evaluation import pose_error
from lodbench.geometry.pose import pose_from_vector
from lodbench.methods.region import Region, RegionParams
from lodbench.methods.region import line_likelihood as line_search
from lodbench.methods.region.evidence import Photo, PosePosterior
from lodbench.methods.region.search import Problem, local_maxima
from lodbench.storage import random_stream
from tests.town import CAMERA

FAST = RegionParams(fine_width=200, starts=4, modes=2)
STREAMS = partial(random_stream, 0, "test")


def photo_of_lines(city_map, truth, number):
    """Returns a photo whose roofs look as the ground does: nothing but the edges of buildings stands out."""
    (seen,) = city_map.edges(CAMERA, truth.rotation[None], truth.center[None], 25.0)
    photo = np.full((CAMERA.height, CAMERA.width), 110.0, dtype=np.float32)
    for first, last in np.rint(seen.pixels[seen.is_visible]).astype(int):
        cv2.line(photo, first.tolist(), last.tolist(), 160.0, 1)
    noise = random_stream(0, "lines", number).normal(0.0, 6.0, photo.shape)
    return np.clip(photo + noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def drawn(city_map, queries, truths, tmp_path_factory):
    """Returns the queries with such photos, without masks."""
    folder = tmp_path_factory.mktemp("lines")
    found = []
    for number, (query, truth) in enumerate(zip(queries, truths, strict=True)):
        path = folder / f"{number}.png"
        cv2.imwrite(str(path), photo_of_lines(city_map, truth, number))
        found.append(replace(query, building_probability=None, image=path))
    return found


def starts_of(query, city_map, roofs, params):
    photo = Photo(cv2.imread(str(query.image)), query.camera, params, roofs.threads)
    posterior = PosePosterior(query, city_map, photo.fit(params.fine_width, is_coarse=False), params)
    problem = Problem(query, photo, city_map, roofs, None)
    return line_search.line_starts(problem, posterior, params, STREAMS)


@pytest.mark.slow
def test_the_right_place_is_among_the_first_starts(city_map, roofs, drawn, truths):
    for query, truth in zip(drawn, truths, strict=True):
        assert pose_error(query.prior, truth).translation_m > 5.0
        starts = starts_of(query, city_map, roofs, FAST)
        errors = [pose_error(pose_from_vector(start.mean), truth) for start in starts[:3]]
        assert min(error.translation_m for error in errors) < 2.0


def test_it_is_the_same_on_one_core(city_map, roofs, drawn):
    alone = copy(roofs)
    alone.threads = 1
    several = [starts_of(drawn[0], city_map, each, FAST) for each in (roofs, alone)]
    for one, other in zip(*several, strict=True):
        np.testing.assert_array_equal(one.mean, other.mean)


def test_a_wide_prior_has_longer_strides_not_more_samples(city_map, roofs, drawn, monkeypatch):
    asked = []
    monkeypatch.setattr(line_search, "local_maxima", lambda fits, *_: asked.append(len(fits)) or [])
    for prior in (UniformPrior(), UniformPrior(50.0, 50.0, 30.0, 30.0)):
        assert starts_of(drawn[0], city_map, roofs, FAST.for_prior(prior)) == []
    assert asked[0] < asked[1] < 150_000


@pytest.mark.slow
def test_a_second_search_finds_what_regions_do_not_see(city_map, drawn, truths):
    regions_alone = replace(FAST, starts=1, modes=1, coarse_edge_weight=0.0, edge_weight=0.0)
    errors = {1: [], 2: []}
    for query, truth in zip(drawn, truths, strict=True):
        for more, found in errors.items():
            estimate = Region(replace(regions_alone, more_starts=more)).localize(query, city_map, STREAMS)
            found.append(pose_error(estimate.pose, truth).translation_m)
    # The last bits of sums differ between machines, and the search with them.
    assert max(errors[2]) < 3.0 < 10.0 < max(errors[1])


@pytest.mark.parametrize("turns_around", [False, True])
def test_the_first_starts_are_local_maxima(turns_around):
    grid = FAST.grid()
    fits = np.random.default_rng(0).random(len(grid))
    values = fits.reshape([axis.count for axis in (grid.yaw, grid.x, grid.y, grid.z)])
    ends = ["wrap" if turns_around else "nearest", *["nearest"] * 3]
    highest = np.flatnonzero(values >= scipy.ndimage.maximum_filter(values, size=3, mode=ends))
    expected = highest[np.argsort(-fits[highest])]
    assert local_maxima(fits, grid, turns_around, len(expected)) == expected.tolist()
