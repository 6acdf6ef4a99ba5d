"""Levels of edges by direction, their sums along lines, and means around pixels, against plain numpy."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodbench.geometry import Camera, EulerAngles
from lodbench.geometry.angles import rotation_from_euler
from lodbench.kernels.arguments import DIRECTIONS, EDGE_LEVELS, LinePoints
from lodbench.kernels.photo_edges import count_along_lines, sum_along_lines
from lodbench.methods.region.line_likelihood import line_poses
from lodbench.rendering.photo_bins import directed_edge_levels, gaussian_mean
from lodbench.storage import random_stream


def test_levels_are_equally_full_and_have_the_edge_s_direction():
    rng = np.random.default_rng(0)
    photo = rng.integers(90, 110, (120, 160)).astype(np.uint8)
    photo[:, 80:] += 60
    levels = directed_edge_levels(photo, (160, 120), 1.0)
    assert levels.shape == (120, 160, DIRECTIONS)
    shares = np.bincount(levels.ravel(), minlength=EDGE_LEVELS) / levels.size
    np.testing.assert_allclose(shares, 1.0 / EDGE_LEVELS, atol=0.01)
    on = levels[20:100, 79:81]
    assert on[..., 0].mean() > 14.0
    assert on[..., 0].mean() > on[..., DIRECTIONS // 2].mean() + 4.0


def test_exposure_and_colours_of_grey_change_no_level():
    photo = np.random.default_rng(1).integers(0, 120, (60, 80)).astype(np.uint8)
    grey = directed_edge_levels(photo, (80, 60), 1.0)
    np.testing.assert_array_equal(
        grey, directed_edge_levels(np.repeat(photo[..., None], 3, 2), (80, 60), 1.0)
    )


def test_sums_are_those_of_points_one_by_one():
    rng = np.random.default_rng(2)
    camera = Camera(96, 64, 80.0, 79.0, 47.0, 33.0)
    levels = rng.integers(0, EDGE_LEVELS, (64, 96, DIRECTIONS)).astype(np.uint8)
    points = rng.uniform((-30, -30, -2), (30, 30, 20), (50, 2, 3))
    kinds, buildings = rng.integers(0, 2, 50), rng.integers(0, 4, 50)
    rises, lifts, outward = rng.random((50, 2)), rng.random((50, 2)), rng.normal(size=(50, 2))
    of_all_m, own_m = np.array([[0.0, 0.4, 0.6], [2.5, -1.2, -0.3]]), np.array([-1.0, 0.0, 1.5])
    worth = rng.normal(size=(2, EDGE_LEVELS))
    centers = np.array([[0.0, 0.0, 60.0], [3.0, -2.0, 55.0]])
    rotations = np.stack([rotation_from_euler(EulerAngles(p, 1.0, 20.0)) for p in (0.0, 25.0)])
    lines, view = LinePoints(points, rises, lifts, outward, kinds, buildings), (rotations, centers, of_all_m)
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)

    flat = levels.ravel(), levels.shape

    def seen(place, n):
        x, y, z = rotations[n] @ (place - centers[n])
        return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])

    for offset in (0.0, 3.0):
        counts, expected = np.zeros((2, 2, 2, 4, 3, EDGE_LEVELS), dtype=np.int64)
        for n in range(2):
            one = (each[n : n + 1] for each in view)
            count_along_lines(lines, line_poses(*one), intrinsics, *flat, offset, own_m, counts[n])
        for n, i, d in np.ndindex(2, 50, 3):
            roofs_m, feet_m, eaves_m = of_all_m[n]
            first, second = points[i] + np.outer(rises[i] * roofs_m + lifts[i] * feet_m, [0.0, 0.0, 1.0])
            first[:2], second[:2] = first[:2] + eaves_m * outward[i], second[:2] + eaves_m * outward[i]
            along = seen(second, n) - seen(first, n)
            angle = np.arctan2(along[0], -along[1])
            place = first + np.array([0.0, 0.0, rises[i, 0] * own_m[d]])
            u, v = seen(place, n) + offset * np.array([np.cos(angle), np.sin(angle)])
            if 0 <= u < 96 and 0 <= v < 64:
                direction = int(np.floor(angle / np.pi * DIRECTIONS + 0.5)) % DIRECTIONS
                expected[n, kinds[i], buildings[i], d, levels[int(v), int(u), direction]] += 1
        np.testing.assert_array_equal(counts, expected)
        assert counts.sum(axis=(1, 4)).any(axis=1).all()
        if offset == 0.0:
            sums = np.zeros((2, 4, 3))
            sum_along_lines(lines, line_poses(*view), intrinsics, *flat, own_m, worth, sums)
            np.testing.assert_allclose(sums, np.einsum("nkbdl,kl->nbd", counts, worth), atol=1e-9)


@pytest.mark.parametrize("size", [(301, 224), (640, 480), (961, 719)])
@pytest.mark.parametrize("share", [8.0, 12.0])
def test_it_is_the_blur_to_a_fiftieth(size, share):
    width, height = size
    noise = random_stream(0, "mean around", width).random((height, width)).astype(np.float32)
    picture = noise + np.linspace(0.0, 2.0, width, dtype=np.float32) ** 2
    picture[: height // 3] += 1.0
    expected = cv2.GaussianBlur(picture, (0, 0), width / share)
    apart = np.abs(gaussian_mean(picture, width / share) - expected) / picture.std()
    assert apart.max() < 0.025
    assert apart.mean() < 0.003


@given(st.integers(1, 40), st.integers(1, 40), st.floats(0.5, 200.0))
def test_of_an_even_picture_of_any_size_it_is_the_picture(height, width, sigma_px):
    picture = np.full((height, width), 0.25, dtype=np.float32)
    np.testing.assert_allclose(gaussian_mean(picture, sigma_px), picture, atol=1e-5)
