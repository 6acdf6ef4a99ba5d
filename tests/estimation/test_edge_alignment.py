"""Edges of a photo across lines, to a tenth of a pixel, and poses refined by them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.estimation.edge_alignment import Candidates, EdgeLikelihood, LensErrors, PhotoEdges
from lodbench.geometry.pose import vector_from_pose
from tests.town import BOXES, CAMERA, box_obj, true_poses

# So wide that strengths are of the same surroundings on both sides of an edge.
SIZE = 600, 160
# How many parts of a pixel a drawn edge is averaged over.
_PARTS = 16


def step_edge(normal, distance, low=70.0, high=170.0, width_px=np.inf):
    """Returns a photo that is bright beyond a line, exact to a sixteenth of a pixel, or in a strip only.

    Args:
        normal: Unit, across the line.
        distance: Of the line from the origin along the normal, pixels.
        low: Grey level before.
        high: And beyond.
        width_px: Of the strip.
    """
    parts = (np.arange(_PARTS * SIZE[0]) + 0.5) / _PARTS, (np.arange(_PARTS * SIZE[1]) + 0.5) / _PARTS
    along = parts[0][None, :] * normal[0] + parts[1][:, None] * normal[1] - distance
    shares = ((along > 0) & (along < width_px)).reshape(SIZE[1], _PARTS, SIZE[0], _PARTS).mean(axis=(1, 3))
    return np.rint(low + (high - low) * shares).astype(np.uint8)


def line_beside(normal, distance, aside_px, count=21):
    """Returns points and normals of a line parallel to the edge through the picture's middle."""
    normal = np.asarray(normal)
    middle = np.array(SIZE) / 2.0
    middle = middle + (distance - aside_px - middle @ normal) * normal
    along = np.linspace(-25.0, 25.0, count)[:, None] * [-normal[1], normal[0]]
    return middle + along, np.tile(normal, (count, 1))


def turned(degrees):
    return np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])


@pytest.mark.parametrize("degrees", [0.0, 90.0, 37.0])
@pytest.mark.parametrize("offset", [0.0, 0.3, 0.71])
def test_an_edge_is_found_to_a_tenth_of_a_pixel_from_wherever_a_line_begins(degrees, offset):
    normal = turned(degrees)
    distance = np.array(SIZE) / 2.0 @ normal + offset
    edges = PhotoEdges(step_edge(normal, distance), SIZE)
    for aside_px in (-9.8, -4.3, 0.0, 1.6, 9.8):
        pixels, normals = line_beside(normal, distance, aside_px)
        found = edges.across(pixels, normals, 10.0)
        np.testing.assert_array_equal(found.points, np.arange(len(pixels)))
        assert np.abs(found.distances - aside_px).max() < 0.11
        assert (found.strengths > 1.0).all()
    # Laid the other way round, a line has the edge on the other side.
    pixels, normals = line_beside(normal, distance, 4.3)
    assert np.abs(edges.across(pixels, -normals, 10.0).distances + 4.3).max() < 0.11
    # Beyond reach there is none.
    pixels, normals = line_beside(normal, distance, 25.0)
    assert len(edges.across(pixels, normals, 10.0).points) == 0


@pytest.mark.parametrize(("degrees", "is_found"), [(15.0, True), (-15.0, True), (35.0, False), (80.0, False)])
def test_edges_that_cross_a_line_are_none_of_it(degrees, is_found):
    pixels, normals = line_beside(turned(0.0), SIZE[0] / 2.0, 2.0, count=5)
    edges = PhotoEdges(step_edge(turned(degrees), np.array(SIZE) / 2.0 @ turned(degrees)), SIZE)
    # Near the picture's middle the edge is in reach of all of these.
    pixels = pixels.mean(axis=0) + 0.1 * (pixels - pixels.mean(axis=0))
    found = edges.across(pixels, normals, 10.0)
    assert len(found.points) == (len(pixels) if is_found else 0)


def test_a_strip_has_an_edge_on_either_side_and_the_nearer_is_the_likelier():
    normal, distance = turned(0.0), 300.0
    edges = PhotoEdges(step_edge(normal, distance, width_px=12.0), SIZE)
    pixels, normals = line_beside(normal, distance, -2.0)
    found = edges.across(pixels, normals, 16.0)
    assert len(found.points) == 2 * len(pixels)
    np.testing.assert_allclose(found.distances.reshape(-1, 2), [[-2.0, 10.0]] * len(pixels), atol=0.15)
    np.testing.assert_allclose(found.nearest(len(pixels)), 2.0, atol=0.15)
    near, chances = found.expected(len(pixels), 1.2)
    np.testing.assert_allclose(near, -2.0, atol=0.15)
    assert (chances > 0.5).all()


def test_what_is_expected_of_two_candidates_is_their_mean_by_likelihood():
    candidates = Candidates(np.array([0, 0, 2]), np.array([-1.0, 3.0, 4.0]), np.array([1.0, 3.0, 2.0]))
    means, chances = candidates.expected(4, 2.0)
    one, other = np.exp(-0.125), 3.0 * np.exp(-1.125)
    third, none = 2.0 * np.exp(-2.0), np.exp(-2.0)
    np.testing.assert_allclose(means, [(3.0 * other - one) / (one + other), 0.0, 4.0, 0.0])
    sums = np.array([one + other, 0.0, third, 0.0])
    np.testing.assert_allclose(chances, sums / (sums + none))
    np.testing.assert_array_equal(candidates.nearest(4), [1.0, np.inf, 4.0, np.inf])


def test_colours_of_one_brightness_make_an_edge_and_an_even_photo_none():
    normal, distance = turned(20.0), 330.0
    shares = step_edge(normal, distance, 0.0, 255.0) / 255.0
    colours = cv2.cvtColor(np.array([[[60, 60, 0], [60, -60, 0]]], np.float32), cv2.COLOR_LAB2BGR)[0]
    photo = np.rint(255 * (colours[0] + shares[..., None] * (colours[1] - colours[0]))).astype(np.uint8)
    pixels, normals = line_beside(normal, distance, 3.0)
    found = PhotoEdges(photo, SIZE).across(pixels, normals, 8.0)
    np.testing.assert_array_equal(np.unique(found.points), np.arange(len(pixels)))
    assert np.abs(found.nearest(len(pixels)) - 3.0).max() < 0.5
    even = PhotoEdges(np.full((SIZE[1], SIZE[0]), 120, np.uint8), SIZE)
    assert len(even.across(pixels, normals, 8.0).points) == 0
    # Nor does one begin where the picture ends, within reach of a line outside.
    outside, across = line_beside(turned(0.0), 0.0, 3.0)
    assert len(even.across(outside, across, 8.0).points) == 0


@pytest.mark.parametrize("count", [0, 70_000])
def test_any_number_of_points(count):
    photo = np.zeros((60, 80), np.uint8)
    photo[:, 40:] = 200
    pixels, normals = np.tile([36.5, 30.5], (count, 1)), np.tile([1.0, 0.0], (count, 1))
    found = PhotoEdges(photo, (80, 60)).across(pixels, normals, 8.0)
    np.testing.assert_array_equal(np.unique(found.points), np.arange(count))
    np.testing.assert_allclose(found.distances, 3.5, atol=0.3)


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
    assert found.log_ratio_to_background > 10.0
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
    assert other.log_ratio_to_background > one.log_ratio_to_background + 5.0
    assert metres(other.vector, truth) < metres(one.vector, truth)
    # What the focal length leaves open is part of the covariance.
    assert np.trace(other.covariance) > np.trace(one.covariance)


def test_a_photo_of_nothing_proves_nothing(city_map, truth):
    noise = np.random.default_rng(0).integers(0, 256, (900, 1200, 3), dtype=np.uint8)
    start = vector_from_pose(truth)
    found = EdgeLikelihood(edges_of(noise), WIDE, city_map, start, SIGMAS).refined(start)
    assert found is None or found.log_ratio_to_background < 10.0


def test_pitched_roofs_drawn_as_blocks_are_left_out(city_map, truth):
    scene = replace(city_map.scene, pitched=np.ones(city_map.scene.num_buildings, dtype=bool))
    start = vector_from_pose(truth)
    blocks = CityMap(scene, threads=1)
    assert (
        EdgeLikelihood(edges_of(photo_of(city_map, truth)), WIDE, blocks, start, SIGMAS).refined(start)
        is None
    )
