"""Cameras: pinhole intrinsics in pixels, with the lens distortion they may carry."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import LodbenchError, nearest_names
from lodbench.geometry.lens import LENSES, STRAIGHT_AT_ZERO, distort

# COLMAP model name -> the lens it is a case of, and its parameters: f stands for both focal lengths.
_MODELS = {
    "SIMPLE_PINHOLE": ("OPENCV", ("f", "cx", "cy")),
    "PINHOLE": ("OPENCV", ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": ("OPENCV", ("f", "cx", "cy", "k1")),
    "RADIAL": ("OPENCV", ("f", "cx", "cy", "k1", "k2")),
    "SIMPLE_FISHEYE": ("OPENCV_FISHEYE", ("f", "cx", "cy")),
    "FISHEYE": ("OPENCV_FISHEYE", ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("f", "cx", "cy", "k1")),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("f", "cx", "cy", "k1", "k2")),
    "SIMPLE_DIVISION": ("DIVISION", ("f", "cx", "cy", "k")),
    **{lens: (lens, ("fx", "fy", "cx", "cy", *names)) for lens, names in LENSES.items()},
}


def colmap_parameters(model: str) -> tuple[str, ...]:
    """Returns the names of the parameters of a COLMAP camera model.

    Raises:
        LodbenchError: The model is unknown.
    """
    if model not in _MODELS:
        raise LodbenchError(f"Camera model {model!r} is not known.", nearest_names(model, _MODELS))
    return _MODELS[model][1]


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
        distortion: Parameters of the lens, in COLMAP's order; empty for a pinhole.
        lens: Name of the lens's formula, one of ``lens.LENSES``.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    lens: str = "OPENCV"

    def __post_init__(self) -> None:
        if self.width % 1 or self.height % 1:
            raise LodbenchError(f"A camera's size is whole pixels, not {self.width} x {self.height}.")
        for name in ("width", "height"):  # 640.0, as tables and files have it
            object.__setattr__(self, name, int(getattr(self, name)))
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if self.width < 1 or self.height < 1 or self.fx <= 0 or self.fy <= 0:
            given = f"{self.width} x {self.height} and {self.fx:g}, {self.fy:g}"
            raise LodbenchError(f"A camera needs positive sizes and focal lengths, not {given}.")
        if not all(math.isfinite(v) for v in numbers):
            raise LodbenchError(f"A camera has values that are not finite: {self}.")
        if self.distortion and len(self.distortion) != len(LENSES.get(self.lens, ())):
            raise LodbenchError(f"A lens {self.lens} has not {len(self.distortion)} parameters.")

    @classmethod
    def from_colmap(cls, model: str, width: int, height: int, params: Sequence[float]) -> Camera:
        """Returns the camera of a COLMAP model name and its parameters.

        Raises:
            LodbenchError: The model is unknown or has another number of parameters.
        """
        names = colmap_parameters(model)
        lens = _MODELS[model][0]
        if len(params) != len(names):
            raise LodbenchError(
                f"Camera model {model} takes {len(names)} parameters ({' '.join(names)}), not {len(params)}."
            )
        value = dict(zip(names, params, strict=True))
        focal = value.get("f", 0.0)
        distortion = tuple(value.get(name, 0.0) for name in LENSES[lens])
        is_straight = lens in STRAIGHT_AT_ZERO and not any(distortion)
        return cls(
            width,
            height,
            value.get("fx", focal),
            value.get("fy", focal),
            value["cx"],
            value["cy"],
            () if is_straight else distortion,
            "OPENCV" if is_straight else lens,
        )

    def to_colmap(self) -> tuple[str, tuple[float, ...]]:
        """Returns COLMAP's model name and parameters: ``PINHOLE``, or the lens's own."""
        model = self.lens if self.distortion else "PINHOLE"
        return model, (self.fx, self.fy, self.cx, self.cy, *self.distortion)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Returns K, (3, 3), pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def scaled(self, width: int, height: int) -> Camera:
        """Returns the camera of the image resized to ``width`` x ``height``, each axis by its own factor.

        Example:
            >>> half = Camera(1200, 900, fx=900, fy=900, cx=600, cy=450).scaled(600, 300)
            >>> half.fx, half.fy, half.cx, half.cy
            (450.0, 300.0, 300.0, 150.0)
        """
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

    def scaled_to_width(self, width: int) -> Camera:
        """Returns the camera of the image resized to a width, and to the height that keeps its aspect."""
        return self.scaled(width, max(1, round(width * self.height / self.width)))

    def with_margins(self, across_px: int, down_px: int) -> Camera:
        """Returns the camera of the image with so many pixels more left and right, and at top and bottom.

        Example:
            >>> wide = Camera(1200, 900, fx=900, fy=900, cx=600, cy=450).with_margins(100, 50)
            >>> wide.width, wide.height, wide.cx, wide.cy
            (1400, 1000, 700, 500)
        """
        return replace(
            self,
            width=self.width + 2 * across_px,
            height=self.height + 2 * down_px,
            cx=self.cx + across_px,
            cy=self.cy + down_px,
        )

    def without_distortion(self) -> Camera:
        """Returns the pinhole with the same K: the camera of the undistorted image."""
        return replace(self, distortion=(), lens="OPENCV")

    def project(self, points_cam: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns (N, 2) pixels of (N, 3) points in camera axes, metres; NaN behind the camera.

        Eq. (M2) of docs/methods/index.md.
        """
        points = np.asarray(points_cam, dtype=np.float64)
        z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
        x, y = points[:, 0] / z, points[:, 1] / z
        if self.distortion:
            x, y = distort(self.lens, self.distortion, x, y)
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=1)
