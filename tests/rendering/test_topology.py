from collections import Counter

import numpy as np
import pytest
from hostile_scenes import box, hostile_scenes, scene_of
from hypothesis import given, settings

from lodbench.rendering.selection import bounding_spheres
from lodbench.rendering.topology import edge_table


def test_a_closed_box_has_eighteen_edges_run_both_ways():
    edges = edge_table(scene_of(box([0, 0, 0], [1, 2, 3])))
    assert edges.starts.tolist() == [0, 18]
    assert (edges.second_weight == -1).all()
    assert (edges.sides[:, 0] != edges.sides[:, 1]).all()


def test_a_box_without_a_floor_has_four_border_edges():
    edges = edge_table(scene_of(box([0, 0, 0], [1, 2, 3], floor=False)))
    border = edges.second_weight == 0
    assert (len(border), border.sum()) == (17, 4)
    assert (edges.sides[border, 0] == edges.sides[border, 1]).all()


@pytest.mark.parametrize("pages", [1, 2, 3, 4, 7])
def test_a_spine_shared_by_many_pages_stands_once_per_pair(pages):
    book = np.array([[[0, 0, 0], [0, 0, 9], [np.cos(a), np.sin(a), 1]] for a in range(pages)])
    edges = edge_table(scene_of(book))
    # Every page runs the spine the same way; an odd page is left without a partner.
    assert Counter(edges.second_weight.tolist())[1] == pages // 2
    assert len(edges.corners) == 2 * pages + (pages + 1) // 2


@settings(max_examples=50)
@given(hostile_scenes())
def test_every_side_of_every_triangle_stands_in_the_table_once(scene):
    expected = Counter(
        (b, *sorted((int(t[k]), int(t[k - 2]))), i)
        for b in range(scene.num_buildings)
        for i, t in enumerate(scene.triangles)
        if scene.triangle_starts[b] <= i < scene.triangle_starts[b + 1]
        for k in range(3)
    )
    edges = edge_table(scene)
    found: Counter = Counter()
    for b in range(scene.num_buildings):
        for e in range(edges.starts[b], edges.starts[b + 1]):
            ends = sorted(map(int, edges.corners[e]))
            found[(b, *ends, int(edges.sides[e, 0]))] += 1
            if edges.second_weight[e]:
                found[(b, *ends, int(edges.sides[e, 1]))] += 1
    assert found == expected


@settings(max_examples=50)
@given(hostile_scenes())
def test_bounding_spheres_hold_their_buildings(scene):
    for b, (x, y, z, radius) in enumerate(bounding_spheres(scene)):
        points = scene.vertices[scene.vertex_starts[b] : scene.vertex_starts[b + 1]].astype(np.float64)
        if len(points):
            assert (np.linalg.norm(points - [x, y, z], axis=1) <= radius).all()
        else:
            assert radius == -np.inf
