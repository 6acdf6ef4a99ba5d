"""The model's lines on a photo's edges: they know the pose where the map is exact, and whether it is."""

from copy import copy
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
import scipy.ndimage

from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.estimation.outline_alignment import edges_in_reach
from lodbench.estimation.state_vector import ALL_BASES, NUM_AFTER_POSE, NUM_STATE
from lodbench.evaluation import pose_error
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.region import Region, RegionParams
from lodbench.methods.region import line_likelihood as line_search
from lodbench.methods.region.answer import LineAligner
from lodbench.methods.region.line_likelihood import LineLikelihood, points_on_lines
from lodbench.methods.region.posteriors import (
    OutlineSampler,
    Photo,
    PosePosterior,
    QueryContext,
    local_maxima,
)
from lodbench.storage import random_stream
from tests.town import BOXES, CAMERA, prior_of, true_poses

SHADES = np.array([[0, 0, 0], [60, -10, 20], [-30, 40, 10], [20, 50, -40]], dtype=np.float64)


def shaded_photo(city_map, truth, number, camera=CAMERA):
    """Returns a photo of the town whose faces are lit by where they look."""
    normals = city_map.normals(camera, truth.rotation[None], truth.center[None])[0]
    shade = np.where(np.abs(normals) > 0.5, [1, 2, 3], 0).max(axis=2)
    noise = random_stream(0, "shaded", number).normal(0.0, 6.0, (camera.height, camera.width, 3))
    return np.clip(110.0 + SHADES[shade] + noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def shaded(city_map, truths):
    """Returns a photo of each truth."""
    return [shaded_photo(city_map, truth, number) for number, truth in enumerate(truths)]


def with_roofs(truth):
    """Returns (10,) a pose, the lens as told, roofs and feet as the map has them."""
    return np.append(vector_from_pose(truth), np.zeros(NUM_AFTER_POSE))


def line_fit(photo, query, roofs, vector):
    """Returns what lines seen from (10,) say of a photo in array form."""
    params = RegionParams()
    return LineLikelihood(Photo(photo, query.camera, params).levels(1.0), query, roofs, vector, params)


def fit_of(photo, query, roofs, truth):
    return line_fit(photo, query, roofs, with_roofs(truth))


def test_lines_fit_best_at_the_truth(roofs, queries, truths, shaded):
    far = [1.5, 1.5, 4.0, 1.0, 1.0, 1.0, 3.0, 1.5, 4.0, 1.5]
    moves = np.concatenate([d * np.eye(NUM_STATE) * far for d in (-1.0, 1.0)])
    for photo, query, truth in zip(shaded, queries, truths, strict=True):
        fit, vector = fit_of(photo, query, roofs, truth), with_roofs(truth)
        assert len(fit) > 100
        worse = (fit(vector[None]) - fit(vector + moves)).reshape(2, NUM_STATE)
        assert (np.delete(worse, ALL_BASES, axis=1) > 1.0).all()
        # Where walls end is not looked at: hedges and cars hide it.
        assert (np.abs(worse[:, ALL_BASES]) < 3.0).all()


@pytest.mark.parametrize("width", [32, 320])
def test_each_building_has_points_by_the_length_of_its_lines(roofs, truths, width):
    """From afar most lines are shorter than points are apart: they count no more for that."""
    camera = CAMERA.scaled(width, width * 3 // 4)
    points, spacing_px = points_on_lines(roofs, 0, camera, vector_from_pose(truths[0]))
    (seen,) = roofs.at(0).edges(camera, truths[0].rotation[None], truths[0].center[None], 25.0)
    lengths = np.linalg.norm(seen.pixels[:, 1] - seen.pixels[:, 0], axis=1)
    shown = np.flatnonzero(seen.is_visible & (lengths > 2.0))
    lengths, building = lengths[shown], seen.building[shown]
    low, high = np.array([box[4:] for box in BOXES], dtype=np.float64)[building].T
    # But for those where walls end, which hedges and cars hide.
    kept = (seen.points[shown, :, 2].mean(axis=1) - low) / (high - low) > 0.2
    asked = np.bincount(building, kept * lengths, len(BOXES)) / spacing_px
    # Points run on from line to line: each stretch without a gap has its share, to a point.
    begins = kept & np.append(True, ~kept[:-1] | (building[1:] != building[:-1]))
    stretches = np.bincount(building[begins], minlength=len(BOXES))
    found = np.bincount(points.buildings, minlength=len(BOXES))
    assert 0 < kept.sum() < len(kept)
    assert (np.abs(found - asked) <= stretches).all()
    assert np.abs(found - asked).mean() < 1.0


def test_an_exact_map_is_sharp_and_a_smeared_photo_is_not(roofs, queries, truths, shaded):
    photo, query, truth = shaded[0], queries[0], truths[0]
    vector = with_roofs(truth)
    assert fit_of(photo, query, roofs, truth).sharpness(vector) > RegionParams().least_sharpness
    # Two outlines 8 pixels apart, as of walls and eaves where the map has one: no line is where edges are.
    smeared = cv2.GaussianBlur(photo, (0, 0), 5.0)
    assert fit_of(smeared, query, roofs, truth).sharpness(vector) < RegionParams().least_sharpness


def test_a_photo_without_edges_is_not_sharp(roofs, queries, truths):
    """Where nothing stands out, what is left of nothing says nothing."""
    for number, (query, truth) in enumerate(zip(queries, truths, strict=True)):
        noise = random_stream(0, "noise", number).integers(0, 256, (CAMERA.height, CAMERA.width))
        sharpness = fit_of(noise.astype(np.uint8), query, roofs, truth).sharpness(with_roofs(truth))
        assert sharpness < RegionParams().least_sharpness


@pytest.mark.slow
def test_the_method_ends_nearer_with_lines(city_map, tmp_path):
    """Best poses of six photos, over a map that is exact and told to be."""
    errors = {0.0: [], RegionParams().lines_weight: []}
    for number, truth in enumerate(true_poses(6).values()):
        path = tmp_path / f"{number}.png"
        cv2.imwrite(str(path), shaded_photo(city_map, truth, number))
        for weight, found in errors.items():
            told = RegionParams(fine_width=200, starts=4, modes=2, roofs_m=0.0, place_sigma_m=0.0)
            query = Query(path.name, "all", CAMERA, prior_of(truth), None, path)
            method = Region(replace(told, lines_weight=weight))
            estimate = method.localize(query, city_map, partial(random_stream, 0, "test"))
            found.append(pose_error(estimate.pose, truth).translation_m)
    without, with_lines = (np.median(found) for found in errors.values())
    assert with_lines < 0.8 * without


def test_lines_choose_among_the_search_s_tops(city_map, scene, roofs, queries, truths, shaded):
    """Of poses that a search may have met, regions left out: wherever the right one stands among them."""
    params = replace(RegionParams(), fine_width=200)
    moves = np.array([[14, 0, 0], [0, -12, 4], [0, 0, 40], [-20, 9, -8], [0, 0, 0]], dtype=np.float64)
    for number, (photo, query, truth) in enumerate(zip(shaded, queries, truths, strict=True)):
        reach = scene, query.camera, query.prior, 60.0, 20.0
        around = OutlineSampler(edges_in_reach(*reach), city_map, params)
        seen = Photo(photo, query.camera, params)
        streams = partial(random_stream, 0, "test", number)
        starts = with_roofs(truth) + np.roll(np.pad(moves, ((0, 0), (0, NUM_STATE - 3))), number, axis=0)
        context = QueryContext(query, seen, city_map, roofs, around)
        found = LineAligner(context, seen.fit(200, False), params, streams).from_best(starts, roofs)
        assert int(found.log_posteriors.argmax()) == (len(moves) - 1 + number) % len(moves)
        assert np.linalg.norm(found.vector[:3] - truth.center) < 1.0
        # Hopeless ones are not followed.
        assert 1 <= np.isfinite(found.log_posteriors).sum() < len(moves)


def test_a_wider_prior_has_more_starts():
    usual, wide, narrow = (
        UniformPrior(),
        UniformPrior(50.0, 50.0, 30.0, 30.0),
        UniformPrior(2.0, 2.0, 5.0, 2.0),
    )
    counts = [RegionParams(starts=8).for_prior(prior).num_starts() for prior in (usual, wide, narrow)]
    assert counts[0] == counts[2] == 8
    assert 16 <= counts[1] <= 32


def test_a_pose_without_lines_in_view_counts_nothing(roofs, queries, truths, shaded):
    away = with_roofs(truths[0]) + np.array([5000.0, *np.zeros(NUM_STATE - 1)])
    fit = line_fit(shaded[0], queries[0], roofs, away)
    assert len(fit) == 0
    assert fit.sharpness(away) == 0.0
    assert pose_from_vector(away[:6]).center[0] > 4000.0


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
    context = QueryContext(query, photo, city_map, roofs, None)
    return line_search.line_starts(context, posterior, params, STREAMS)


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
