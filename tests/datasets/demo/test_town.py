from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from solid_checks import assert_sound

from lodbench.datasets.demo.building import LOD1_GRID_M, pieces_of
from lodbench.datasets.demo.shapes import area
from lodbench.datasets.demo.town import grow_town


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_every_solid_is_sound(town_of, seed):
    for building in town_of(seed).buildings:
        assert_sound(building.lod1)
        assert_sound(building.lod2)


def samples_in(piece: np.ndarray) -> np.ndarray:
    """Returns 81 points spread over a convex quadrilateral, 1 % away from its edges."""
    u, v = (axis.ravel()[:, None] for axis in np.meshgrid(*[np.linspace(0.01, 0.99, 9)] * 2))
    a, b, c, d = piece
    return (1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * d


def inside(piece: np.ndarray, points: np.ndarray) -> np.ndarray:
    edge = np.roll(piece, -1, axis=0) - piece
    off = points[:, None, :] - piece
    return (edge[:, 0] * off[..., 1] - edge[:, 1] * off[..., 0] > 1e-6).all(axis=1)


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_footprints_do_not_overlap(town_of, seed):
    buildings = town_of(seed).buildings
    owned = [(number, p) for number, b in enumerate(buildings) for p in pieces_of(b.plan)]
    owners, pieces = [number for number, _ in owned], [piece for _, piece in owned]
    middles = np.stack([piece.mean(axis=0) for piece in pieces])
    reach = np.array([np.linalg.norm(p - m, axis=1).max() for p, m in zip(pieces, middles, strict=True)])
    for k, piece in enumerate(pieces):
        near = np.linalg.norm(middles - middles[k], axis=1) < reach + reach[k]
        for other in np.flatnonzero(near):
            if owners[other] != owners[k]:
                names = buildings[owners[k]].identifier, buildings[owners[other]].identifier
                assert not inside(piece, samples_in(pieces[other])).any(), names


def test_it_is_a_town_of_many_kinds(town):
    assert 500 <= len(town.buildings) <= 1100
    roofs = Counter(building.plan.roof.name for building in town.buildings)
    assert {"flat", "gabled", "hipped", "mansard", "pavilion"} <= set(roofs)
    assert roofs["gabled"] > 0.4 * len(town.buildings)
    wings = Counter(b.plan.strip.num_segments for b in town.buildings)
    assert wings[1] > wings[2] > 20
    districts = {building.plan.district for building in town.buildings}
    assert districts == {"old town", "inner town", "garden suburb", "estate", "works"}
    assert max(b.plan.roof.eave_m for b in town.buildings) > 30.0


def test_courtyards_and_u_shapes_exist_somewhere(town_of):
    strips = [b.plan.strip for seed in (0, 1, 3) for b in town_of(seed).buildings]
    assert any(strip.closed for strip in strips)
    assert any(strip.num_segments == 3 and not strip.closed for strip in strips)


def test_the_ground_has_relief(town):
    bases = np.array([building.lod2.points[:, 2].min() for building in town.buildings])
    assert 10.0 < np.ptp(bases) < 40.0


def test_identifiers_are_unique(town):
    names = [building.identifier for building in town.buildings]
    assert len(set(names)) == len(names)


def test_lod1_stands_on_the_same_ground_and_differs_as_in_life(town):
    ratio = []
    for building in town.buildings:
        low, fine = building.lod1.points, building.lod2.points
        assert low[:, 2].min() == pytest.approx(fine[:, 2].min(), abs=0.002)
        roof = building.plan.roof
        expected = 0.5 * (roof.eave_m + roof.ridge_m)
        assert np.ptp(low[:, 2]) == pytest.approx(expected, abs=0.011)
        np.testing.assert_allclose(np.round(low[:, :2] / LOD1_GRID_M) * LOD1_GRID_M, low[:, :2])
        ratio.append(building.lod1.volume_m3() / building.lod2.volume_m3())
    assert 0.97 < np.median(ratio) < 1.03
    assert np.std(ratio) > 0.02


def test_no_block_is_a_rectangle_on_a_grid(town):
    angles = []
    for block in town.streets.blocks:
        edge = np.roll(block.ring, -1, axis=0) - block.ring
        assert area(block.ring) > 0
        angles += list(np.degrees(np.arctan2(edge[:, 1], edge[:, 0])) % 90.0)
    counts, _ = np.histogram(angles, bins=18, range=(0.0, 90.0))
    assert counts.max() < 0.25 * counts.sum()


def test_same_seed_same_town_and_other_seeds_differ(town, town_of):
    again, other = grow_town(0), town_of(1)
    assert len(again.buildings) == len(town.buildings)
    for first, second in zip(town.buildings, again.buildings, strict=True):
        np.testing.assert_array_equal(first.lod2.points, second.lod2.points)
        assert first.lod2.faces == second.lod2.faces
    assert len(other.buildings) != len(town.buildings)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_every_town_has_its_church(town_of, seed):
    churches = [b.plan for b in town_of(seed).buildings if b.plan.function == "church"]
    assert [plan.roof.name for plan in churches] == ["hipped", "pavilion"]
