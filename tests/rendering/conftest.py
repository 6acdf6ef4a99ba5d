"""Real cities, cut to what the reference renders in well under a second."""

import numpy as np
import pytest
from hostile_scenes import part_of

from lodbench.citymodel import Scene, open_scene

# File below the sample data -> lowest level of detail is taken.
CITIES = {
    "uavd4l": "uavd4l/UAVD4L-LoD1.obj",
    "berlin": "city/germany_lod2/berlin_open_data_sample_data.citygml",
    "plateau": "city/plateau/53392642_bldg_6697_op2.gml",
}


def middle_of(scene: Scene) -> np.ndarray:
    """Returns the first vertex of each building, (B, 3) metres; of empty ones, infinity."""
    firsts = np.full((scene.num_buildings, 3), np.inf)
    filled = np.diff(scene.vertex_starts) > 0
    firsts[filled] = scene.vertices[scene.vertex_starts[:-1][filled]]
    return firsts


@pytest.fixture(scope="session", params=sorted(CITIES))
def real_quarter(request, shared_data):
    """The sixty buildings round the median building of a real city, and that building's place."""
    scene = open_scene(shared_data / CITIES[request.param])
    places = middle_of(scene)
    middle = np.median(places[np.isfinite(places[:, 0])], axis=0)
    distance = np.linalg.norm(places[:, :2] - middle[:2], axis=1)
    nearest = np.sort(np.argsort(distance)[: min(60, int(np.isfinite(distance).sum()))])
    return part_of(scene, nearest), middle
