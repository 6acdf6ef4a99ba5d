"""LoD-Loc (v1): its parts by slow counts, its search on maps drawn from the truth, and what it refuses."""

import math
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lodbench.baselines.lodloc import LodLoc, LodLocParams
from lodbench.baselines.lodloc import method as lodloc_method
from lodbench.baselines.lodloc.cost_volume import narrowed, search_grid, volume_scores
from lodbench.baselines.lodloc.likelihood import Maps, maps_of, unpacked
from lodbench.baselines.lodloc.refinement import refined
from lodbench.baselines.lodloc.wireframe import points_along, visible_points, wider
from scipy.ndimage import distance_transform_edt, map_coordinates

from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import ConfigError, QueryFault
from lodbench.evaluation.pose_errors import pose_error
from lodbench.geometry import AxisRange, EulerAngles, Pose, PoseGrid, rotations_at_yaws
from lodbench.methods import Input
from lodbench.segmentation.probability import working_size
from lodbench.storage import random_stream
from tests.town import CAMERA

STREAMS = partial(random_stream, 0, "test")
WORKING = CAMERA.scaled(*working_size(CAMERA.width, CAMERA.height, 512))


def distances_px(city_map, pose: Pose) -> np.ndarray:
    """Distance of each pixel to the wireframe that a pose sees, drawn point by point."""
    seen = city_map.edges(WORKING, pose.rotation[None], pose.center[None])[0]
    points = points_along(seen.points[seen.is_visible], 0.05)
    pixels = WORKING.project((points - pose.center) @ pose.rotation.T)
    lines = np.ones((WORKING.height, WORKING.width), bool)
    column, row = np.floor(pixels).astype(int).T
    inside = (row >= 0) & (row < WORKING.height) & (column >= 0) & (column < WORKING.width)
    lines[row[inside], column[inside]] = False
    return distance_transform_edt(lines).astype(np.float32)


def maps_at(city_map, pose: Pose) -> Maps:
    """Maps as an ideal network makes them of a photo taken at a pose."""
    far = distances_px(city_map, pose)

    def likelihood(scale: float, width_px: float) -> np.ndarray:
        size = math.ceil(scale * WORKING.width), math.ceil(scale * WORKING.height)
        small = cv2.resize(far, size, interpolation=cv2.INTER_AREA)
        return np.float32(40.0) * np.exp(-((small / width_px) ** 2)).astype(np.float32)

    return Maps((likelihood(0.25, 12.0), likelihood(0.5, 6.0), likelihood(1.0, 3.0)), np.minimum(far, 20.0))


def moved(pose: Pose, move_m, turn_deg) -> Pose:
    return Pose.from_euler(EulerAngles(*(np.array(pose.euler) + turn_deg)), pose.center + move_m)


@given(
    st.lists(st.tuples(*[st.floats(-50, 50)] * 6), min_size=1, max_size=5), st.sampled_from([0.3, 1.0, 7.0])
)
def test_points_lie_on_their_segments_ends_included_no_further_apart_than_asked(numbers, spacing_m):
    segments = np.array(numbers).reshape(-1, 2, 3)
    points = points_along(segments, spacing_m)
    counts = [max(1, math.ceil(np.linalg.norm(b - a) / spacing_m)) + 1 for a, b in segments]
    assert len(points) == sum(counts)
    for (a, b), mine in zip(segments, np.split(points, np.cumsum(counts)[:-1]), strict=True):
        assert mine[0] == pytest.approx(a)
        assert mine[-1] == pytest.approx(b, abs=1e-9)
        assert (np.linalg.norm(np.diff(mine, axis=0), axis=1) <= spacing_m * (1 + 1e-9)).all()
        assert np.linalg.norm(np.cross(mine - a, b - a), axis=1) == pytest.approx(0.0, abs=1e-6)


def test_what_a_pose_does_not_see_gives_no_points(city_map, truths):
    truth = truths[0]
    found = visible_points(city_map, WORKING, truth, 0.5, 10**6, np.random.default_rng(0))
    wide = wider(WORKING, 1.25)
    depth = city_map.depth(wide, truth.rotation[None], truth.center[None])[0]
    in_camera = (found - truth.center) @ truth.rotation.T
    pixels = wide.project(in_camera)
    row, column = pixels[:, 1].astype(int), pixels[:, 0].astype(int)
    inside = (row > 1) & (row < wide.height - 2) & (column > 1) & (column < wide.width - 2)
    nearest = np.array(
        [
            [0, 0] if not ok else [depth[r - 1 : r + 2, c - 1 : c + 2].max(), z]
            for r, c, z, ok in zip(row, column, in_camera[:, 2], inside, strict=True)
        ]
    )
    hidden = (nearest[:, 0] > 0) & (nearest[:, 1] > nearest[:, 0] + 2.0)
    assert len(found) > 200
    assert hidden.mean() < 0.01
    fewer = visible_points(city_map, WORKING, truth, 0.5, 50, np.random.default_rng(0))
    assert len(fewer) == 50
    assert {tuple(point) for point in fewer} <= {tuple(point) for point in found}


def test_the_cost_volume_equals_a_slow_sum(truths):
    truth, generator = truths[0], np.random.default_rng(1)
    values = generator.normal(size=(56, 75)).astype(np.float32)
    points = truth.center + generator.normal(0, 60, (40, 3)) + 100 * truth.rotation[2]
    rotations = rotations_at_yaws(truth.euler.pitch_deg, truth.euler.roll_deg, np.array([-4.0, 9.0]))
    centers = truth.center + generator.normal(0, 8, (5, 3))
    found = volume_scores(values, 0.25, WORKING, points, rotations, centers)
    framed = np.pad(values, 1)
    for y, rotation in enumerate(rotations):
        for m, center in enumerate(centers):
            in_camera = (points - center) @ rotation.T
            pixels = 0.25 * WORKING.project(in_camera) - 0.5
            at = map_coordinates(framed, [pixels[:, 1] + 1, pixels[:, 0] + 1], order=1, cval=0.0)
            assert found[y, m] == pytest.approx(np.where(in_camera[:, 2] > 1.0, at, 0.0).sum() / 40, abs=1e-3)


def test_a_narrowed_grid_keeps_its_counts_and_neither_grows_nor_skips_a_step():
    grid = PoseGrid(AxisRange(20, 10), AxisRange(20, 10), AxisRange(60, 30), AxisRange(15, 1))
    found = narrowed(grid, np.array([0.01, 2.0, 500.0, 1.0]), 0.8)
    assert found.x.width == pytest.approx(2 * 20 / 9)
    assert found.y.width == pytest.approx(max(3.2, 2 * 20 / 9))
    assert (found.z.width, found.yaw.width) == (60, 15)
    assert [axis.count for axis in (found.x, found.y, found.z, found.yaw)] == [10, 10, 30, 1]


def test_a_stage_finds_the_grid_pose_nearest_to_the_truth(city_map, truths):
    truth = truths[0]
    points = visible_points(city_map, WORKING, truth, 1.0, 2000, np.random.default_rng(0))
    grid = PoseGrid(AxisRange(12, 5), AxisRange(12, 5), AxisRange(12, 5), AxisRange(8, 5))
    start = moved(truth, [3.0, -6.0, 0.0], [0.0, 0.0, 2.0])
    found = search_grid(maps_at(city_map, truth).stages[1], 0.5, WORKING, points, start, grid)
    error = pose_error(found.pose, truth)
    assert error.translation_m < 1e-6
    assert error.rotation_deg < 1e-6
    assert (found.deviations < [3, 3, 3, 2]).all()


def test_refinement_finds_all_six_degrees(city_map, truths):
    for number, truth in enumerate(truths):
        start = moved(truth, [0.6, -0.5, 0.4], [0.5, -0.4, 0.3])
        points = visible_points(city_map, WORKING, start, 0.5, 3000, np.random.default_rng(number))
        found = refined(maps_at(city_map, truth).refinement, WORKING, points, start, 40)
        error = pose_error(found, truth)
        assert error.translation_m < 0.4
        assert error.rotation_deg < 0.25
        assert abs(found.euler.pitch_deg - truth.euler.pitch_deg) < 0.2


def test_few_points_in_view_leave_the_pose_as_it_is(truths):
    start, points = truths[0], truths[0].center + np.full((5, 3), 3.0)
    assert refined(np.zeros((448, 602), np.float32), WORKING, points, start, 5) is start


@pytest.fixture
def ideal(monkeypatch, city_map, truths):
    """The network replaced by maps drawn from the first truth."""
    maps = maps_at(city_map, truths[0])
    monkeypatch.setattr(lodloc_method, "maps_of", lambda *arguments: maps)


def test_it_finds_a_pose_with_a_wrong_tilt_and_counts_what_it_laid_out(ideal, queries, city_map, truths):
    prior = moved(truths[0], [6.0, -7.0, 11.0], [0.8, -0.7, 4.0])
    city_map.usage.take()
    found = LodLoc().localize(replace(queries[0], prior=prior), city_map, STREAMS)
    error = pose_error(found.pose, truths[0])
    assert error.translation_m < 1.0
    assert error.rotation_deg < 0.6
    drawn = city_map.usage.take()
    assert drawn["edges"] == 2
    assert drawn["wireframes"] == 5 * 24000 + 2


def test_edges_that_fit_nowhere_are_a_failure_with_its_score(monkeypatch, queries, city_map, truths):
    """Maps on which each place inside the photo is less likely than any outside."""
    sizes = [
        (math.ceil(scale * WORKING.height), math.ceil(scale * WORKING.width)) for scale in (0.25, 0.5, 1)
    ]
    noise = np.random.default_rng(0)
    stages = tuple(noise.uniform(-30, -5, size).astype(np.float32) for size in sizes)
    maps = Maps(stages, np.zeros(sizes[2], np.float32))
    monkeypatch.setattr(lodloc_method, "maps_of", lambda *arguments: maps)
    coarse = LodLocParams(count_x=3, count_y=3, count_z=3, count_yaw=2, rounds=1)
    with pytest.raises(QueryFault, match=r"fit the photo nowhere: -?\d+\.\d at best, not above 0"):
        LodLoc(coarse).localize(replace(queries[0], prior=truths[0]), city_map, STREAMS)
    with pytest.raises(QueryFault, match="fit the photo nowhere"):
        LodLoc(replace(coarse, rounds=2)).localize(replace(queries[0], prior=truths[0]), city_map, STREAMS)
    trusting = replace(coarse, least_score=-100.0)
    assert LodLoc(trusting).localize(replace(queries[0], prior=truths[0]), city_map, STREAMS).score <= 0


def test_refinement_that_walks_away_is_undone(ideal, monkeypatch, queries, city_map, truths):
    """Though the finest map likes where it went."""
    monkeypatch.setattr(lodloc_method, "refined", lambda *arguments: truths[0])
    prior = moved(truths[0], [0.0, 60.0, 0.0], [0.0, 0.0, 0.0])
    query = replace(queries[0], prior=prior)
    coarse = LodLocParams(count_x=3, count_y=3, count_z=3, count_yaw=2, rounds=1)
    found = LodLoc(coarse).localize(query, city_map, STREAMS)
    assert pose_error(found.pose, truths[0]).translation_m > 40
    # It is measured from the grid's answer: a step out of the prior's range is none too far.
    near = replace(query, prior=moved(truths[0], [0.0, 14.0, 0.0], [0.0, 0.0, 0.0]))
    beside = LodLoc(coarse).localize(near, city_map, STREAMS)
    assert pose_error(beside.pose, truths[0]).translation_m < 1e-6
    assert "y -14.0 m" in beside.notes[0]
    wide = LodLoc(replace(coarse, range_y_m=300.0)).localize(query, city_map, STREAMS)
    assert pose_error(wide.pose, truths[0]).translation_m < 1e-6


def test_an_answer_beyond_the_range_of_the_prior_says_so(truths):
    grid = LodLocParams().grid()
    told = lodloc_method.beyond_range(moved(truths[0], [14.0, 0, 0], [0, 6.0, -9.0]), truths[0], grid)
    (offsets,) = (sentence.split(": ")[1] for sentence in told)
    assert offsets == "x +14.0 m, roll +6.0 deg, yaw -9.0 deg"
    assert lodloc_method.beyond_range(moved(truths[0], [10, -10, 30], [1, 1, 7.5]), truths[0], grid) == ()
    around_north = [Pose.from_euler(EulerAngles(30.0, 0.0, yaw), [0, 0, 0]) for yaw in (179.0, -179.0)]
    assert lodloc_method.beyond_range(*around_north, grid) == ()


def test_prior_widths_reach_the_first_stage():
    wide = LodLoc(LodLocParams(size=320)).params_for_prior(UniformPrior(x_m=30.0, yaw_deg=15.0))
    assert (wide.range_x_m, wide.range_yaw_deg, wide.count_x, wide.size) == (60.0, 30.0, 10, 320)


def test_what_cannot_be_aligned_is_a_failure(queries, city_map, tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((60, 80, 3), 90, np.uint8))
    with pytest.raises(QueryFault, match="one colour"):
        LodLoc().localize(replace(queries[0], image=tmp_path / "grey.png"), city_map, STREAMS)
    with pytest.raises(QueryFault, match="no photo"):
        LodLoc().localize(replace(queries[0], image=None), city_map, STREAMS)
    elsewhere = replace(queries[0], prior=queries[0].prior.shifted([5000.0, 0.0, 0.0]))
    with pytest.raises(QueryFault, match="hardly an edge"):
        LodLoc().localize(elsewhere, city_map, STREAMS)


def test_it_asks_for_photos_and_names_its_weights():
    assert LodLoc().requires == {Input.IMAGE}
    (weights,) = LodLoc().weight_files()
    assert 1e6 < weights.stat().st_size < 5e6
    with pytest.raises(ConfigError, match="no weights"):
        LodLoc(LodLocParams(weights="nowhere.onnx")).weight_files()


@pytest.mark.parametrize("wrong", [{"size": 3}, {"count_x": 0}, {"range_z_m": math.inf}, {"rounds": 0}])
def test_wrong_settings_end_before_any_work(wrong):
    with pytest.raises(ConfigError):
        LodLocParams(**wrong)


def test_another_network_is_refused(tmp_path):
    from lodbench.segmentation.packaged import packaged_weights

    with pytest.raises(ConfigError, match="is wanted"):
        maps_of(np.zeros((64, 96, 3), np.uint8), 96, 64, str(packaged_weights()))
    (tmp_path / "none.onnx").write_bytes(b"no network")
    with pytest.raises(ConfigError, match="not a safe ONNX network"):
        maps_of(np.zeros((64, 96, 3), np.uint8), 96, 64, str(tmp_path / "none.onnx"))


def test_maps_are_unpacked_as_torch_does():
    torch = pytest.importorskip("torch")
    from lodbench.baselines.lodloc.nets.net import unpacked as by_torch

    packed = np.random.default_rng(0).normal(size=(10, 16, 32)).astype(np.float32)
    found, wanted = unpacked(packed, 60, 30), by_torch(torch.from_numpy(packed[None]))
    for mine, other, (rows, columns) in zip(
        (*found.stages, found.refinement), wanted, ((8, 15), (15, 30), (30, 60), (30, 60)), strict=True
    ):
        assert mine.shape == (rows, columns)
        assert (mine == other[0, :rows, :columns].numpy()).all()
