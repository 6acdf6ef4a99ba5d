"""Scene props: classes, parts, frames and the file they are kept in."""

from dataclasses import fields

import numpy as np
import pytest

from lodbench.errors import RenderingError
from lodbench.kernels.looks import SurfaceClass
from lodbench.synthesis.objects.scene_props import SceneProps, read_props, write_props


def props_of(surfaces, origin=(0.0, 0.0, 0.0)):
    count = len(surfaces)
    return SceneProps(
        vertices=np.arange(9 * count, dtype=np.float32).reshape(-1, 3),
        triangles=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        surface=np.array(surfaces, dtype=np.uint8),
        objects=np.arange(count, dtype=np.int32),
        tint=np.full((count, 3), 100, dtype=np.uint8),
        num_buildings=1,
        origin=np.array(origin),
    )


def test_ground_comes_first_then_buildings_then_what_stands_before_them():
    assert SurfaceClass.WATER.is_ground
    assert not SurfaceClass.WINDOW.is_ground
    of_buildings = [kind for kind in SurfaceClass if SurfaceClass.WALL <= kind < SurfaceClass.TRUNK]
    assert SurfaceClass.CHIMNEY in of_buildings
    assert not {SurfaceClass.FOLIAGE, SurfaceClass.CAR_BODY, SurfaceClass.WATER} & set(of_buildings)


def test_a_part_keeps_only_the_vertices_it_uses():
    props = props_of([SurfaceClass.ROAD, SurfaceClass.WALL, SurfaceClass.FOLIAGE])
    assert props.has_buildings
    is_wall = props.surface == SurfaceClass.WALL
    wall = props.part(is_wall)
    assert len(wall) == 1
    assert len(wall.vertices) == 3
    np.testing.assert_array_equal(wall.vertices[wall.triangles[0]], props.vertices[props.triangles[1]])
    assert not props.part(~is_wall).has_buildings


def test_props_stay_where_they_are_in_another_frame():
    far = props_of([SurfaceClass.WALL], origin=(1000.0, 0.0, 5.0))
    here = far.in_frame(np.zeros(3))
    np.testing.assert_array_equal(here.vertices, far.vertices + np.array([1000.0, 0.0, 5.0]))
    np.testing.assert_array_equal(here.in_frame(far.origin).vertices, far.vertices)


def test_a_file_gives_back_what_was_written_and_is_stable(tmp_path):
    props = props_of([SurfaceClass.CAR_BODY, SurfaceClass.GRASS])
    write_props(props, tmp_path / "a.npz")
    write_props(props, tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    again = read_props(tmp_path / "a.npz")
    for field in fields(SceneProps):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(props, field.name))


@pytest.mark.parametrize("content", [None, b"", b"no zip", b"PK\x03\x04 cut short"])
def test_a_damaged_file_is_named(tmp_path, content):
    path = tmp_path / "props.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RenderingError, match=r"props\.npz") as told:
        read_props(path)
    assert "pickle" not in told.value.message
    assert "props=FILE" in told.value.hint
