"""A tiny city of boxes, a renderer of it that owes nothing to the engine, and a small training set of it."""

import cv2
import numpy as np
import pytest

from lodbench.citymodel.scene import Scene, build_scene
from lodbench.synthesis.camera_paths import GenerateParams
from lodbench.synthesis.generate import generate_training_data
from tests.town import box_obj

# Corners of a unit box (x, y, z in bits 2, 1, 0) and its twelve triangles.
_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
_QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
_TRIANGLES = np.array([t for a, b, c, d in _QUADS for t in ((a, b, c), (a, c, d))])

# Few and small: what is tested does not depend on the size.
SMALL = {"pitch": [40.0], "height": [90.0], "yaw": [0.0, 120.0, 240.0], "size": (96, 80), "workers": 1}
WHOLE = {"val_share": 0.0, "test_share": 0.0}


def box_city(count: int = 6, pitch_m: float = 40.0, base_m: float = 20.0) -> Scene:
    """Returns count x count boxes, 20 x 25 m wide and 8 to 20 m high."""
    points, triangles, owner = [], [], []
    for k in range(count * count):
        size = np.array([20.0, 25.0, 8.0 + 12.0 * ((7 * k) % 5) / 4])
        low = np.array([(k % count) * pitch_m, (k // count) * pitch_m, base_m])
        triangles.append(_TRIANGLES + 8 * k)
        points.append(low + size * _CORNERS)
        owner += [k] * 12
    return build_scene(
        np.concatenate(points),
        np.concatenate(triangles),
        np.array(owner, dtype=np.int32),
        tuple(f"b{k}" for k in range(count * count)),
    )


class FillPolyRenderer:
    """Fills projected triangles with OpenCV; triangles that reach behind the camera are left out."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.calls = 0

    def render(self, camera, pose):
        self.calls += 1
        points = self._scene.vertices.astype(np.float64) @ pose.rotation.T + pose.translation
        pixels = np.round((camera.project(points) - 0.5) * 16)
        image = np.zeros((camera.height, camera.width), np.uint8)
        for triangle in self._scene.triangles:
            corners = pixels[triangle]
            if np.isfinite(corners).all() and np.abs(corners).max() < 2**24:
                cv2.fillPoly(image, [corners.astype(np.int32)], 1, shift=4)
        return image.astype(bool)


@pytest.fixture(scope="session")
def city():
    return box_city()


@pytest.fixture
def renderer(city):
    return FillPolyRenderer(city)


@pytest.fixture(scope="session")
def box_file(tmp_path_factory):
    """A city of seven boxes as Wavefront OBJ."""
    path = tmp_path_factory.mktemp("boxes") / "city.obj"
    path.write_text(box_obj())
    return path


@pytest.fixture(scope="session")
def small_set(box_file, tmp_path_factory):
    """A finished training set with everything in it, and its parameters."""
    out = tmp_path_factory.mktemp("set") / "data"
    params = GenerateParams(str(box_file), str(out), labels=True, classes=True, depth=True, **SMALL, **WHOLE)
    return params, generate_training_data(params)
