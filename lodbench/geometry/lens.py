"""Lens distortion: where the ray through a point of a pinhole's picture meets a real lens's picture.

The formulas are those of COLMAP's camera models. All act on normalised coordinates: x/z and y/z of a
point in camera axes, before focal lengths and principal point. Undistorting a picture needs them in
this direction only; the rays of single pixels invert them by Newton's method (``rays``).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_Formula = Callable[..., tuple[Floats, Floats]]

# Below this distance from the axis a ratio of two vanishing numbers is its limit.
_ON_AXIS = 1e-12


def distort(lens: str, parameters: tuple[float, ...], x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Returns distorted normalised coordinates.

    Args:
        lens: A name in ``LENSES``.
        parameters: As many as ``LENSES`` names, in that order.
        x: Any shape; x/z of points before the camera.
        y: The same shape.

    Returns:
        x and y; NaN where the lens has no picture of a ray.
    """
    return _FORMULAS[lens](x, y, *parameters)


def _opencv(x: Floats, y: Floats, *k: float) -> tuple[Floats, Floats]:
    k1, k2, p1, p2, k3, k4, k5, k6 = (*k, 0.0, 0.0, 0.0, 0.0)[:8]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def _equidistant(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Returns the ideal fisheye's coordinates: the angle from the axis, in the direction of the ray."""
    r = np.hypot(x, y)
    scale = np.where(r > _ON_AXIS, np.arctan(r) / np.maximum(r, _ON_AXIS), 1.0)
    return x * scale, y * scale


def _fisheye(x: Floats, y: Floats, k1: float, k2: float, k3: float, k4: float) -> tuple[Floats, Floats]:
    x, y = _equidistant(x, y)
    t2 = x * x + y * y
    radial = 1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))
    return x * radial, y * radial


def _fov(x: Floats, y: Floats, omega: float) -> tuple[Floats, Floats]:
    r = np.hypot(x, y)
    if abs(omega) < 1e-6:
        scale = np.ones_like(r)  # the limit is the pinhole
    else:
        reach = 2 * np.tan(omega / 2)
        scale = np.where(r > _ON_AXIS, np.arctan(r * reach) / np.maximum(r * omega, _ON_AXIS), reach / omega)
    return x * scale, y * scale


def _thin_prism_fisheye(
    x: Floats,
    y: Floats,
    k1: float,
    k2: float,
    p1: float,
    p2: float,
    k3: float,
    k4: float,
    sx: float,
    sy: float,
) -> tuple[Floats, Floats]:
    x, y = _equidistant(x, y)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + sx * r2,
        y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y) + sy * r2,
    )


def _rad_tan_thin_prism_fisheye(x: Floats, y: Floats, *k: float) -> tuple[Floats, Floats]:
    x, y = _equidistant(x, y)
    t2 = x * x + y * y
    radial = np.ones_like(t2)
    for power, factor in enumerate(k[:6], start=1):
        radial = radial + factor * t2**power
    x, y = x * radial, y * radial
    p0, p1, s0, s1, s2, s3 = k[6:]
    r2 = x * x + y * y
    return (
        x + p0 * (r2 + 2 * x * x) + 2 * p1 * x * y + s0 * r2 + s1 * r2 * r2,
        y + p1 * (r2 + 2 * y * y) + 2 * p0 * x * y + s2 * r2 + s3 * r2 * r2,
    )


def _division(x: Floats, y: Floats, k: float) -> tuple[Floats, Floats]:
    # The model divides the distorted radius by 1 + k r^2; this is the root that tends to 1 on the axis.
    root = 1 - 4 * k * (x * x + y * y)
    scale = 2 / (1 + np.sqrt(np.where(root >= 0, root, np.nan)))
    return x * scale, y * scale


def _eucm(x: Floats, y: Floats, alpha: float, beta: float) -> tuple[Floats, Floats]:
    scale = 1 / (alpha * np.sqrt(beta * (x * x + y * y) + 1) + (1 - alpha))
    return x * scale, y * scale


# Lens -> names of its parameters, in COLMAP's order after fx fy cx cy.
LENSES = {
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    "FOV": ("omega",),
    "THIN_PRISM_FISHEYE": ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": (*(f"k{i}" for i in range(6)), "p0", "p1", "s0", "s1", "s2", "s3"),
    "DIVISION": ("k",),
    "EUCM": ("alpha", "beta"),
}
# With all parameters zero these are a pinhole; the others are none whatever their parameters.
STRAIGHT_AT_ZERO = frozenset({"OPENCV", "FULL_OPENCV", "FOV", "DIVISION"})

_FORMULAS: dict[str, _Formula] = {
    "OPENCV": _opencv,
    "FULL_OPENCV": _opencv,
    "OPENCV_FISHEYE": _fisheye,
    "FOV": _fov,
    "THIN_PRISM_FISHEYE": _thin_prism_fisheye,
    "RAD_TAN_THIN_PRISM_FISHEYE": _rad_tan_thin_prism_fisheye,
    "DIVISION": _division,
    "EUCM": _eucm,
}
