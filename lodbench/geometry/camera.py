"""Cameras: lenses, intrinsics and how well they are known, rays through their pixels.

The formulas of lenses are those of COLMAP's camera models. All act on normalised coordinates: x/z and y/z of
a point in camera axes, before focal lengths and principal point. Undistorting a picture needs them in this
direction only; the rays of single pixels invert them by Newton's method (``pixel_rays``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import LodbenchError, nearest_names, require_choice

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
        lens: Name of the lens's formula, one of ``LENSES``.
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


# Words of text files and ``--camera``: what follows "=", by the field's name; two in percent.
_WORDS = {"sigma_f": "focal_percent", "sigma_c": "center_percent", "sigma_k1": "k1", "sigma_by": "source"}
_PERCENTS = ("sigma_f", "sigma_c")
STATED: Final = "stated"
# Further off, a number says nothing; tilt, distortion and place would take up any of them.
_MOST = {"sigma_f": 100.0, "sigma_c": 100.0, "sigma_k1": 10.0}


@dataclass(frozen=True, slots=True)
class CameraSigmas:
    """Standard deviations of a camera's numbers.

    Attributes:
        focal_percent: Of the focal length, percent of it.
        center_percent: Of the principal point along each axis, percent of the image's width.
        k1: Of the first coefficient of radial distortion, normalised image coordinates.
        source: Where the numbers come from, a word: ``calibration``; of a photo, the ``source`` of its
            ``PhotoCamera``; ``stated`` where a person gave the deviations themselves.
    """

    focal_percent: float
    center_percent: float
    k1: float
    source: str

    @property
    def are_zero(self) -> bool:
        """Tells whether nothing is in doubt."""
        return not (self.focal_percent or self.center_percent or self.k1)

    @property
    def stated_focal_percent(self) -> float | None:
        """Returns the deviation of a focal length that a person stated, percent; else None."""
        return self.focal_percent if self.source == STATED and self.focal_percent else None

    def words(self) -> list[str]:
        """Returns it in words of a text file; none where nothing is in doubt."""
        if self.are_zero:
            return []
        return [
            f"{word}={getattr(self, name)}{'%' if word in _PERCENTS else ''}"
            for word, name in _WORDS.items()
            if (word, self.source) != ("sigma_by", STATED)
        ]


# A calibration, or a camera that a person gave in full.
CALIBRATED: Final = CameraSigmas(0.0, 0.0, 0.0, "calibration")
# The maker's calibrated focal length, optical centre or distortion, in pixels.
MAKER: Final = CameraSigmas(0.5, 0.35, 0.01, "maker")
# Only a focal length in millimetres, or as the equivalent of a 35 mm camera.
UNKNOWN: Final = CameraSigmas(1.5, 0.7, 0.03, "nominal")


def split_sigmas(words: Sequence[str]) -> tuple[list[str], CameraSigmas | None]:
    """Returns a camera's words, and the deviations that ``sigma_f=0.5% sigma_c=0.35% sigma_k1=0.01`` state.

    Any may be left out, and is 0 then; None where all are. ``sigma_by=WORD`` says where they come from.

    Raises:
        LodbenchError: A word is unknown, given twice or before the camera's own, or a number is none, or not
            within 0 to 100 % (``k1``: 10).
    """
    first = next((at for at, word in enumerate(words) if "=" in word), len(words))
    given: dict[str, str] = {}
    for word in words[first:]:
        name, _, text = word.partition("=")
        if name not in _WORDS:
            raise LodbenchError(f"{word!r} is no deviation of a camera", nearest_names(name, _WORDS))
        if not text or name in given:
            raise LodbenchError(f"{name} {'is given twice' if name in given else 'has no value'}")
        given[name] = text
    focal, center, k1 = (_number(name, given.get(name, "0")) for name in _MOST)
    sigmas = CameraSigmas(focal, center, k1, given.get("sigma_by", STATED))
    return list(words[:first]), sigmas if given else None


def _number(name: str, text: str) -> float:
    unit = "%" if name in _PERCENTS else ""
    try:
        number = float(text.removesuffix(unit))
    except ValueError:
        number = -1.0
    if not 0 <= number <= _MOST[name]:
        raise LodbenchError(f"{name}={text} is not within 0 to {_MOST[name]:g}{unit}")
    return number


# Parameters that a covariance may hold besides the six of the pose, and their units.
CAMERA_PARAMETERS = {"focal": "a share of both focal lengths", "cx": "px", "cy": "px", "k1": "1"}
# Newton's method: most steps, what counts as solved, and half the width of differences (normalised).
_STEPS, _SOLVED, _HALF = 60, 1e-10, 1e-6


class PixelRays(NamedTuple):
    """Rays through N pixels in camera axes: (x, y, 1); NaN where the lens shows no ray."""

    points: Floats  # (N, 2) x and y
    pixel_by_point: Floats  # (N, 2, 2) how a pixel moves with its ray's x and y, pixels

    @property
    def point_by_pixel(self) -> Floats:
        """Returns (N, 2, 2) how a ray's x and y move with its pixel."""
        return _inverse(self.pixel_by_point)

    @property
    def directions(self) -> Floats:
        """Returns (N, 3) directions in camera axes, of length 1 along the optical axis."""
        return np.column_stack([self.points, np.ones(len(self.points))])


def pixel_rays(camera: Camera, pixels: Floats) -> PixelRays:
    """Returns the rays through (N, 2) pixels, COLMAP's convention (the first one's centre is 0.5, 0.5)."""
    focal = np.array([camera.fx, camera.fy])
    wanted = (np.asarray(pixels, dtype=np.float64) - [camera.cx, camera.cy]) / focal
    points = wanted.copy()
    slopes = np.broadcast_to(np.eye(2), (len(points), 2, 2))
    if camera.distortion:
        with np.errstate(all="ignore"):
            for _ in range(_STEPS):
                slopes, off = _lens_slopes(camera, points), _through_lens(camera, points) - wanted
                points = points - (_inverse(slopes) @ off[:, :, None])[:, :, 0]
                if not (np.abs(off) > _SOLVED).any():
                    break
            slopes = _lens_slopes(camera, points)
            is_solved = (np.abs(_through_lens(camera, points) - wanted) < 1e3 * _SOLVED).all(axis=1)
            # Beyond where a polynomial folds back there are other roots, mirrored, which no ray takes.
            is_upright = (np.linalg.det(slopes) > 0) & (np.trace(slopes, axis1=1, axis2=2) > 0)
            points[~(is_solved & is_upright)] = np.nan
    return PixelRays(points, focal[:, None] * slopes)


def camera_columns(camera: Camera, rays: PixelRays, names: Sequence[str]) -> Floats:
    """Returns (N, 2, K) how the pixels of fixed rays move with K of ``CAMERA_PARAMETERS``.

    Raises:
        ConfigError: A name is not known.
    """
    for name in names:
        require_choice("parameters", name, CAMERA_PARAMETERS)
    count = len(rays.points)
    focal = np.array([camera.fx, camera.fy])
    radius2 = (rays.points**2).sum(axis=1, keepdims=True)
    columns = {
        "focal": focal * _through_lens(camera, rays.points),
        "cx": np.broadcast_to([1.0, 0.0], (count, 2)),
        "cy": np.broadcast_to([0.0, 1.0], (count, 2)),
        "k1": focal * rays.points * radius2,
    }
    return np.stack([columns[name] for name in names], axis=2) if names else np.zeros((count, 2, 0))


def _through_lens(camera: Camera, points: Floats) -> Floats:
    if not camera.distortion:
        return points
    return np.stack(distort(camera.lens, camera.distortion, points[:, 0], points[:, 1]), axis=1)


def _lens_slopes(camera: Camera, points: Floats) -> Floats:
    """Returns (N, 2, 2) derivatives of distorted coordinates by those of the ray, by differences."""
    steps = _HALF * np.eye(2)
    ahead = [_through_lens(camera, points + step) - _through_lens(camera, points - step) for step in steps]
    return np.stack(ahead, axis=2) / (2 * _HALF)


def _inverse(matrices: Floats) -> Floats:
    """Returns the inverses of (N, 2, 2) matrices; infinities where there is none."""
    (a, b), (c, d) = matrices[:, 0].T, matrices[:, 1].T
    adjoint = np.stack([np.stack([d, -b], axis=1), np.stack([-c, a], axis=1)], axis=1)
    return np.asarray(adjoint / (a * d - b * c)[:, None, None])
