"""Accumulation: sums down the columns, and the limit of its 16 bits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from lodbench.citymodel.scene import build_scene
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.kernels import coverage as kernels
from lodbench.rendering.bits import unpack_mask, words_per_row
from lodbench.rendering.engine_arrays import blank_coverage
from lodbench.rendering.reference import ReferenceRenderer
from lodbench.rendering.silhouette import SilhouetteRenderer


@njit
def expect_marks(coverage, lane, left, right, top, bottom, width, height):
    return kernels.expect_marks(coverage, lane, left, right, top, bottom, width, height)


@njit
def accumulate(coverage, lane, height, words):
    kernels.accumulate(coverage, lane, height, words)


CAMERA = Camera(70, 50, 40.0, 40.0, 35.0, 25.0)
POSE = Pose.from_euler(EulerAngles(20, 0, 10), (0, 0, 30))


@given(st.integers(1, 130), st.integers(1, 20), st.integers(0, 2**32 - 1))
def test_it_is_a_cumulative_sum_and_clears_up(width, height, seed):
    generator = np.random.default_rng(seed)
    changes = generator.integers(-1, 2, (height, width)) * (generator.random((height, width)) < 0.3)
    coverage = blank_coverage(width, height)
    assert expect_marks(coverage, 3, 0.0, width * 256.0, 0.0, height * 256.0, width, height)
    marks = coverage.marks[:-8].reshape(-1, height + 1, 64)
    for row, column in np.argwhere(changes):
        marks[column // 64, row, column % 64] = changes[row, column]
    words = np.zeros((height, words_per_row(width)), dtype=np.uint64)
    accumulate(coverage, 3, height, words)
    np.testing.assert_array_equal(unpack_mask(words, width), np.cumsum(changes, axis=0) != 0)
    assert not coverage.marks.any()
    assert (coverage.high == -1).all()


def test_bounds_outside_the_view_expect_nothing():
    coverage = blank_coverage(70, 50)
    for bounds in (
        (-900, -1, 0, 900),
        (70 * 256, 90 * 256, 0, 900),
        (0, 900, -900, -1),
        (0, 900, 12_800, 13_000),
    ):
        assert not expect_marks(coverage, 0, *map(float, bounds), 70, 50)
    assert (coverage.high == -1).all()


@pytest.mark.parametrize("buildings", [1, 4])
def test_more_layers_than_16_bits_can_count(buildings):
    """65,536 triangles over one pixel would sum to zero in 16 bits."""
    corners = np.array([[-8.0, -8, 2], [9, -7, 2], [1, 9, 2]])
    total = 65_536
    scene = build_scene(
        corners,
        np.tile([[0, 1, 2]], (total, 1)),
        np.arange(total, dtype=np.int32) * buildings // total,
        tuple(f"b{i}" for i in range(buildings)),
    )
    single = build_scene(corners, np.array([[0, 1, 2]]), np.zeros(1, dtype=np.int32), ("b",))
    expected = ReferenceRenderer(single).render(CAMERA, POSE)
    assert expected.any()
    np.testing.assert_array_equal(SilhouetteRenderer(scene, threads=1).render(CAMERA, POSE), expected)
