"""The map with some buildings higher or lower, drawn again by whatever drew it."""

from dataclasses import replace

import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.citymap.city_map import corrected_map
from lodbench.citymodel import open_scene
from tests.town import CAMERA, box_obj, true_poses


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("town") / "city.obj"
    path.write_text(box_obj())
    return open_scene(path)


def tops(scene):
    return np.maximum.reduceat(scene.vertices[:, 2], scene.vertex_starts[:-1])


@pytest.mark.parametrize("renderer", ["silhouette", "raster"])
def test_what_is_drawn_is_the_city_with_those_heights(scene, renderer):
    """As mapped from disk, where drawings of the city may be kept under its digest."""
    city_map = CityMap(replace(scene, stored_digest="kept"), renderer, threads=1)
    heights_m = np.resize([1.5, 0.0, -0.7, 0.2], scene.num_buildings)
    drawn, changed_m = corrected_map(city_map, heights_m)
    np.testing.assert_array_equal(changed_m, np.where(heights_m == 0.2, 0.0, heights_m))
    np.testing.assert_allclose(tops(drawn.scene) - tops(scene), changed_m, atol=1e-4)
    assert (drawn.name, drawn.scene.stored_digest, drawn.usage) == (renderer, "", city_map.usage)
    expected = CityMap(replace(scene, vertices=drawn.scene.vertices), threads=1)
    for pose in true_poses(2).values():
        np.testing.assert_array_equal(drawn.render(CAMERA, pose), expected.render(CAMERA, pose))


def test_where_nothing_can_be_lowered_the_map_stays(scene):
    flat = scene.vertices.copy()
    flat[:, 2] = np.minimum.reduceat(flat[:, 2], scene.vertex_starts[:-1])[
        np.repeat(np.arange(scene.num_buildings), np.diff(scene.vertex_starts))
    ]
    city_map = CityMap(replace(scene, vertices=flat), threads=1)
    assert corrected_map(city_map, np.full(scene.num_buildings, -1.0))[0] is city_map


def test_what_is_low_is_not_lowered(scene):
    """Nor raised to the height below which nothing is lowered."""
    owner = np.repeat(np.arange(scene.num_buildings), np.diff(scene.vertex_starts))
    floors = np.minimum.reduceat(scene.vertices[:, 2], scene.vertex_starts[:-1])
    rises = np.resize([1.0, 2.4, 9.0], scene.num_buildings)
    low = scene.vertices.copy()
    low[:, 2] = np.minimum(low[:, 2], (floors + rises)[owner])
    _, changed_m = corrected_map(
        CityMap(replace(scene, vertices=low), threads=1), np.full(scene.num_buildings, -1.0)
    )
    np.testing.assert_allclose(changed_m[:3], [0.0, -0.4, -1.0], atol=1e-4)
