"""What a photo says of its pose and of the roofs it shows, against the same by dense algebra."""

import numpy as np
import pytest

from lodbench.estimation.outline_alignment import Aligner
from lodbench.geometry.pose import vector_from_pose
from lodbench.methods.flight import FlightParams, photo_terms
from lodbench.methods.flight.photo_terms import LENS, flight_terms
from lodbench.methods.flight.roof_parts import RoofParts
from tests.methods.flight.test_method import flight


@pytest.mark.parametrize("reach_px", [8.0, None])
def test_points_speak_of_their_own_parts_as_the_dense_problem_has_it(city_map, monkeypatch, reach_px):
    # Subsets that show some of the parts each.
    monkeypatch.setattr(photo_terms, "_MOST_POINTS", 40)
    (query,), (pose,) = flight(city_map, count=1, focal=1.0)
    params, heat = FlightParams().photo().outline_model(), 1.5
    vector, lens = vector_from_pose(pose), np.zeros(LENS)
    aligner, roofs = Aligner(query, city_map, params), RoofParts(20.0, city_map.scene.num_buildings)
    asked = roofs, reach_px, (0.5, heat), None
    (term,) = flight_terms([aligner], vector[None], lens, *asked)
    seen, _, rows = photo_terms._look(aligner, vector, lens, False)
    numbers = roofs.numbers_of(rows, seen.places), roofs.numbers_of(-1 - rows, seen.places)
    _, weights = photo_terms._outline_noise(seen, reach_px)
    subsets = -(-len(rows) // 40)
    used = min(subsets, 1 if reach_px else 4)
    np.testing.assert_array_equal(term.buildings, np.unique(rows))
    count, size = len(term.parts), 6 + LENS + len(term.parts) + 2 * len(term.buildings)
    dense, gradient = np.zeros((size, size)), np.zeros(size)
    for k in range(used):
        chosen = slice(k * subsets // used, None, subsets)
        slopes = seen.slopes[chosen]
        is_roof, is_foot = (number[chosen, None] == term.parts for number in numbers)
        heights = is_roof * slopes[:, 7, None] + is_foot * slopes[:, 8, None]
        # A building that stands further east is a camera further west.
        is_building = rows[chosen, None] == term.buildings
        places = -(is_building[..., None] * slopes[:, None, :2]).reshape(len(slopes), -1)
        jacobian = np.hstack([slopes[:, :6], slopes[:, 9 : 9 + LENS], heights, places])
        lengths_px = params.outline_px, params.roof_part_px
        lower = photo_terms._covariance(seen, chosen, (term.noise_px, weights), lengths_px, 0.5, 0.0)
        covariance = np.tril(lower) + np.tril(lower, -1).T
        weighted = np.linalg.solve(covariance, jacobian).T / (used * heat)
        dense += weighted @ jacobian
        gradient += weighted @ seen.distances[chosen]
    assert jacobian.shape[1] == 6 + LENS + count + 2 * len(term.buildings)
    np.testing.assert_allclose(term.information, dense, rtol=1e-6, atol=1e-9 * np.abs(dense).max())
    np.testing.assert_allclose(term.gradient, gradient, rtol=1e-6, atol=1e-9 * np.abs(gradient).max())


def test_errors_of_a_building_s_place_go_together_in_one_view_and_not_with_others(city_map):
    (query,), (pose,) = flight(city_map, count=1, focal=1.0)
    params, vector = FlightParams().photo().outline_model(), vector_from_pose(pose)
    seen, _, _ = photo_terms._look(Aligner(query, city_map, params), vector, np.zeros(LENS), False)
    noise, chosen = (1.0, np.ones(len(seen.distances))), slice(0, None, 7)
    lengths_px = params.outline_px, params.roof_part_px
    without, with_places = (
        np.tril(photo_terms._covariance(seen, chosen, noise, lengths_px, 0.5, place_m))
        for place_m in (0.0, 0.3)
    )
    moves, building = seen.slopes[chosen, :2], seen.buildings[chosen]
    expected = 0.09 * (moves @ moves.T) * (building[:, None] == building)
    np.testing.assert_allclose(with_places - without, np.tril(expected), atol=1e-9)
    assert len(np.unique(building)) > 2
