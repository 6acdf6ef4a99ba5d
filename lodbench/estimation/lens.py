"""Where a camera that is not quite as declared shows points, and how that changes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import Camera

Floats = NDArray[np.float64]

# Points are taken for no nearer than this, metres.
_NEAREST_M = 1e-6


@dataclass(frozen=True, slots=True)
class LensErrors:
    """What a camera may be wrong about beside its pose.

    Attributes:
        focal: By which share the focal length is longer than declared.
        k1: Radial distortion, normalised coordinates.
        right: How far right of the declared principal point the true one is, share of the width.
        down: How far below, share of the width.
    """

    focal: float = 0.0
    k1: float = 0.0
    right: float = 0.0
    down: float = 0.0

    def pinhole(self, camera: Camera) -> Camera:
        """Returns a pinhole as near to a camera with these errors as one can be, to draw with."""
        return replace(
            camera,
            fx=camera.fx * (1.0 + self.focal),
            fy=camera.fy * (1.0 + self.focal),
            cx=camera.cx + self.right * camera.width,
            cy=camera.cy + self.down * camera.width,
        )


EXACT = LensErrors()


def project(local: Floats, camera: Camera, lens: LensErrors = EXACT) -> Floats:
    """Returns pixels (..., 2) of points in camera axes (..., 3), metres; pixel centres at +0.5."""
    away = local[..., :2] / np.maximum(local[..., 2:], _NEAREST_M)
    stretch = 1.0 + lens.k1 * (away**2).sum(axis=-1, keepdims=True)
    focal = np.array([camera.fx, camera.fy]) * (1.0 + lens.focal)
    centre = np.array([camera.cx, camera.cy]) + camera.width * np.array([lens.right, lens.down])
    return np.asarray(away * stretch * focal + centre)


def projection_slopes(local: Floats, camera: Camera, lens: LensErrors = EXACT) -> Floats:
    """Returns (N, 2, 7) how pixels of points (N, 3) change with these, then with ``LensErrors``."""
    depth = np.maximum(local[:, 2], _NEAREST_M)
    away = local[:, :2] / depth[:, None]
    square = (away**2).sum(axis=1)
    stretch = 1.0 + lens.k1 * square
    declared = np.array([camera.fx, camera.fy])
    focal = declared * (1.0 + lens.focal)
    by_away = stretch[:, None, None] * np.eye(2) + 2.0 * lens.k1 * away[:, :, None] * away[:, None, :]
    slopes = np.zeros((len(local), 2, 7))
    slopes[:, :, :2] = by_away / depth[:, None, None]
    slopes[:, :, 2] = -(by_away @ away[..., None])[..., 0] / depth[:, None]
    slopes[:, :, :3] *= focal[:, None]
    slopes[:, :, 3] = away * stretch[:, None] * declared
    slopes[:, :, 4] = away * square[:, None] * focal
    slopes[:, 0, 5] = slopes[:, 1, 6] = camera.width
    return slopes
