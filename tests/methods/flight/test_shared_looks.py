"""Flights without masks: exposures told apart, looks shared by photos, poses from the masks these make."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, QueryFault
from lodbench.evaluation import pose_error
from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.flight import FlightMethod, FlightParams
from lodbench.methods.flight.shared_looks import agreed_places, exposures, look_of, with_masks_by_looks
from lodbench.methods.protocol import Estimate
from lodbench.segmentation import binary_mask
from tests.methods.flight.test_joint import flight, localize
from tests.town import CAMERA

# Blue, green and red of ground, roofs and walls.
PAINT = np.array([[70, 110, 80], [60, 70, 150], [150, 150, 145]], dtype=np.float64)


def painted(city_map, pose, gain, generator, camera=CAMERA):
    """Returns a photo of the town in three colours with noise, brighter by a factor."""
    (normals,) = city_map.normals(camera, pose.rotation[None], pose.center[None])
    kinds = np.where((normals != 0).any(axis=-1), np.where(normals[..., 2] > 0.5, 1, 2), 0)
    noise = cv2.GaussianBlur(generator.normal(0.0, 60.0, (*kinds.shape, 3)), (0, 0), 1.5)
    return np.clip((PAINT[kinds] + noise) * gain, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def photographed(city_map, tmp_path_factory):
    """Returns a flight's queries with photos and no masks, true poses, and each photo's exposure."""
    folder, generator = tmp_path_factory.mktemp("photos"), np.random.default_rng(5)
    queries, poses = flight(city_map, count=5, focal=1.0)
    gains = np.array([0.7, 1.0, 1.5, 1.0, 0.85])
    for k, (pose, gain) in enumerate(zip(poses, gains, strict=True)):
        cv2.imwrite(str(folder / f"q{k}.png"), painted(city_map, pose, gain, generator))
        queries[k] = replace(queries[k], building_probability=None, image=folder / f"q{k}.png")
    return queries, poses, gains


def ious(masked, city_map, poses):
    found = []
    for query, pose in zip(masked, poses, strict=True):
        shown, mask = city_map.render(CAMERA, pose), binary_mask(query.mask, CAMERA.width, CAMERA.height)
        found.append(np.count_nonzero(shown & mask) / np.count_nonzero(shown | mask))
    return np.array(found)


def test_exposures_are_told_apart_from_looks(photographed, city_map):
    queries, poses, gains = photographed
    looks = [look_of(q, vector_from_pose(p), city_map) for q, p in zip(queries, poses, strict=True)]
    expected = np.log(gains) - np.median(np.log(gains))
    np.testing.assert_allclose(exposures(looks), np.repeat(expected[:, None], 3, axis=1), atol=0.12)
    # One that shows ground only has its exposure from that.
    bare = replace(looks[2], kinds=np.where(looks[2].kinds == 0, 0, -1))
    np.testing.assert_allclose(exposures([*looks[:2], bare, *looks[3:]])[2], expected[2], atol=0.12)


def test_a_photo_borrows_what_buildings_look_like_from_the_others(photographed, city_map):
    queries, poses, _ = photographed
    # 2 m off, each by itself: silhouettes are wrong where masks are to be right.
    off = np.random.default_rng(0).normal(0.0, 1.2, (5, 3))
    vectors = np.array([vector_from_pose(p.shifted(o)) for p, o in zip(poses, off, strict=True)])
    masked = with_masks_by_looks(queries, vectors, np.ones(5), city_map)
    rough = [city_map.render(CAMERA, p.shifted(o)) for p, o in zip(poses, off, strict=True)]
    silhouettes = [
        replace(q, building_probability=s.astype(np.float32)) for q, s in zip(queries, rough, strict=True)
    ]
    assert (ious(masked, city_map, poses) > ious(silhouettes, city_map, poses)).all()
    assert ious(masked, city_map, poses).mean() > 0.95
    # Alone, the first has itself only; with the others, no less.
    one = with_masks_by_looks(queries[:1], vectors[:1], np.ones(1), city_map)
    assert ious(masked, city_map, poses)[0] >= ious(one, city_map, poses[:1])[0] - 0.005


@pytest.mark.slow
def test_a_flight_is_found_by_its_pixels(photographed, city_map, tmp_path):
    queries, poses, _ = photographed
    (tmp_path / "broken.png").write_bytes(b"no picture")
    broken = replace(queries[4], image=tmp_path / "broken.png")
    answer = localize([*queries[:4], broken], city_map, FlightParams(single="region", relative_poses="none"))
    errors = [
        pose_error(each.pose, pose).translation_m for each, pose in zip(answer.estimates, poses, strict=True)
    ]
    assert max(errors[:4]) < 1.0
    assert answer.findings["lost"] == ["q4"]
    # Poses rest on edges, not on masks made with the map: nothing is to be said of those.
    assert "notes" not in answer.findings


def test_photos_that_disagree_are_put_where_the_others_say(city_map):
    queries, poses = flight(city_map, count=5, focal=1.0)
    priors = np.array([vector_from_pose(query.prior) for query in queries])
    found = [Estimate(pose, 1.0, probability=0.9) for pose in poses]
    found[1] = Estimate(poses[1].shifted([30.0, 0.0, 0.0]), 1.0, probability=0.9)
    found[3] = QueryFault("nothing in view")
    vectors, trusts = agreed_places(priors, found, FlightParams())
    assert trusts.tolist() == [0.9, 0.1, 0.9, 0.1, 0.9]
    for k, pose in enumerate(poses):
        assert np.linalg.norm(vectors[k, :3] - pose.center) < (1e-6 if trusts[k] > 0.5 else 4.0)


def test_what_is_not_known_is_refused_and_what_is_needed_is_said():
    assert FlightMethod().requires == {"mask"}
    assert FlightMethod(FlightParams(single="region")).requires == {"image"}
    with pytest.raises(ConfigError, match=r"method\.single=regions is not known"):
        FlightParams(single="regions")
    faults = [QueryFault("there is no photo")] * 2
    assert FlightMethod(FlightParams(single="region"))._solve_by_edges([], faults, None).estimates == faults


def textured(city_map, pose, camera, texture):
    """Returns a photo of the town with a pattern that stays where it is on ground, roofs and walls."""
    (normals,) = city_map.normals(camera, pose.rotation[None], pose.center[None])
    (depth,) = city_map.depth(camera, pose.rotation[None], pose.center[None])
    rows, columns = np.indices(depth.shape) + 0.5
    local = np.stack(
        [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(depth.shape)], axis=-1
    )
    rays = local @ pose.rotation
    down = np.minimum(rays[..., 2], -1e-3)
    away = np.where(depth > 0, depth, -pose.center[2] / down)
    points = pose.center + away[..., None] * rays
    # Five texels a metre; walls have it run down them.
    at = (5.0 * (points[..., :2] + points[..., 2:] * [0.6, 0.8]) + 2048.0).astype(np.float32)
    noise = cv2.remap(texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    kinds = np.where((normals != 0).any(axis=-1), np.where(normals[..., 2] > 0.5, 1, 2), 0)
    return np.clip(PAINT[kinds] + noise, 0, 255).astype(np.uint8)


@pytest.mark.slow
def test_photos_whose_priors_err_each_by_itself_are_placed_by_their_edges(city_map, tmp_path):
    """Sensors off by up to 10 m east and north and 30 m in height, from photo to photo."""
    generator, camera, queries, truths = np.random.default_rng(11), CAMERA.scaled(640, 480), [], []
    texture = cv2.GaussianBlur(generator.normal(0.0, 250.0, (4096, 4096, 3)), (0, 0), 4.0)
    for k in range(8):
        # Two strips side by side, over which the camera looks ahead and down.
        place = [22.0 * (k % 4) - 40.0, 30.0 * (k // 4) - 60.0, 118.0 + 3.0 * (k % 3)]
        pose = Pose.from_euler(EulerAngles(28.0 + 2.0 * (k % 2), 0.3, 8.0 - 5.0 * k), place)
        cv2.imwrite(str(tmp_path / f"q{k}.png"), textured(city_map, pose, camera, texture))
        off = generator.uniform(-1.0, 1.0, 6) * [10.0, 10.0, 30.0, 0.5, 0.3, 4.0]
        prior = pose_from_vector(vector_from_pose(pose) + off)
        queries.append(Query(f"q{k}", "all", camera, prior, image=tmp_path / f"q{k}.png", sequence="one"))
        truths.append(pose)
    params = FlightParams(single="region", shared_m=2.0, own_m=10.0, shared_height_m=30.0, restarts=0)
    answer = localize(queries, city_map, params)
    errors = [pose_error(f.pose, t).translation_m for f, t in zip(answer.estimates, truths, strict=True)]
    before = [pose_error(q.prior, t).translation_m for q, t in zip(queries, truths, strict=True)]
    assert np.median(before) > 12.0
    assert max(errors) < 0.7
