"""Scenes laid out for the engine, kept on disk, and the selection of buildings."""

import numpy as np
import pytest
from hostile_scenes import box, scene_of

from lodbench.citymodel.scene_file import read_scene, write_scene
from lodbench.geometry import Camera, EulerAngles, Pose, rotation_from_euler, rotations_at_yaws
from lodbench.kernels.projection import visible_buildings
from lodbench.rendering import silhouette
from lodbench.rendering.projection import select_buildings, sphere_tree, view_planes
from lodbench.rendering.silhouette import SilhouetteRenderer, arrays_folder, open_arrays, scene_arrays

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
