"""Loose triangles as a scene: the same triangles, each vertex of a group once."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lodbench.rendering.triangle_groups import grouped_scene, triangle_groups


@given(st.integers(0, 2**32 - 1), st.integers(1, 60))
def test_a_scene_has_the_triangles_and_each_vertex_once(seed, count):
    """Corners on whole metres, so that many are shared, within a group and beyond it."""
    rng = np.random.default_rng(seed)
    corners = (rng.integers(-40, 40, (count, 1, 3)) + rng.integers(-1, 2, (count, 3, 3))).astype(np.float64)
    order, starts = triangle_groups(corners)
    corners = corners[order]
    scene = grouped_scene(corners, starts)
    np.testing.assert_array_equal(scene.vertices[scene.triangles], corners)
    np.testing.assert_array_equal(scene.triangle_starts, starts)
    for group in range(scene.num_buildings):
        (v, w), (t, u) = scene.vertex_starts[group : group + 2], starts[group : group + 2]
        expected = np.unique(corners[t:u].reshape(-1, 3), axis=0)
        np.testing.assert_array_equal(scene.vertices[v:w], expected)


def test_neighbours_are_in_one_group_and_far_ones_are_not():
    near, far = np.zeros((2, 3, 3)), np.full((1, 3, 3), 500.0)
    _, starts = triangle_groups(np.concatenate([near, far]))
    assert starts.tolist() == [0, 2, 3]


def test_no_triangle_makes_no_building():
    scene = grouped_scene(np.zeros((0, 3, 3)), np.zeros(1, dtype=np.int64))
    assert (scene.num_buildings, len(scene.vertices), len(scene.triangles)) == (0, 0, 0)
