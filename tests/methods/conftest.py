"""Queries over the tests' tiny town."""

import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.datasets.query import Query
from lodbench.methods.region.roofs import RaisedRoofs
from tests.town import CAMERA, box_obj, prior_of, true_poses


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("town") / "city.obj"
    path.write_text(box_obj())
    return open_scene(path)


@pytest.fixture(scope="session")
def city_map(scene):
    return CityMap(scene, threads=1)


@pytest.fixture
def roofs(city_map, scene):
    return RaisedRoofs(city_map, scene)


@pytest.fixture(scope="session")
def truths():
    return list(true_poses(3).values())


@pytest.fixture(scope="session")
def queries(city_map, truths):
    return [
        Query(f"q{i}", "all", CAMERA, prior_of(pose), city_map.render(CAMERA, pose).astype(np.float32))
        for i, pose in enumerate(truths)
    ]
