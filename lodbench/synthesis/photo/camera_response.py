"""The camera: from light to 8 bits, with lens, exposure, tone curve and sensor noise."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lodbench.synthesis.photo.look import CameraResponse
from lodbench.synthesis.photo.noise import unit_hash

_STEPS, _BRIGHTEST = 2048, 4
_MIDDLE = 0.45  # the grey that contrast leaves as it is


def apply_camera_response(light: NDArray[np.float32], how: CameraResponse) -> NDArray[np.uint8]:
    """Returns the (H, W, 3) 8-bit RGB picture of (H, W, 3) linear RGB light, which may be overwritten.

    A light of 1 is white paper in full light.
    """
    import cv2

    if how.blur_px > 0.15:
        blurred = cv2.GaussianBlur(light, (0, 0), how.blur_px, borderType=cv2.BORDER_REPLICATE)
        light = np.asarray(blurred, dtype=np.float32)
    picture = np.empty(light.shape, dtype=np.uint8)
    _expose(light, how, _tone_curve(how), picture)
    return picture


def _tone_curve(how: CameraResponse) -> NDArray[np.float32]:
    """Returns the brightness, 0 to 1, of linear light 0, 1 / _STEPS, 2 / _STEPS, ...

    It is the inverse of ``linear``, with a shoulder instead of a hard cut at white, and contrast.
    """
    light = np.arange(_STEPS * _BRIGHTEST + 2) / _STEPS
    value = np.sqrt(1.0 - np.exp(-1.55 * light))
    dark = _MIDDLE * (np.minimum(value, _MIDDLE) / _MIDDLE) ** how.contrast
    bright = 1.0 - (1.0 - _MIDDLE) * ((1.0 - np.maximum(value, _MIDDLE)) / (1.0 - _MIDDLE)) ** how.contrast
    return np.where(value < _MIDDLE, dark, bright).astype(np.float32)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _sensor_noise(bits):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns noise of unit variance, near enough normal: the four bytes of a hash, added up."""
    total = (bits & 255) + ((bits >> 8) & 255) + ((bits >> 16) & 255) + ((bits >> 24) & 255)
    return (total - 510.0) * (1.0 / 147.8)


@njit(cache=True, nogil=True, error_model="numpy")
def _expose(light, how, curve, picture):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    height, width, _ = light.shape
    balance = (1.0 + how.white_balance, 1.0, 1.0 - how.white_balance)
    reach = 4.0 / (height * height + width * width)
    for row in range(height):
        for column in range(width):
            dx, dy = column + 0.5 - 0.5 * width, row + 0.5 - 0.5 * height
            gain = how.exposure * (1.0 - how.vignette * (dx * dx + dy * dy) * reach)
            grey = 0.3 * light[row, column, 0] + 0.6 * light[row, column, 1] + 0.1 * light[row, column, 2]
            for c in range(3):
                value = grey + how.saturation * (light[row, column, c] - grey)
                place = min(_BRIGHTEST * 1.0, max(0.0, gain * balance[c] * value)) * _STEPS
                step = np.int64(place)
                value = curve[step] + (curve[step + 1] - curve[step]) * (place - step)
                # Photons come by chance: brighter is noisier, by the root, which the curve undoes.
                bits = np.int64(unit_hash(column, row, how.seed + c) * 4294967296.0)
                value += how.noise * (0.6 + 0.5 * value) * _sensor_noise(bits)
                picture[row, column, c] = np.uint8(min(255.0, max(0.0, 255.0 * value + 0.5)))
