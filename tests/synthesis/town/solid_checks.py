"""What makes a solid sound, checked from its points and rings alone."""

from __future__ import annotations

from collections import Counter

import numpy as np

from lodbench.synthesis.town.solid import Solid


def ring_normal(points: np.ndarray) -> np.ndarray:
    """Returns twice the vector area of a ring, (3,)."""
    return np.cross(points - points[0], np.roll(points, -1, axis=0) - points[0]).sum(axis=0)


def assert_sound(solid: Solid) -> None:
    """Asserts that a solid is closed, looks outward, and has planar faces without repeated corners."""
    edges: Counter[tuple[int, int]] = Counter()
    for face in solid.faces:
        outline = solid.points[list(face.rings[0])]
        normal = ring_normal(outline)
        normal /= np.linalg.norm(normal)
        for number, ring in enumerate(face.rings):
            assert len(ring) >= 3
            assert len(set(ring)) == len(ring)
            corners = solid.points[list(ring)]
            assert np.abs((corners - outline[0]) @ normal).max() < 0.004
            assert (ring_normal(corners) @ normal > 0) == (number == 0)
            edges.update(zip(ring, (*ring[1:], ring[0]), strict=True))
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)
    assert solid.volume_m3() > 0
