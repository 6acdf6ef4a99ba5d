"""Queries over the tests' tiny town."""

from __future__ import annotations

import numpy as np
import pytest

from lodbench.citymodel import open_scene
from lodbench.datasets.query import Query
from lodbench.rendering import make_renderer
from tests.town import CAMERA, box_obj, prior_of, true_poses


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("town") / "city.obj"
    path.write_text(box_obj())
    return open_scene(path)


@pytest.fixture(scope="session")
def scorer(scene):
    return make_renderer("silhouette", scene, 1)


@pytest.fixture(scope="session")
def truths():
    return list(true_poses(3).values())


@pytest.fixture(scope="session")
def queries(scorer, truths):
    return [
        Query(f"q{i}", "all", CAMERA, prior_of(pose), scorer.render(CAMERA, pose).astype(np.float32))
        for i, pose in enumerate(truths)
    ]
