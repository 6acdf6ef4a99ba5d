"""Kernels of the engine: sums down the columns and the vector kernels, against plain integer arithmetic."""

from fractions import Fraction
from math import ceil

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numba import njit

from lodbench.citymodel.scene import build_scene
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.kernels import silhouettes as kernels
from lodbench.kernels.arguments import LANES
from lodbench.kernels.simd_kernels import face_triangles, project_vertices
from lodbench.rendering.masks import unpack_mask, words_per_row
from lodbench.rendering.reference import ReferenceRenderer
from lodbench.rendering.silhouette import SilhouetteRenderer, blank_coverage, edge_lists


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


# The guard band, in sub-pixels.
_REACH = 8192 * 256
_POSITION = st.integers(-_REACH, _REACH) | st.integers(-600, 30_000)
_EDGES = st.lists(
    st.tuples(_POSITION, _POSITION, _POSITION, _POSITION, st.integers(-2, 2)), min_size=1, max_size=20
)


@njit
def append_edge(lists, lane, width, ua, va, ub, vb, weight):
    kernels.append_edge(lists, lane, width, ua, va, ub, vb, weight)


@njit
def mark_edges(lists, lane, width, height, marks):
    kernels.mark_edges(lists, lane, width, height, marks)


@njit
def pack_corner(u, v, weight):
    return kernels.pack_corner(u, v, weight)


def _marks_by_fractions(edges, width, height):
    """Raster rule 4 in exact arithmetic: the first row whose centre is at or below the edge."""
    marks = np.zeros((height + 1, width), dtype=np.int64)
    for ua, va, ub, vb, weight in edges:
        if ua > ub:
            ua, va, ub, vb, weight = ub, vb, ua, va, -weight
        for column in range(width):
            u = 256 * column + 128
            if ua <= u < ub:
                v = va + Fraction((u - ua) * (vb - va), ub - ua)
                row = ceil((v - 128) / 256)
                marks[min(max(row, 0), height), column] += weight
    return marks


@settings(max_examples=150)
@given(_EDGES, st.integers(1, 200), st.integers(1, 40), st.integers(0, LANES - 1))
@example([(-_REACH, -_REACH, _REACH, _REACH, 1), (-_REACH, 129, _REACH, 128, -1)], 200, 40, 7)
def test_marks_stand_where_exact_arithmetic_puts_them(edges, width, height, lane):
    lists, coverage = edge_lists(64), blank_coverage(width, height)
    for ua, va, ub, vb, weight in edges:
        append_edge(lists, lane, width, ua, va, ub, vb, weight)
    mark_edges(lists, lane, width, height, coverage.marks)
    assert lists.counts[lane] == 0
    strips = coverage.marks[:-LANES].reshape(-1, height + 1, 64)
    marks = strips.transpose(1, 0, 2).reshape(height + 1, -1)
    np.testing.assert_array_equal(marks[:, :width], _marks_by_fractions(edges, width, height))
    assert not marks[:, width:].any()


@given(st.integers(-(2**23), 2**23 - 1), st.integers(-(2**31), 2**31 - 1), st.integers(-128, 127))
def test_a_packed_corner_holds_all_three_numbers(u, v, weight):
    packed = int(pack_corner(u, v, weight))
    assert packed >> 32 == v
    assert ((packed & 0xFFFFFFFF) ^ 0x80000000) - 0x80000000 >> 24 == weight
    assert ((packed & 0xFFFFFF) ^ 0x800000) - 0x800000 == u


@njit
def _project(x, y, z, poses, intrinsics, u, v, extent, nearest):
    project_vertices(x, y, z, 1, len(x), poses, intrinsics, u, v, extent, nearest)


@njit
def _face(a, b, c, u, v, facing):
    face_triangles(a, b, c, 0, len(a), u, v, facing)


def test_projection_is_the_raster_rule_in_every_lane():
    generator = np.random.default_rng(3)
    points = (generator.random((50, 3)) * 200 - 100).astype(np.float32)
    rotations = np.linalg.qr(generator.normal(size=(LANES, 3, 3)))[0]
    centers = generator.random((LANES, 3)) * 100
    poses = np.concatenate([rotations.reshape(LANES, 9), centers], axis=1).T.ravel().copy()
    fx, fy, cx, cy = intrinsics = np.array([500.5, 480.25, 300.75, 220.125])
    u, v = np.zeros(8 * 49, dtype=np.int32), np.zeros(8 * 49, dtype=np.int32)
    extent, nearest = np.zeros(4 * LANES), np.zeros(LANES)
    _project(*points.T.copy(), poses, intrinsics, u, v, extent, nearest)
    for lane in range(LANES):
        d = points[1:].astype(np.float64) - centers[lane]
        x, y, z = ((r[0] * d[:, 0] + r[1] * d[:, 1]) + r[2] * d[:, 2] for r in rotations[lane])
        columns = np.floor(((fx * x) * (1 / z) + cx) * 256 + 0.5)
        rows = np.floor(((fy * y) * (1 / z) + cy) * 256 + 0.5)
        fits = np.abs(columns) < 2**31
        np.testing.assert_array_equal(u[lane::LANES][fits], columns[fits])
        fits = np.abs(rows) < 2**31
        np.testing.assert_array_equal(v[lane::LANES][fits], rows[fits])
        bounds = (columns.min(), columns.max(), rows.min(), rows.max())
        np.testing.assert_array_equal(extent[lane::LANES], bounds)
        assert nearest[lane] == z.min()


def test_a_vertex_in_the_plane_of_the_camera_is_told_by_its_depth():
    poses = np.repeat(np.concatenate([np.eye(3).ravel(), np.zeros(3)]), LANES)
    point = (np.zeros(2, dtype=np.float32) for _ in range(3))
    u, v = np.zeros(LANES, dtype=np.int32), np.zeros(LANES, dtype=np.int32)
    extent, nearest = np.zeros(4 * LANES), np.ones(LANES)
    _project(*point, poses, np.array([500.0, 500.0, 0.0, 0.0]), u, v, extent, nearest)
    np.testing.assert_array_equal(nearest, 0.0)


@given(st.lists(st.integers(-(2**21), 2**21), min_size=6 * LANES, max_size=6 * LANES))
def test_faces_turn_as_their_exact_area_says(numbers):
    u = np.array(numbers[: 3 * LANES], dtype=np.int32)
    v = np.array(numbers[3 * LANES :], dtype=np.int32)
    facing = np.full(LANES, 7, dtype=np.int32)
    _face(*(np.array([i], dtype=np.uint32) for i in range(3)), u, v, facing)
    (ua, ub, uc), (va, vb, vc) = (u.astype(object).reshape(3, LANES), v.astype(object).reshape(3, LANES))
    area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
    np.testing.assert_array_equal(facing, np.sign(area.astype(np.float64)))
