"""The map draws what the renderers draw, however many poses are asked for at a time, and counts them."""

import threading
from dataclasses import fields, replace

import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymap.city_map import corrected_map
from lodbench.citymodel import open_scene
from lodbench.citymodel.scene import Scene, build_scene
from lodbench.citymodel.textured_map import TexturedMesh
from lodbench.errors import ConfigError, RenderingError
from lodbench.geometry import Camera, EulerAngles, Pose, rotation_from_euler
from lodbench.rendering import BoundaryFit, IouFit
from lodbench.rendering.masks import unpack_mask
from lodbench.rendering.raster import RasterRenderer
from lodbench.rendering.reference import ReferenceRenderer
from tests.town import CAMERA as TOWN_CAMERA
from tests.town import box_obj, true_poses

CAMERA = Camera(121, 90, 95.0, 97.0, 60.2, 44.1)
# West, south, east, north, base, top, metres.
_BLOCKS = (
    (-40, -30, -12, -8, 0, 14),
    (-6, -22, 16, 2, 0, 31),
    (22, -15, 45, 30, 2, 9),
    (-35, 6, -8, 34, 0, 20),
)
# A block's corners count x, y, z in binary; no floor, walls and roof run outwards.
_FACES = ((0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5), (1, 5, 7, 3))


def blocks_scene(blocks=_BLOCKS) -> Scene:
    """Returns upright blocks, one building each."""
    corners = [(x, y, z) for w, s, e, n, b, t in blocks for x in (w, e) for y in (s, n) for z in (b, t)]
    faces = np.concatenate([8 * k + np.array(_FACES) for k in range(len(blocks))])
    building = np.repeat(np.arange(len(blocks), dtype=np.int32), 2 * len(_FACES))
    names = tuple(f"block {k}" for k in range(len(blocks)))
    points = np.array(corners, dtype=np.float64)
    return build_scene(points, faces[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3), building, names)


def poses_around(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Returns (N, 3, 3) rotations and (N, 3) centres of views that see some of the blocks."""
    rng = np.random.default_rng(seed)
    angles = [EulerAngles(*rng.uniform((0, -5, -180), (45, 5, 180))) for _ in range(count)]
    rotations = np.array([rotation_from_euler(angle) for angle in angles])
    ahead = rotations[:, 2]
    targets = rng.uniform((-25, -20, 0), (25, 20, 10), (count, 3))
    return rotations, targets - ahead * rng.uniform(60, 120, (count, 1))


COUNT = 11
ROTATIONS, CENTERS = poses_around(COUNT)
POSES = [Pose.from_center(r, c) for r, c in zip(ROTATIONS, CENTERS, strict=True)]
KINDS = ("silhouettes", "depth", "normals", "buildings", "colour")


@pytest.fixture(scope="module")
def scene():
    return blocks_scene()


@pytest.fixture(scope="module")
def city_map(scene):
    return CityMap(scene, threads=2)


def test_silhouettes_are_the_references(city_map, scene):
    words = city_map.silhouettes(CAMERA, ROTATIONS, CENTERS)
    reference = ReferenceRenderer(scene)
    drawn = [unpack_mask(view, CAMERA.width) for view in words]
    expected = [reference.render(CAMERA, pose) for pose in POSES]
    np.testing.assert_array_equal(drawn, expected)
    assert all(mask.any() for mask in expected)


@pytest.mark.parametrize("name", ["silhouette", "reference", "raster"])
def test_counts_and_fits_are_those_of_the_silhouettes(scene, name):
    city_map = CityMap(scene, name, threads=1)
    words = CityMap(scene).silhouettes(CAMERA, ROTATIONS, CENTERS)
    masks = np.array([unpack_mask(view, CAMERA.width) for view in words])
    query = masks[3]
    counts = city_map.counts(CAMERA, ROTATIONS, CENTERS, query)
    assert counts.intersection.tolist() == (masks & query).sum(axis=(1, 2)).tolist()
    assert counts.union.tolist() == (masks | query).sum(axis=(1, 2)).tolist()
    np.testing.assert_array_equal(city_map.fit(CAMERA, ROTATIONS, CENTERS, IouFit(query)), counts.iou())
    fit = BoundaryFit(query)
    np.testing.assert_array_equal(city_map.fit(CAMERA, ROTATIONS, CENTERS, fit), fit(words))
    np.testing.assert_array_equal(city_map.silhouettes(CAMERA, ROTATIONS, CENTERS), words)


def test_depth_normals_and_buildings_are_the_rasters(city_map, scene):
    raster = RasterRenderer(scene, 1)
    depths = city_map.depth(CAMERA, ROTATIONS, CENTERS)
    normals = city_map.normals(CAMERA, ROTATIONS, CENTERS)
    buildings = city_map.buildings(CAMERA, ROTATIONS, CENTERS)
    for pose, depth, normal, building in zip(POSES, depths, normals, buildings, strict=True):
        layers = raster.draw(CAMERA, pose)
        np.testing.assert_array_equal(depth, layers.depth)
        np.testing.assert_array_equal(normal, layers.normal)
        np.testing.assert_array_equal(building, layers.building)


def test_depth_straight_down_is_the_height_above_each_roof(city_map):
    rotation = rotation_from_euler(EulerAngles(0.0, 0.0, 0.0))
    depth = city_map.depth(CAMERA, rotation[None], np.array([[0.0, 0.0, 100.0]]))[0]
    # Nothing but the flat roofs of the four blocks, and no wall seen edge-on from above its foot.
    for top in (14.0, 31.0, 9.0, 20.0):
        assert (np.abs(depth - (100.0 - top)) < 1e-4).any()
    assert depth[depth > 0].min() > 68.9
    assert depth.max() <= 100.0


@pytest.mark.parametrize("kind", KINDS)
def test_batches_and_threads_change_nothing(city_map, scene, kind):
    whole = getattr(city_map, kind)(CAMERA, ROTATIONS, CENTERS)
    alone = CityMap(scene, threads=1)
    single = [getattr(alone, kind)(CAMERA, ROTATIONS[[i]], CENTERS[[i]])[0] for i in range(COUNT)]
    np.testing.assert_array_equal(whole, single)


def test_a_smaller_camera_after_a_larger_leaves_nothing_behind(scene):
    # Each thread keeps its buffer.
    city_map = CityMap(scene, threads=1)
    small = CAMERA.scaled(64, 48)
    city_map.depth(CAMERA, ROTATIONS, CENTERS)
    again = city_map.depth(small, ROTATIONS, CENTERS)
    np.testing.assert_array_equal(again, CityMap(scene, threads=1).depth(small, ROTATIONS, CENTERS))


def test_instances_unite_to_the_silhouette(city_map):
    words = city_map.silhouettes(CAMERA, ROTATIONS, CENTERS)
    views = city_map.instances(CAMERA, ROTATIONS, CENTERS)
    for view, instances in zip(words, views, strict=True):
        union = np.zeros((CAMERA.height, CAMERA.width), dtype=bool)
        for _, mask in instances.masks():
            union |= mask
        np.testing.assert_array_equal(union, unpack_mask(view, CAMERA.width))


def test_visible_edges_lie_on_depth_and_hidden_ones_behind_it(city_map):
    depths = city_map.depth(CAMERA, ROTATIONS, CENTERS)
    views = city_map.edges(CAMERA, ROTATIONS, CENTERS)
    lengths = {True: 0.0, False: 0.0}
    for pose, depth, view in zip(POSES, depths, views, strict=True):
        middle = view.points.mean(axis=1)
        z = (middle - pose.center) @ pose.rotation[2]
        column, row = np.floor(view.pixels.mean(axis=1)).astype(int).T
        # 1 / z is linear along the picture's line, so its middle is at or before the edge's middle.
        behind = depth[np.clip(row, 0, 89), np.clip(column, 0, 120)]
        hidden = ~view.is_visible
        assert (behind[hidden] < 1.05 * z[hidden]).mean() > 0.9
        pixels = np.sqrt(((view.pixels[:, 1] - view.pixels[:, 0]) ** 2).sum(axis=1))
        for seen in (True, False):
            lengths[seen] += pixels[view.is_visible == seen].sum()
    assert lengths[True] > lengths[False] > 0


def test_colour_differs_between_buildings_and_sky(city_map):
    colours = city_map.colour(CAMERA, ROTATIONS, CENTERS)
    depths = city_map.depth(CAMERA, ROTATIONS, CENTERS)
    assert colours.shape == (COUNT, CAMERA.height, CAMERA.width, 3)
    seen = depths > 0
    assert colours[seen].std() > 10
    assert np.abs(colours[seen].mean(axis=0) - colours[~seen].mean(axis=0)).max() > 20


@pytest.mark.parametrize("kind", KINDS)
def test_no_pose_gives_nothing(city_map, kind):
    found = getattr(city_map, kind)(CAMERA, np.zeros((0, 3, 3)), np.zeros((0, 3)))
    assert len(found) == 0
    assert found.shape[1] == CAMERA.height


@pytest.mark.parametrize("kind", [*KINDS, "instances"])
def test_a_pose_that_is_not_finite_is_told(city_map, kind):
    centers = CENTERS.copy()
    centers[2, 1] = np.nan
    with pytest.raises(RenderingError, match="Pose 2 of 11"):
        getattr(city_map, kind)(CAMERA, ROTATIONS, centers)


def test_an_unknown_renderer_is_told(scene):
    with pytest.raises(ConfigError, match="silhouete"):
        CityMap(scene, "silhouete")


@pytest.mark.parametrize("name", ["silhouette", "raster", "reference"])
def test_with_other_vertices_it_is_the_map_of_those(scene, name):
    moves = np.random.default_rng(5).uniform(-3.0, 3.0, scene.vertices.shape).astype(np.float32)
    before = CityMap(scene, name, threads=2)
    before.edges(CAMERA, ROTATIONS[:1], CENTERS[:1])
    moved, anew = before.with_vertices(scene.vertices + moves), CityMap(moved_by(scene, moves), threads=2)
    for kind in KINDS:
        shown, expected = (getattr(each, kind)(CAMERA, ROTATIONS, CENTERS) for each in (moved, anew))
        np.testing.assert_array_equal(shown, expected)
        assert (shown != getattr(before, kind)(CAMERA, ROTATIONS, CENTERS)).any()
    for shown, expected in zip(
        *(each.edges(CAMERA, ROTATIONS, CENTERS) for each in (moved, anew)), strict=True
    ):
        for field in fields(shown):
            np.testing.assert_array_equal(getattr(shown, field.name), getattr(expected, field.name))
    assert (moved.usage, moved.threads) == (before.usage, 2)
    np.testing.assert_array_equal(before.scene.vertices, scene.vertices)


def moved_by(scene, moves):
    return replace(scene, vertices=scene.vertices + moves)


def test_usage_counts_poses_by_kind(scene):
    city_map = CityMap(scene, threads=2)
    mask = city_map.render(CAMERA, POSES[0])
    city_map.counts(CAMERA, ROTATIONS, CENTERS, mask)
    city_map.fit(CAMERA, ROTATIONS[:4], CENTERS[:4], IouFit(mask))
    city_map.depth(CAMERA, ROTATIONS[:2], CENTERS[:2])
    expected = {"counts": COUNT, "depth": 2, "fit": 4, "silhouettes": 1}
    assert city_map.usage.counts() == expected
    assert city_map.usage.total == COUNT + 7
    assert city_map.usage.take() == expected
    assert city_map.usage.take() == {}


def test_usage_loses_nothing_between_threads(scene):
    city_map = CityMap(scene, threads=1)

    def ask():
        for _ in range(50):
            city_map.silhouettes(CAMERA.scaled(16, 12), ROTATIONS, CENTERS)

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert city_map.usage.total == 4 * 50 * COUNT


@pytest.mark.slow
def test_depth_agrees_with_open3d(city_map, scene):
    ours = city_map.depth(CAMERA, ROTATIONS, CENTERS)
    try:
        theirs = CityMap(scene, "open3d", threads=1).depth(CAMERA, ROTATIONS, CENTERS)
    except RenderingError as error:  # not installed, or without a library of the system
        pytest.skip(f"no Open3D here: {error} {error.hint}")
    assert theirs.shape == ours.shape
    differs = np.abs(ours - theirs) > 1e-3 * np.maximum(ours, 1)
    # Float32 rays miss or hit at edges only.
    assert differs.mean() < 2e-3
    assert (ours > 0).mean() > 0.2


def test_colour_of_a_textured_map_is_its_textures(scene):
    half, height = 60.0, 40.0
    plan = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    corners = plan[[[0, 1, 2], [0, 2, 3]]]
    corners = np.concatenate([corners, np.full((2, 3, 1), height)], axis=2)
    picture = np.full((8, 8, 3), (12, 150, 210), dtype=np.uint8)
    mesh = TexturedMesh(
        corners, np.zeros((2, 3, 2)), np.zeros(2, np.int32), np.zeros((2, 3, 3), np.uint8), (picture,)
    )
    textured = CityMap(scene, threads=2, textured=mesh)
    assert textured.is_textured
    down = rotation_from_euler(EulerAngles(0.0, 0.0, 0.0))[None]
    seen = textured.colour(CAMERA, down, np.array([[0.0, 0.0, 90.0]]))[0]
    np.testing.assert_array_equal(seen[20:70, 30:90], np.broadcast_to((12, 150, 210), (50, 60, 3)))
    # Geometry stays the city's: the textured map is what it looks like.
    depth = textured.depth(CAMERA, down, np.array([[0.0, 0.0, 90.0]]))[0]
    assert depth.max() > 60.0


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    path = tmp_path_factory.mktemp("town") / "city.obj"
    path.write_text(box_obj())
    return open_scene(path)


def tops(town):
    return np.maximum.reduceat(town.vertices[:, 2], town.vertex_starts[:-1])


@pytest.mark.parametrize("renderer", ["silhouette", "raster"])
def test_what_is_drawn_is_the_city_with_those_heights(town, renderer):
    """As mapped from disk, where drawings of the city may be kept under its digest."""
    city_map = CityMap(replace(town, stored_digest="kept"), renderer, threads=1)
    heights_m = np.resize([1.5, 0.0, -0.7, 0.2], town.num_buildings)
    drawn, changed_m = corrected_map(city_map, heights_m)
    np.testing.assert_array_equal(changed_m, np.where(heights_m == 0.2, 0.0, heights_m))
    np.testing.assert_allclose(tops(drawn.scene) - tops(town), changed_m, atol=1e-4)
    assert (drawn.name, drawn.scene.stored_digest, drawn.usage) == (renderer, "", city_map.usage)
    expected = CityMap(replace(town, vertices=drawn.scene.vertices), threads=1)
    for pose in true_poses(2).values():
        np.testing.assert_array_equal(drawn.render(TOWN_CAMERA, pose), expected.render(TOWN_CAMERA, pose))


def test_where_nothing_can_be_lowered_the_map_stays(town):
    flat = town.vertices.copy()
    flat[:, 2] = np.minimum.reduceat(flat[:, 2], town.vertex_starts[:-1])[
        np.repeat(np.arange(town.num_buildings), np.diff(town.vertex_starts))
    ]
    city_map = CityMap(replace(town, vertices=flat), threads=1)
    assert corrected_map(city_map, np.full(town.num_buildings, -1.0))[0] is city_map


def test_what_is_low_is_not_lowered(town):
    """Nor raised to the height below which nothing is lowered."""
    owner = np.repeat(np.arange(town.num_buildings), np.diff(town.vertex_starts))
    floors = np.minimum.reduceat(town.vertices[:, 2], town.vertex_starts[:-1])
    rises = np.resize([1.0, 2.4, 9.0], town.num_buildings)
    low = town.vertices.copy()
    low[:, 2] = np.minimum(low[:, 2], (floors + rises)[owner])
    _, changed_m = corrected_map(
        CityMap(replace(town, vertices=low), threads=1), np.full(town.num_buildings, -1.0)
    )
    np.testing.assert_allclose(changed_m[:3], [0.0, -0.4, -1.0], atol=1e-4)
