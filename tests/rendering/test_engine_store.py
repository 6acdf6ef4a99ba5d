import numpy as np
import pytest
from hostile_scenes import box, scene_of

from lodbench.citymodel.scene_file import read_scene, write_scene
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.rendering import engine_layout, engine_store
from lodbench.rendering.engine_store import arrays_folder, open_arrays
from lodbench.rendering.silhouette import SilhouetteRenderer

CAMERA = Camera(129, 96, 90.0, 89.0, 64.0, 49.0)
POSE = Pose.from_euler(EulerAngles(35, 1, 20), (40, 0, 110))


@pytest.fixture
def stored(tmp_path, monkeypatch):
    """A scene mapped from disk, of a size that counts as large, and an empty cache."""
    monkeypatch.setenv("LODBENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(engine_store, "_STORED_FROM_TRIANGLES", 20)
    write_scene(scene_of(*(box([30 * i, 0, 0], [20, 14, 9 + i]) for i in range(5))), tmp_path / "scene")
    return read_scene(tmp_path / "scene")[0]


def forbidden(scene):
    raise AssertionError("it was laid out again")


def test_laid_out_once_and_mapped_ever_after(stored, monkeypatch):
    plain = engine_layout.scene_arrays(stored)
    first = open_arrays(stored)
    monkeypatch.setattr(engine_layout, "scene_arrays", forbidden)
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
    monkeypatch.setattr(engine_store, "_STORED_FROM_TRIANGLES", 1000)
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
