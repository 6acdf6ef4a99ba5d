"""Looks of pictures: what is drawn, and that objects can be painted anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.errors import ConfigError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.kernels.looks import SurfaceClass
from lodbench.synthesis.objects.scene_props import SceneProps
from lodbench.synthesis.photo import LookRanges, PhotoRenderer, draw_look, look_ranges
from tests.town import box_obj

CAMERA = Camera(64, 64, 64.0, 64.0, 32.0, 32.0)
_SIDE, _COUNT = 20.0, 16


@pytest.fixture(scope="module")
def roofs(tmp_path_factory):
    """A renderer of sixteen flat roofs side by side, all magenta, and a pose above their middle."""
    path = tmp_path_factory.mktemp("boxes") / "city.obj"
    path.write_text(box_obj())
    scene = open_scene(path)
    corners, triangles, objects = [], [], []
    for k in range(_COUNT):
        x, y = _SIDE * (k % 4 - 2), _SIDE * (k // 4 - 2)
        first = len(corners)
        corners += [(x, y, 50), (x + _SIDE, y, 50), (x + _SIDE, y + _SIDE, 50), (x, y + _SIDE, 50)]
        triangles += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
        objects += [k, k]
    props = SceneProps(
        vertices=np.array(corners, np.float32),
        triangles=np.array(triangles, np.int32),
        surface=np.full(2 * _COUNT, SurfaceClass.ROOF_FLAT, np.uint8),
        objects=np.array(objects, np.int32),
        tint=np.full((2 * _COUNT, 3), (200, 10, 200), np.uint8),
        num_buildings=_COUNT,
        origin=scene.origin,
    )
    return PhotoRenderer(scene, props), Pose.from_euler(EulerAngles(0.0, 0.0, 0.0), [0.0, 0.0, 110.0])


def share_magenta(roofs, look):
    """Returns the share of pixels that keep the roofs' own colour."""
    renderer, pose = roofs
    red, green, blue = np.moveaxis(renderer.light(CAMERA, pose, look).astype(np.float64), 2, 0)
    return float(((red > 3 * green) & (blue > 3 * green)).mean())


@pytest.mark.parametrize(("repaint", "least", "most"), [(0.0, 0.95, 1.0), (0.5, 0.2, 0.8), (1.0, 0.0, 0.05)])
def test_a_share_of_objects_is_painted_anew(roofs, repaint, least, most):
    ranges = replace(look_ranges("plain"), repaint=(repaint, repaint))
    shares = [share_magenta(roofs, draw_look(ranges, np.random.default_rng(k))[0]) for k in range(4)]
    assert least <= np.mean(shares) <= most


def test_painting_anew_changes_nothing_else_of_a_look():
    plain, camera = draw_look(LookRanges(), np.random.default_rng(3))
    painted, same_camera = draw_look(LookRanges(repaint=(0.2, 0.9)), np.random.default_rng(3))
    assert 0.2 <= painted.repaint <= 0.9
    assert painted._replace(repaint=0.0) == plain
    assert same_camera == camera


def test_a_range_out_of_bounds_is_named():
    with pytest.raises(ConfigError, match=r"look\.repaint"):
        LookRanges(repaint=(0.5, 2.0))
