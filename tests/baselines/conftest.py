"""The tests' tiny town with speckled surfaces and ground, and photos of it."""

import cv2
import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.citymodel.textured_map import TexturedMesh
from lodbench.datasets.query import Query
from tests.town import CAMERA, box_obj, prior_of, true_poses

VIEWS = 3


def speckled(corners: np.ndarray, side_m: float = 25.0) -> TexturedMesh:
    """Triangles that all show one picture of speckles, repeated from each square of a plane to the next."""
    speckles = cv2.GaussianBlur(np.random.default_rng(3).normal(128, 90, (256, 256, 3)), (0, 0), 2.2)
    picture = np.clip((speckles - 128) * 5 + 128, 0, 255).astype(np.uint8)
    uv = np.stack([corners @ (1, 0.2, 0.3), corners @ (0.1, 1, -0.9)], axis=-1) / side_m
    blank = np.zeros((len(corners), 3, 3), np.uint8)
    return TexturedMesh(corners, uv, np.zeros(len(corners), np.int32), blank, (picture,))


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("town") / "city.obj"
    path.write_text(box_obj())
    return open_scene(path)


@pytest.fixture(scope="session")
def city_map(scene):
    shift = -scene.origin
    low, high = np.array([-150.0, -150.0, 0.0]) + shift, np.array([150.0, 150.0, 0.0]) + shift
    west, south, z = low
    east, north, _ = high
    ground = np.array(
        [
            [(west, south, z), (east, south, z), (east, north, z)],
            [(west, south, z), (east, north, z), (west, north, z)],
        ]
    )
    walls = scene.vertices[scene.triangles].astype(np.float64)
    return CityMap(scene, threads=1, textured=speckled(np.concatenate([walls, ground])))


@pytest.fixture(scope="session")
def truths(scene):
    return [pose.shifted(-scene.origin) for pose in true_poses(VIEWS).values()]


@pytest.fixture(scope="session")
def queries(city_map, truths, tmp_path_factory):
    """Queries whose photos are views of the map in another light, with the truth told."""
    folder = tmp_path_factory.mktemp("photos")
    made = []
    for number, truth in enumerate(truths):
        picture = city_map.colour(CAMERA, truth.rotation[None], truth.center[None])[0]
        darker = (0.7 * picture.astype(np.float64) + 12).astype(np.uint8)
        cv2.imwrite(str(folder / f"{number}.png"), darker[:, :, ::-1])

        def true_pixels(points, truth=truth):
            return CAMERA.project((points - truth.center) @ truth.rotation.T)

        query = Query(
            f"{number}.png",
            "all",
            CAMERA,
            prior_of(truth),
            image=folder / f"{number}.png",
            true_pixels=true_pixels,
        )
        made.append(query)
    return made
