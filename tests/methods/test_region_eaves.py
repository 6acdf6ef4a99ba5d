"""Eaves that stand out beyond the map's walls: drawn, and told from photos."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon

from lodbench.citymodel.scene import SceneBuilder
from lodbench.geometry.pose import vector_from_pose
from lodbench.methods.region.roofs import outward_moves
from lodbench.rendering.edges import edge_faces
from tests.methods.test_region_lines import line_fit
from tests.methods.test_region_roofs import FAST, mean_errors, photo_of

# An L of 10 by 10 metres, a point in one of its walls, and triangles of its roof.
CORNERS = np.array([[0, 0], [10, 0], [10, 4], [4, 4], [4, 10], [0, 10], [0, 5]], float)
ROOF = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 6], [3, 4, 6], [4, 5, 6]])


def house(turn_deg, flips):
    """Returns the L as a block 6 m high, turned, its faces oriented as ``flips`` says."""
    turn = np.radians(turn_deg)
    plan = CORNERS @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    count = len(plan)
    points = np.vstack([np.column_stack([plan, np.full(count, z)]) for z in (0.0, 6.0)])
    here, after = np.arange(count), np.roll(np.arange(count), -1)
    below = np.stack([here, after, here + count], 1)
    walls = np.concatenate([below, np.stack([after, after + count, here + count], 1)])
    faces = np.concatenate([ROOF + count, ROOF, walls])
    flipped = np.resize(flips, len(faces))
    faces[flipped] = faces[flipped, ::-1]
    builder = SceneBuilder(("house",))
    builder.add(points, faces, np.zeros(len(faces), np.int64))
    return builder.finish(lod="", crs=None, origin=None), plan


@given(st.floats(0.0, 360.0), st.lists(st.booleans(), min_size=7, max_size=7), st.floats(-1.0, 1.5))
@settings(max_examples=30, deadline=None)
def test_outlines_grow_as_shapely_grows_them(turn_deg, flips, metres):
    """Whatever way the faces are oriented, and with a wall of two pieces."""
    scene, plan = house(turn_deg, flips)
    top = scene.vertices[:, 2] > 3.0
    moved = scene.vertices[:, :2] + metres * outward_moves(edge_faces(scene), len(scene.vertices))
    order = [int(np.argmin(np.linalg.norm(scene.vertices[top][:, :2] - corner, axis=1))) for corner in plan]
    grown = Polygon(moved[top][order])
    expected = Polygon(plan).buffer(metres, join_style="mitre")
    assert grown.is_valid
    assert grown.symmetric_difference(expected).area < 0.03 * abs(metres) + 1e-3


def test_what_no_wall_meets_stays():
    """A flat outline has no eaves."""
    scene, _ = house(20.0, [False])
    flat = replace(scene, triangles=scene.triangles[: len(ROOF)], triangle_starts=np.array([0, len(ROOF)]))
    assert not outward_moves(edge_faces(flat), len(flat.vertices)).any()


def test_roofs_are_drawn_wider_over_the_same_floors(scene, roofs):
    wide = roofs.with_offsets(np.zeros(scene.num_buildings), 0.0, 0.5).at(0).scene
    owner = np.repeat(np.arange(scene.num_buildings), np.diff(scene.vertex_starts))
    floors = np.minimum.reduceat(scene.vertices[:, 2], scene.vertex_starts[:-1])[owner]
    is_floor = scene.vertices[:, 2] == floors
    np.testing.assert_array_equal(wide.vertices[is_floor], scene.vertices[is_floor])
    out = np.linalg.norm(wide.vertices[~is_floor] - scene.vertices[~is_floor], axis=1)
    np.testing.assert_allclose(out, 0.5 * np.sqrt(2.0), rtol=1e-2)


def test_lines_know_how_far_eaves_stand_out(scene, roofs, queries, truths):
    """Photos of a town whose eaves stand out 0.8 m: its lines fit best so wide, from either map."""
    wide = roofs.with_offsets(np.zeros(scene.num_buildings), 0.0, 0.8)
    eaves = np.linspace(-0.4, 2.0, 13)
    for number, (query, truth) in enumerate(zip(queries, truths, strict=True)):
        photo, pose = photo_of(wide.at(0), truth, number), vector_from_pose(truth)
        for seen_of, told_m in ((roofs, 0.0), (wide, 0.8)):
            fit = line_fit(photo, query, seen_of, np.append(pose, [0.0, 0.0, 0.0, told_m]))
            log_likelihood = fit(np.column_stack([np.tile(np.append(pose, [0.0, 0.0, 0.0]), (13, 1)), eaves]))
            assert eaves[int(np.argmax(log_likelihood))] == pytest.approx(0.8, abs=0.41)


@pytest.mark.slow
def test_eaves_that_the_map_lacks_lead_no_answer_astray(scene, city_map, roofs, tmp_path):
    """Photos of a town whose eaves stand out 1.2 m, over the map of its walls."""
    wide = roofs.with_offsets(np.zeros(scene.num_buildings), 0.0, 1.2).at(0)
    told = [replace(FAST, eaves_m=eaves_m) for eaves_m in (0.0, 0.6)]
    trusting, doubting = mean_errors(city_map, wide, told, tmp_path)
    assert doubting < 0.8 * trusting
