"""Parts of the engine: scenes laid out and kept, buildings selected, kernels; against plain arithmetic."""

from fractions import Fraction
from math import ceil

import numpy as np
import pytest
from hostile_scenes import box, scene_of
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numba import njit

from lodbench.citymodel.scene import build_scene
from lodbench.citymodel.scene_file import read_scene, write_scene
from lodbench.geometry import Camera, EulerAngles, Pose, rotation_from_euler, rotations_at_yaws
from lodbench.kernels import silhouettes as kernels
from lodbench.kernels.arguments import LANES
from lodbench.kernels.projection import visible_buildings
from lodbench.kernels.simd_kernels import face_triangles, project_vertices
from lodbench.rendering import silhouette
from lodbench.rendering.masks import unpack_mask, words_per_row
from lodbench.rendering.projection import select_buildings, sphere_tree, view_planes
from lodbench.rendering.reference import ReferenceRenderer
from lodbench.rendering.silhouette import (
    SilhouetteRenderer,
    arrays_folder,
    blank_coverage,
    edge_lists,
    open_arrays,
    scene_arrays,
)


@njit
def expect_marks(coverage, lane, left, right, top, bottom, width, height):
    return kernels.expect_marks(coverage, lane, left, right, top, bottom, width, height)


@njit
def accumulate(coverage, lane, height, words):
    kernels.accumulate(coverage, lane, height, words)


SMALL = Camera(70, 50, 40.0, 40.0, 35.0, 25.0)
SMALL_POSE = Pose.from_euler(EulerAngles(20, 0, 10), (0, 0, 30))


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
    expected = ReferenceRenderer(single).render(SMALL, SMALL_POSE)
    assert expected.any()
    np.testing.assert_array_equal(SilhouetteRenderer(scene, threads=1).render(SMALL, SMALL_POSE), expected)


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


CAMERA = Camera(129, 96, 90.0, 89.0, 64.0, 49.0)
POSE = Pose.from_euler(EulerAngles(35, 1, 20), (40, 0, 110))


@pytest.fixture
def stored(tmp_path, monkeypatch):
    """A scene mapped from disk, of a size that counts as large, and an empty cache."""
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(silhouette, "_STORED_FROM_TRIANGLES", 20)
    write_scene(scene_of(*(box([30 * i, 0, 0], [20, 14, 9 + i]) for i in range(5))), tmp_path / "scene")
    return read_scene(tmp_path / "scene")[0]


def forbidden(scene):
    raise AssertionError("it was laid out again")


def test_laid_out_once_and_mapped_ever_after(stored, monkeypatch):
    plain = silhouette.scene_arrays(stored)
    first = open_arrays(stored)
    monkeypatch.setattr(silhouette, "scene_arrays", forbidden)
    for arrays in (first, open_arrays(stored)):
        for name, array in arrays._asdict().items():
            assert type(array) is np.ndarray
            assert isinstance(array.base, np.memmap)
            assert not array.flags.writeable
            assert array.dtype == getattr(plain, name).dtype
            np.testing.assert_array_equal(array, getattr(plain, name))


def test_the_same_pictures(stored):
    in_memory = SilhouetteRenderer(scene_of(*(box([30 * i, 0, 0], [20, 14, 9 + i]) for i in range(5))), 1)
    drawn = in_memory.render(CAMERA, POSE)
    assert 0.01 < drawn.mean() < 0.9
    for _ in range(2):
        engine = SilhouetteRenderer(stored, 1)
        np.testing.assert_array_equal(engine.render(CAMERA, POSE), drawn)
        counts = engine.counts(CAMERA, POSE.rotation[None], POSE.center[None], drawn)
        assert counts.intersection[0] == counts.union[0] == drawn.sum()


def test_small_scenes_and_those_in_memory_are_not_kept(stored, monkeypatch, tmp_path):
    open_arrays(scene_of(*(box([30 * i, 0, 0], [20, 14, 9]) for i in range(5))))
    monkeypatch.setattr(silhouette, "_STORED_FROM_TRIANGLES", 1000)
    open_arrays(stored)
    assert not (tmp_path / "cache").exists()


def test_other_content_has_another_place(stored, tmp_path):
    write_scene(scene_of(*(box([31 * i, 0, 0], [20, 14, 9]) for i in range(5))), tmp_path / "other")
    assert arrays_folder(read_scene(tmp_path / "other")[0]) != arrays_folder(stored)


@pytest.mark.parametrize("name", ["tail", "nodes", "starts"])
def test_a_damaged_file_is_made_anew(stored, name):
    open_arrays(stored)
    file = arrays_folder(stored) / f"{name}.npy"
    whole = file.read_bytes()
    flipped = whole[:-1] + bytes([whole[-1] ^ 1])
    for content in (flipped, whole[:-8], b"", None):
        file.unlink()
        if content is not None:
            file.write_bytes(content)
        open_arrays(stored)
        assert file.read_bytes() == whole


def test_a_cache_that_cannot_be_written_costs_nothing(stored, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "file"))
    assert open_arrays(stored).x.tolist() == stored.vertices[:, 0].tolist()


PLANES = view_planes(CAMERA, 0, CAMERA.width)


def spheres_of(rng, count, extent):
    spheres = rng.uniform([-extent, -extent, 0, 1], [extent, extent, 30, 25], (count, 4))
    spheres[rng.random(count) < 0.05] = -np.inf  # buildings without a triangle
    return spheres


def view(rng, extent):
    angles = EulerAngles(rng.uniform(0, 100), rng.uniform(-5, 5), rng.uniform(-180, 180))
    return rotation_from_euler(angles), rng.uniform([-extent, -extent, 2], [extent, extent, 160])


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 64, 65, 700])
class TestSelection:
    def test_one_view_s_is_what_its_spheres_say(self, count):
        rng = np.random.default_rng(count)
        spheres = spheres_of(rng, count, 900.0)
        tree = sphere_tree(spheres)
        for _ in range(40):
            rotation, center = view(rng, 900.0)
            chosen = select_buildings(tree, rotation[None], center[None], PLANES)
            filled = np.isfinite(spheres[:, 3])
            seen = [b for b in visible_buildings(spheres, rotation, center, PLANES) if filled[b]]
            assert len(set(chosen)) == len(chosen)
            assert set(seen) <= set(chosen)
            # Rounding may add a building, seldom and at the edge.
            assert len(chosen) <= len(seen) + 1

    def test_a_batch_s_holds_what_each_view_sees(self, count):
        rng = np.random.default_rng(count + 1)
        spheres = spheres_of(rng, count, 500.0)
        tree = sphere_tree(spheres)
        for apart_m, apart_deg in ((0.0, 180.0), (5.0, 3.0), (80.0, 0.0)):
            _, center = view(rng, 300.0)
            rotations = rotations_at_yaws(45.0, 1.0, rng.uniform(-apart_deg, apart_deg, 13))
            centers = center + rng.uniform(-apart_m, apart_m, (13, 3))
            chosen = set(select_buildings(tree, rotations, centers, PLANES))
            for r, c in zip(rotations, centers, strict=True):
                seen = visible_buildings(spheres, r, c, PLANES)
                assert chosen >= {b for b in seen if np.isfinite(spheres[b, 3])}


def test_the_cost_does_not_grow_with_the_city():
    # Nodes far from the view are spoilt: a selection that looked below them would choose them.
    rng = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.arange(200) * 40.0, np.arange(200) * 40.0), axis=2).reshape(-1, 2)
    spheres = np.column_stack([grid, np.full(len(grid), 8.0), rng.uniform(5, 15, len(grid))])
    tree = sphere_tree(spheres)
    rotation, center = rotation_from_euler(EulerAngles(30, 0, 0)), np.array([4000.0, 4000.0, 120.0])
    chosen = select_buildings(tree, rotation[None], center[None], PLANES)
    assert 5 < len(chosen) < 100
    spoilt = tree._replace(nodes=tree.nodes.copy())
    distance = np.linalg.norm(spheres[tree.order, :2] - center[:2], axis=1)
    far = np.flatnonzero(distance > 1500.0)
    assert len(far) > 0.8 * len(grid)
    spoilt.nodes[far, 3] = np.inf
    assert select_buildings(spoilt, rotation[None], center[None], PLANES).tolist() == chosen.tolist()


def test_close_ones_lie_close_in_the_order():
    grid = np.stack(np.meshgrid(np.arange(64) * 30.0, np.arange(64) * 30.0), axis=2).reshape(-1, 2)
    shuffled = np.random.default_rng(0).permutation(grid)
    spheres = np.column_stack([shuffled, np.zeros(len(grid)), np.ones(len(grid))])
    tree = sphere_tree(spheres)
    # 512 buildings to a node of the third level, a square of 23 x 23 of them if well placed.
    assert np.median(tree.nodes[tree.levels[3] : tree.levels[4], 3]) < 1.6 * 30 * 23 / 2


def test_a_scene_laid_out_in_parts_is_the_same(monkeypatch):
    rng = np.random.default_rng(4)
    needle = np.array([[[5.0, 5.0, 5.0], [5.0, 5.0, 5.0], [6.0, 5.0, 5.0]]])  # loses all its triangles
    town = [box([30 * i, 0, 0], rng.uniform(8, 24, 3), floor=bool(i % 2)) for i in range(9)]
    scene = scene_of(needle, *town[:4], needle, needle, *town[4:], needle)
    whole = scene_arrays(scene)
    for size in (1, 7, 25, 1000):
        monkeypatch.setattr(silhouette, "_CHUNK_TRIANGLES", size)
        for name, array in scene_arrays(scene)._asdict().items():
            assert array.dtype == getattr(whole, name).dtype, name
            np.testing.assert_array_equal(array, getattr(whole, name), err_msg=name)


def test_zero_visible_buildings():
    engine = SilhouetteRenderer(scene_of(box([-3, -3, 0], [6, 6, 9]), box([20, 0, 0], [6, 6, 9])), 1)
    away = Pose.from_euler(EulerAngles(80, 0, 0), (0, 500, 40))
    assert not engine.render(CAMERA, away).any()
    mask = engine.render(CAMERA, Pose.from_euler(EulerAngles(10, 0, 0), (0, 0, 60)))
    counts = engine.counts(CAMERA, away.rotation[None], away.center[None], mask)
    assert (counts.intersection[0], counts.union[0]) == (0, mask.sum())
    assert mask.sum() > 0
