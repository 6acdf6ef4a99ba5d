"""Cars: one hull with a glazed cabin, in many sizes and paints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.objects.mesh_builder import MeshBuilder
from lodbench.synthesis.objects.scene_props import SurfaceClass

Points = NDArray[np.float64]

_PAINTS = np.array(
    [
        (232, 232, 232),
        (60, 62, 66),
        (150, 152, 156),
        (34, 36, 40),
        (150, 40, 36),
        (46, 70, 118),
        (196, 190, 178),
    ],
    float,
)
_GLASS = (52.0, 60.0, 68.0)
# Rings of four corners, from the ground up: back and front end, half the width, height; of a unit car.
_RINGS = (
    (-0.5, 0.5, 0.5, 0.14),
    (-0.5, 0.5, 0.5, 0.55),
    (-0.42, 0.24, 0.46, 0.60),
    (-0.30, 0.10, 0.38, 1.0),
)


def add_cars(
    builder: MeshBuilder, feet: Points, ways: Points, slope: Points, chances: np.random.Generator
) -> None:
    """Adds a car at each place.

    Args:
        builder: Takes them.
        feet: (N, 3) the ground under their middles, metres.
        ways: (N, 2) unit directions they point to.
        slope: (N,) metres that the ground rises per metre ahead.
        chances: Source of chance.
    """
    count = len(feet)
    lengths, widths, heights = (
        chances.uniform(low, high, count) for low, high in ((3.8, 4.9), (1.7, 1.9), (1.4, 1.75))
    )
    shape, faces, is_glass = _unit_car()
    ahead, left, up = np.moveaxis(shape[None] * np.stack([lengths, widths, heights], axis=1)[:, None], 2, 0)
    points = np.empty((count, len(shape), 3))
    points[..., 0] = feet[:, None, 0] + ahead * ways[:, None, 0] + left * -ways[:, None, 1]
    points[..., 1] = feet[:, None, 1] + ahead * ways[:, None, 1] + left * ways[:, None, 0]
    points[..., 2] = feet[:, None, 2] + up + ahead * slope[:, None]
    paint = _PAINTS[chances.integers(len(_PAINTS), size=count)] * chances.uniform(0.85, 1.1, (count, 1))
    tint = np.where(is_glass[None, :, None], np.array(_GLASS), paint[:, None, :])
    surface = np.where(is_glass, SurfaceClass.CAR_GLASS, SurfaceClass.CAR_BODY).astype(np.uint8)
    builder.add_copies(surface, points, faces, tint)


def _unit_car() -> tuple[Points, NDArray[np.int64], NDArray[np.bool_]]:
    """Returns a car of unit size, its triangles, and which are glass: a hull, and a cabin with a roof."""
    rings = [
        [(back, -half, z), (front, -half, z), (front, half, z), (back, half, z)]
        for back, front, half, z in _RINGS
    ]
    sides = [(4 * ring + k, 4 * ring + (k + 1) % 4) for ring in range(3) for k in range(4)]
    faces = [face for a, b in sides for face in ((a, b, b + 4), (a, b + 4, a + 4))]
    roof = [(12, 13, 14), (12, 14, 15)]
    is_glass = np.arange(len(faces) + len(roof)) // 8 == 2
    return np.array(rings, float).reshape(-1, 3), np.array([*faces, *roof]), is_glass
