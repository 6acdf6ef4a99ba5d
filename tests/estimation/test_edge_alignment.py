"""Poses refined by the edges of roofs: what a photo drawn from the map itself says of them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.estimation.edge_alignment import EdgeLikelihood
from lodbench.estimation.lens import LensErrors
from lodbench.estimation.photo_edges import PhotoEdges
from lodbench.geometry.pose import vector_from_pose
from tests.town import BOXES, CAMERA, box_obj, true_poses

# The published prior's half widths over the square root of 3, and a lens that is held.
SIGMAS = np.array([5.8, 5.8, 17.3, 0.58, 0.58, 4.3, 0.0, 0.0, 0.0, 0.0])
WIDE = CAMERA.scaled(1200, 900)


@pytest.fixture(scope="module")
def city_map(tmp_path_factory):
    path = tmp_path_factory.mktemp("town") / "city.obj"
    path.write_text(box_obj(BOXES))
    return CityMap(open_scene(path), threads=1)


@pytest.fixture(scope="module")
def truth():
    return next(iter(true_poses(1).values()))


def photo_of(city_map, pose, camera=WIDE):
    """Returns a photo in which each face has the shade of its building and direction, with a little noise."""
    view = camera, pose.rotation[None], pose.center[None]
    rows, normals = city_map.buildings(*view)[0], city_map.normals(*view)[0]
    shades = 90.0 + 12.0 * (rows % 7) + 60.0 * normals[..., 2] + 25.0 * normals[..., 0]
    grey = np.where(rows >= 0, shades, 40.0) + np.random.default_rng(1).normal(0.0, 4.0, rows.shape)
    return cv2.cvtColor(np.clip(grey, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)


def edges_of(photo):
    return PhotoEdges(photo, (WIDE.width, WIDE.height))


def metres(found, truth):
    return float(np.linalg.norm((found - vector_from_pose(truth))[:3]))


@pytest.mark.parametrize("seed", range(3))
def test_an_answer_metres_off_is_refined_to_the_edges(city_map, truth, seed):
    away = np.random.default_rng(seed).normal(0.0, 1.0, 6) * (1.0, 1.0, 1.5, 0.2, 0.2, 0.4)
    start = vector_from_pose(truth) + away
    found = EdgeLikelihood(edges_of(photo_of(city_map, truth)), WIDE, city_map, start, SIGMAS).refined(start)
    assert metres(found.vector, truth) < 0.3 * metres(start, truth)
    assert found.evidence > 10.0
    assert found.gain > 5.0
    missed = found.vector - vector_from_pose(truth)
    # Six numbers: more than 22 is less likely than one in a thousand.
    assert missed @ np.linalg.solve(found.covariance, missed) < 22.0


def test_a_focal_length_in_doubt_is_refined_along(city_map, truth):
    photo = photo_of(city_map, truth, LensErrors(focal=0.01).pinhole(WIDE))
    known = np.where(np.arange(10) < 6, 0.02, 0.0)
    start, doubted = vector_from_pose(truth), known + 0.02 * (np.arange(10) == 6)
    free = np.append(np.full(2, 5.8), np.append(known[2:6], doubted[6:]))
    held, refined = (
        EdgeLikelihood(edges_of(photo), WIDE, city_map, start, sigmas)
        for sigmas in (np.append(free[:6], np.zeros(4)), free)
    )
    one, other = held.refined(start), refined.refined(start)
    assert other.evidence > one.evidence + 5.0
    assert metres(other.vector, truth) < metres(one.vector, truth)
    # What the focal length leaves open is part of the covariance.
    assert np.trace(other.covariance) > np.trace(one.covariance)


def test_a_photo_of_nothing_proves_nothing(city_map, truth):
    noise = np.random.default_rng(0).integers(0, 256, (900, 1200, 3), dtype=np.uint8)
    start = vector_from_pose(truth)
    found = EdgeLikelihood(edges_of(noise), WIDE, city_map, start, SIGMAS).refined(start)
    assert found is None or found.evidence < 10.0


def test_pitched_roofs_drawn_as_blocks_are_left_out(city_map, truth):
    scene = replace(city_map.scene, pitched=np.ones(city_map.scene.num_buildings, dtype=bool))
    start = vector_from_pose(truth)
    blocks = CityMap(scene, threads=1)
    assert (
        EdgeLikelihood(edges_of(photo_of(city_map, truth)), WIDE, blocks, start, SIGMAS).refined(start)
        is None
    )
