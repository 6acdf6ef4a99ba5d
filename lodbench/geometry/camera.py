"""Cameras: pinhole intrinsics in pixels, with the lens distortion they may carry."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import LodbenchError, nearest_names

# COLMAP model name -> how its parameters map to (fx, fy, cx, cy, k1, k2, p1, p2).
_MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics of an image, COLMAP pixel convention (the first pixel's centre is at 0.5, 0.5).

    Attributes:
        width: Image width, pixels.
        height: Image height, pixels.
        fx: Focal length along x, pixels.
        fy: Focal length along y, pixels.
        cx: Principal point x, pixels.
        cy: Principal point y, pixels.
        distortion: (k1, k2, p1, p2) in OpenCV's order, or empty for a pinhole.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if self.width < 1 or self.height < 1 or self.fx <= 0 or self.fy <= 0:
            raise LodbenchError(f"A camera needs positive sizes and focal lengths, not {self}.")
        if not all(math.isfinite(v) for v in numbers):
            raise LodbenchError(f"A camera has values that are not finite: {self}.")

    @classmethod
    def from_colmap(cls, model: str, width: int, height: int, params: Sequence[float]) -> Camera:
        """Returns the camera of a COLMAP model name and its parameters.

        Raises:
            LodbenchError: The model is unknown or has another number of parameters.
        """
        names = _MODELS.get(model)
        if names is None:
            raise LodbenchError(f"Camera model {model!r} is not known.", nearest_names(model, _MODELS))
        if len(params) != len(names):
            raise LodbenchError(
                f"Camera model {model} takes {len(names)} parameters ({' '.join(names)}), not {len(params)}."
            )
        value = dict(zip(names, params, strict=True))
        focal = value.get("f", 0.0)
        distortion = tuple(value.get(k, 0.0) for k in ("k1", "k2", "p1", "p2"))
        return cls(
            width,
            height,
            value.get("fx", focal),
            value.get("fy", focal),
            value["cx"],
            value["cy"],
            distortion if any(distortion) else (),
        )

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Returns K, (3, 3), pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def scaled(self, width: int, height: int) -> Camera:
        """Returns the camera of the image resized to ``width`` x ``height``, each axis by its own factor."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    def without_distortion(self) -> Camera:
        """Returns the pinhole with the same K: the camera of the undistorted image."""
        return replace(self, distortion=())

    def project(self, points_cam: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns (N, 2) pixels of (N, 3) points in camera axes, metres; NaN behind the camera."""
        points = np.asarray(points_cam, dtype=np.float64)
        z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
        x, y = points[:, 0] / z, points[:, 1] / z
        if self.distortion:
            k1, k2, p1, p2 = self.distortion
            r2 = x * x + y * y
            radial = 1 + k1 * r2 + k2 * r2 * r2
            x, y = (
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            )
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=1)
