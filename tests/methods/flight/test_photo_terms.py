"""What a photo says of its pose and of the roofs it shows, against the same by dense algebra."""

from __future__ import annotations

import numpy as np
import pytest

from lodbench.geometry.pose_vector import vector_from_pose
from lodbench.methods.contour_alignment.alignment import Aligner
from lodbench.methods.flight import Params, photo_terms
from lodbench.methods.flight.photo_terms import LENS, flight_terms
from lodbench.methods.flight.roof_parts import RoofParts
from tests.methods.flight.test_method import flight


@pytest.mark.parametrize("reach_px", [8.0, None])
def test_points_speak_of_their_own_parts_as_the_dense_problem_has_it(city_map, monkeypatch, reach_px):
    # Subsets that show some of the parts each.
    monkeypatch.setattr(photo_terms, "_MOST_POINTS", 40)
    (query,), (pose,) = flight(city_map, count=1, focal=1.0)
    params, heat = Params().photo(), 1.5
    vector, lens = vector_from_pose(pose), np.zeros(LENS)
    aligner, roofs = Aligner(query, city_map, params), RoofParts(20.0, city_map.scene.num_buildings)
    asked = roofs, reach_px, params, (0.5, heat), None
    (term,) = flight_terms([aligner], vector[None], lens, *asked)
    seen, _, rows = photo_terms._look(aligner, vector, lens, params)
    numbers = roofs.numbers_of(rows, seen.places), roofs.numbers_of(-1 - rows, seen.places)
    _, weights = photo_terms._outline_noise(seen, reach_px)
    subsets = -(-len(rows) // 40)
    used = min(subsets, 1 if reach_px else 4)
    dense = np.zeros((6 + LENS + len(term.parts),) * 2)
    for k in range(used):
        chosen = slice(k * subsets // used, None, subsets)
        jacobian = np.hstack([seen.slopes[chosen, :6], seen.slopes[chosen, 9 : 9 + LENS]])
        for kind, slope in ((0, 7), (1, 8)):
            is_part = numbers[kind][chosen, None] == term.parts
            jacobian = np.hstack([jacobian, is_part * seen.slopes[chosen, slope, None]])
        count = len(term.parts)
        jacobian[:, -2 * count : -count] += jacobian[:, -count:]
        jacobian = jacobian[:, :-count]
        lower = photo_terms._covariance(seen, chosen, term.noise_px, weights[chosen], params, 0.5)
        covariance = np.tril(lower) + np.tril(lower, -1).T
        dense += jacobian.T @ np.linalg.solve(covariance, jacobian) / (used * heat)
    np.testing.assert_allclose(term.information, dense, rtol=1e-6, atol=1e-9 * np.abs(dense).max())
