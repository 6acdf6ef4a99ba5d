"""What makes a solid sound, checked from its points and rings alone."""

from collections import Counter

import numpy as np

from lodbench.synthesis.town.shapes import Solid


def ring_normal(points: np.ndarray) -> np.ndarray:
    """Returns twice the vector area of a ring, (3,)."""
    return np.cross(points - points[0], np.roll(points, -1, axis=0) - points[0]).sum(axis=0)


def volume_m3(solid: Solid) -> float:
    """Returns the enclosed volume in cubic metres, positive when the faces look outward."""
    volume = 0.0
    middle = solid.points.mean(axis=0)
    for face in solid.faces:
        for ring in face.rings:
            corners = solid.points[list(ring)] - middle
            # Fans around the first corner: a hole's fan is negative, so it need not be convex.
            volume += float(np.sum(np.cross(corners[1:-1], corners[2:]) @ corners[0])) / 6.0
    return volume


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
    assert volume_m3(solid) > 0
