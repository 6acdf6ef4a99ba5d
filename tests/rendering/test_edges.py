"""Model edges in a view, against boxes known by heart and rays cast at every place of every edge."""

from collections import Counter

import numpy as np
import pytest
from hostile_scenes import box, hostile_scenes, scene_of
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from lodbench.citymodel.scene import Scene
from lodbench.geometry import Camera, EulerAngles, rotation_from_euler
from lodbench.rendering.edges import EdgeKind, ViewEdges, edge_faces, edge_table, edges_in_view
from lodbench.rendering.projection import bounding_spheres
from lodbench.rendering.raster import RasterRenderer

CAMERA = Camera(320, 240, 300.0, 305.0, 158.0, 121.0)


def look(scene: Scene, angles, center, camera=CAMERA, crease_deg=15.0) -> ViewEdges:
    rotation, center = rotation_from_euler(EulerAngles(*angles)), np.array(center, dtype=np.float64)
    depth = RasterRenderer(scene, 1).depths(camera, rotation[None], center[None])[0]
    buildings = np.arange(scene.num_buildings)
    view = edges_in_view(edge_faces(scene), buildings, camera, (rotation, center), depth, crease_deg)
    # The ends in 3D are those in the picture.
    inside = (view.points - center) @ rotation.T
    u = camera.fx * inside[..., 0] / inside[..., 2] + camera.cx
    v = camera.fy * inside[..., 1] / inside[..., 2] + camera.cy
    np.testing.assert_allclose(view.pixels, np.stack([u, v], axis=2), atol=1e-6)
    assert (view.pixels > -1e-6).all()
    assert (view.pixels < np.array([camera.width, camera.height]) + 1e-6).all()
    return view


def whole(view: ViewEdges, chosen) -> set:
    """Returns the edges that stand undivided, as sets of end points."""
    return {frozenset(tuple(np.round(end, 6)) for end in pair) for pair in view.points[chosen]}


def test_a_box_from_straight_above_shows_its_roof_as_contour():
    view = look(scene_of(box([-5, -5, 0], [10, 10, 8])), (0, 0, 0), (0, 0, 60))
    roof = [(x, y, 8.0) for x, y in ((-5.0, -5.0), (5.0, -5.0), (5.0, 5.0), (-5.0, 5.0))]
    edges = {frozenset((roof[i], roof[(i + 1) % 4])) for i in range(4)}
    assert whole(view, view.is_visible & (view.kind == EdgeKind.CONTOUR)) == edges
    assert not (view.is_visible & (view.kind == EdgeKind.CREASE)).any()


def test_a_box_from_a_corner_shows_nine_edges():
    # Three creases meet at the near corner, six contours run round the box, three edges are behind it.
    rotation = rotation_from_euler(EulerAngles(55.0, 0.0, 40.0))
    view = look(
        scene_of(box([-5, -5, 0], [10, 10, 8])), (55.0, 0.0, 40.0), np.array([0, 0, 4]) - 50 * rotation[2]
    )
    seen = view.is_visible
    assert len(whole(view, seen & (view.kind == EdgeKind.CONTOUR))) == 6
    assert len(whole(view, seen & (view.kind == EdgeKind.CREASE))) == 3
    assert len(view) >= 12
    hidden = view.pixels[~seen]
    length = np.sqrt(((hidden[:, 1] - hidden[:, 0]) ** 2).sum(axis=1))
    assert (length > 10).sum() == 3


def test_what_a_house_stands_before_is_split():
    # The tall box hides the middle of the long one's roof edge.
    scene = scene_of(box([-40, 20, 0], [80, 5, 10]), box([-5, 0, 0], [10, 5, 30]))
    view = look(scene, (80.0, 0.0, 0.0), (0.0, -60.0, 15.0))
    on_edge = (view.building == 0) & (np.abs(view.points[..., 1:] - [20, 10]) < 1e-6).all(axis=(1, 2))
    visible = np.sort(view.points[on_edge & view.is_visible][:, :, 0], axis=1)
    hidden = np.sort(view.points[on_edge & ~view.is_visible][:, :, 0], axis=1)
    assert len(visible) == 2
    assert len(hidden) == 1
    # By the rays over the tall box's front edges: x = 5 at y = 0 is x = 5 * 80 / 60 at y = 20.
    np.testing.assert_allclose(hidden[0], [-5 * 80 / 60, 5 * 80 / 60], atol=0.6)


@pytest.mark.parametrize(("crease_deg", "count"), [(5.0, 1), (30.0, 0)])
def test_a_flat_ridge_is_a_crease_from_its_angle_on(crease_deg, count):
    # Two roofs of 10 degrees meet at 20.
    rise = 10 * np.tan(np.radians(5.0))
    left = [(-10, -8, 0), (0, -8, rise), (0, 8, rise), (-10, 8, 0)]
    right = [(0, -8, rise), (10, -8, 0), (10, 8, 0), (0, 8, rise)]
    triangles = [[quad[i] for i in corners] for quad in (left, right) for corners in ((0, 1, 2), (0, 2, 3))]
    view = look(scene_of(np.array(triangles, dtype=np.float64)), (0, 0, 0), (0, 0, 50), crease_deg=crease_deg)
    creases = view.kind == EdgeKind.CREASE
    assert creases.sum() == count
    # The open rim is a contour, the diagonals of the quadrilaterals are nothing.
    assert (view.kind == EdgeKind.CONTOUR).sum() == 6


@given(st.floats(-170, 170), st.floats(-170, 170), st.floats(1, 89))
def test_a_crease_is_where_planes_meet_at_the_angle_asked_for(left_deg, right_deg, crease_deg):
    # Two faces beside an edge along y, each so many degrees up from the level.
    (x, z), (r, t) = ((np.cos(a), np.sin(a)) for a in np.radians((left_deg, right_deg)))
    bend_deg = abs((left_deg + right_deg + 180.0) % 360.0 - 180.0)
    assume(abs(bend_deg - crease_deg) > 1e-3)
    a, b = (0.0, -8.0, 0.0), (0.0, 8.0, 0.0)
    faces = [[a, b, (-9.0 * x, 1.0, 9.0 * z)], [b, a, (7.0 * r, -2.0, 7.0 * t)]]
    view = look(scene_of(np.array(faces)), (10, 5, 20), (10, -5, 60), crease_deg=crease_deg)
    shared = (np.abs(view.points[..., [0, 2]]) < 1e-9).all(axis=(1, 2))
    is_contour = view.kind[shared] == EdgeKind.CONTOUR
    assert is_contour.all() or is_contour.sum() == 0
    assert shared.any() == (is_contour.any() or bend_deg > crease_deg)


@pytest.mark.parametrize(
    ("third_m", "crease_deg", "is_there"), [(-9, 30, False), (-9, 0, True), (0, 30, True)]
)
def test_all_edges_from_no_angle_on_and_those_of_faces_without_area(third_m, crease_deg, is_there):
    faces = [[(0, -8, 0), (0, 8, 0), (third_m, 1, 0)], [(0, 8, 0), (0, -8, 0), (9, 0, 0)]]
    shared = frozenset({(0.0, -8.0, 0.0), (0.0, 8.0, 0.0)})
    for yaw_deg in (0, 20, 70, 140):
        view = look(
            scene_of(np.array(faces, dtype=np.float64)), (10, 5, yaw_deg), (0, 0, 60), crease_deg=crease_deg
        )
        assert (shared in whole(view, view.kind >= 0)) == is_there


def test_where_three_faces_meet_is_a_crease_however_flat():
    level = [[(0, -8, 0), (0, 8, 0), (-9, 0, 0)], [(0, 8, 0), (0, -8, 0), (9, 0, 0)]]
    below = [[(0, -8, 0), (0, 8, 0), (0, 0, -9)]]
    for faces, count in ((level, 0), (level + below, 1)):
        view = look(scene_of(np.array(faces, dtype=np.float64)), (0, 0, 0), (0, 0, 50), crease_deg=60.0)
        on_edge = (np.abs(view.points[..., [0, 2]]) < 1e-9).all(axis=(1, 2)) & view.is_visible
        assert (view.kind[on_edge] == EdgeKind.CREASE).sum() == count


def hides(scene: Scene, center, point) -> tuple[bool, bool]:
    """Tells whether a triangle crosses the line to a point: well short of it, at all."""
    corners = scene.vertices.astype(np.float64)[scene.triangles] - center
    a, e, g = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    ray = point - center
    h = np.cross(ray, g)
    det = (e * h).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = (-a * h).sum(axis=1) / det
        q = np.cross(-a, e)
        v = (ray * q).sum(axis=1) / det
        t = (g * q).sum(axis=1) / det
    crossed = (np.abs(det) > 1e-12) & (u > 0) & (v > 0) & (u + v < 1) & (t > 0)
    return bool((crossed & (t < 1 - 0.04)).any()), bool((crossed & (t < 1 - 0.002)).any())


@pytest.mark.parametrize("seed", range(5))
def test_against_rays_at_every_place(seed):
    rng = np.random.default_rng(seed)
    boxes = [box(rng.uniform((-40, -40, 0), (30, 30, 0)), rng.uniform(6, 25, 3)) for _ in range(7)]
    scene = scene_of(*boxes)
    rotation = rotation_from_euler(EulerAngles(50.0, 2.0, rng.uniform(-180, 180)))
    center = np.array([0, 0, 5]) - 110 * rotation[2]
    depth = RasterRenderer(scene, 1).depths(CAMERA, rotation[None], center[None])[0]
    view = edges_in_view(edge_faces(scene), np.arange(7), CAMERA, (rotation, center), depth, 15.0)
    length = np.sqrt(((view.pixels[:, 1] - view.pixels[:, 0]) ** 2).sum(axis=1))
    agree = total = 0.0
    for points, is_visible, pixels in zip(view.points, view.is_visible, length, strict=True):
        if pixels < 4:
            continue
        for share in (0.2, 0.4, 0.6, 0.8):
            surely, perhaps = hides(scene, center, points[0] + share * (points[1] - points[0]))
            # Surfaces within a few pixels' footprint of the edge hide nothing, by definition.
            if surely == perhaps:
                total += pixels / 4
                agree += pixels / 4 * (surely != is_visible)
    assert total > 1000
    assert agree / total > 0.95
    assert 0.1 < (length * view.is_visible).sum() / length.sum() < 0.9


def test_edges_behind_the_camera_and_outside_are_left_out():
    scene = scene_of(box([-5, -5, 0], [10, 10, 8]))
    assert len(look(scene, (180, 0, 0), (0, 0, 60))) == 0
    cut = look(scene, (0, 0, 0), (0, 0, 12))
    # So near that the roof's rim is out of the picture; hidden floor edges remain.
    assert not cut.is_visible[np.isclose(cut.points[..., 2], 8).all(axis=1)].any()


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
