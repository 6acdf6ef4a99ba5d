"""Walls that end higher than in the map, all alike: drawn, and told from photos."""

from dataclasses import replace

import numpy as np
import pytest

from lodbench.citymap import CityMap
from lodbench.estimation.state_vector import ALL, BASE_OFFSET
from lodbench.methods.region.roofs import STEP_M, RaisedRoofs
from lodbench.synthesis.views_dataset import Perturbation
from tests.methods.test_region_lines import line_fit, shaded_photo, with_roofs
from tests.methods.test_region_roofs import FAST, mean_errors
from tests.town import CAMERA


def lifted(roofs, feet_m):
    return roofs.with_offsets(roofs.own_m, feet_m, 0.0)


@pytest.mark.parametrize("feet_m", [0.5, 2.0])
def test_lifted_feet_are_those_of_a_town_whose_walls_are_hidden_so_far(scene, roofs, truths, feet_m):
    """Against the worlds of ``dataset=views``, which were written for another purpose."""
    expected = CityMap(Perturbation(hidden_feet_m=feet_m).perturbed(scene), threads=1)
    for truth in truths:
        seen = lifted(roofs, feet_m).at(0).render(CAMERA, truth)
        np.testing.assert_array_equal(seen, expected.render(CAMERA, truth))
        assert not np.array_equal(seen, roofs.at(0).render(CAMERA, truth))


def test_points_of_walls_move_by_their_share(scene, roofs):
    """From any map, and of any height of roofs, to that of other feet; tops of walls stay."""
    owner = np.repeat(np.arange(scene.num_buildings), np.diff(scene.vertex_starts))
    for step, first_m, last_m in ((0, 0.0, 1.5), (2, 1.0, -0.5)):
        before, after = (
            lifted(roofs, feet_m).at(step).scene.vertices[:, 2].astype(float) for feet_m in (first_m, last_m)
        )
        of_points = lifted(roofs, first_m).lifts(before, owner, step)
        np.testing.assert_allclose(before + (last_m - first_m) * of_points, after, atol=1e-4)
        modes_found = np.maximum.reduceat(after, scene.vertex_starts[:-1])
        np.testing.assert_allclose(
            modes_found,
            np.maximum.reduceat(scene.vertices[:, 2], scene.vertex_starts[:-1]) + step * STEP_M,
            atol=1e-4,
        )


def test_no_wall_is_left_lower_than_two_metres_and_flat_outlines_stay(scene, city_map):
    heights = np.resize([0.0, 3.0, 9.0], scene.num_buildings)
    floors = np.minimum.reduceat(scene.vertices[:, 2], scene.vertex_starts[:-1])
    owner = np.repeat(np.arange(scene.num_buildings), np.diff(scene.vertex_starts))
    low = scene.vertices.copy()
    low[:, 2] = np.minimum(low[:, 2], (floors + heights)[owner])
    part = replace(scene, vertices=low)
    feet = np.minimum.reduceat(
        lifted(RaisedRoofs(city_map, part), 4.0).at(0).scene.vertices[:, 2], scene.vertex_starts[:-1]
    )
    rises = np.maximum.reduceat(low[:, 2], scene.vertex_starts[:-1]) - floors
    np.testing.assert_allclose(feet - floors, np.clip(rises - 2.0, 0.0, 4.0), atol=1e-4)


def test_walls_hidden_below_do_not_drag_cameras_that_lines_place(roofs, queries, truths):
    """Photos of a town without its lowest 3 m, whose lines are laid where the map has walls end."""
    town, heights_m, found = lifted(roofs, 3.0), np.linspace(-6.0, 6.0, 49), []
    for number, (query, truth) in enumerate(zip(queries, truths, strict=True)):
        photo, pose = shaded_photo(town.at(0), truth, number), with_roofs(truth)
        fit = line_fit(photo, query, roofs, pose)
        higher, lower = (pose + np.eye(ALL)[BASE_OFFSET] * feet_m for feet_m in (3.0, -1.0))
        assert np.ptp(fit(np.stack([pose, higher, lower]))) < 3.0
        found.append(heights_m[int(fit(pose + np.outer(heights_m, np.eye(ALL)[2])).argmax())])
    assert np.abs(found).max() <= 0.5


@pytest.mark.slow
def test_hidden_feet_lead_no_answer_far_astray(city_map, roofs, tmp_path):
    """Photos of a town without its lowest three metres: under the belief that all is seen they cost more."""
    told = [replace(FAST, feet_m=feet_m) for feet_m in (0.0, 1.0)]
    trusting, doubting = mean_errors(city_map, lifted(roofs, 3.0).at(0), told, tmp_path, seeds=range(3))
    assert doubting < trusting
