"""Pieces of a solid's inside, against the graph of all pairs of points that see each other."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from lodbench.citymodel.checks.solids import _inside_points, _is_free, _num_pieces
from lodbench.citymodel.cleaning import connected_components


def ball(count: int, radius: float, seed: int, *, is_hole: bool = False) -> np.ndarray:
    """Returns the triangles, (T, 3, 3), of a ball's hull, seen from outside or inside."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points *= radius / np.linalg.norm(points, axis=1)[:, None]
    corners = points[ConvexHull(points).simplices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    is_turned = (np.einsum("ij,ij->i", normals, corners[:, 0]) > 0) == is_hole
    corners[is_turned] = corners[is_turned][:, ::-1]
    return corners


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("away", [0.0, 30.0])
def test_pieces_are_those_of_all_pairs(seed, away):
    count = 7 + 2 * seed
    corners = np.concatenate([ball(count, 10.0, seed), ball(count, 7.0, seed + 9, is_hole=not away) + away])
    points = _inside_points(corners)
    first, second = np.triu_indices(len(points), 1)
    is_free = _is_free(points[first], points[second], corners)
    all_pairs = connected_components(len(points), first[is_free], second[is_free])
    assert _num_pieces(points, corners) == len(np.unique(all_pairs))
    if away:
        assert _num_pieces(points, corners) >= 2
