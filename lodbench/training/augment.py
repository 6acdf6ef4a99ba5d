"""Random changes of a picture and its mask that leave buildings buildings."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]


def flipped(
    photo: Bytes, mask: Floats, generator: np.random.Generator, axes: tuple[int, ...]
) -> tuple[Bytes, Floats]:
    """Returns a photo (H, W, 3) and its mask (H, W) mirrored, with even odds for each axis.

    Args:
        photo: (H, W, 3).
        mask: (H, W).
        generator: The only source of randomness.
        axes: 1 for left to right, 0 for top to bottom.
    """
    for axis in axes:
        if generator.random() < 0.5:
            photo, mask = np.flip(photo, axis), np.flip(mask, axis)
    return photo, mask


def random_crop(
    photo: Bytes, mask: Floats, side: int, scale: tuple[float, float], generator: np.random.Generator
) -> tuple[Bytes, Floats]:
    """Returns a (side, side) square at a random place, turn and scale; mirrored where it leaves the picture.

    Args:
        photo: (H, W, 3).
        mask: (H, W) in [0, 1].
        side: Pixels.
        scale: Range of the enlargement, drawn evenly in its logarithm.
        generator: The only source of randomness.
    """
    height, width = mask.shape
    factor = float(np.exp(generator.uniform(np.log(scale[0]), np.log(scale[1]))))
    # Level cameras tilt little: a right way up with slight turns, not any angle.
    turn = np.deg2rad(generator.normal(0.0, 6.0))
    reach = 0.5 * side / factor
    center = [
        generator.uniform(min(reach, 0.5 * size), max(size - reach, 0.5 * size)) for size in (width, height)
    ]
    cos, sin = factor * np.cos(turn), factor * np.sin(turn)
    # To the square from the picture, pixel centres on whole numbers.
    matrix = np.array([[cos, -sin, 0.0], [sin, cos, 0.0]])
    matrix[:, 2] = 0.5 * side - 0.5 - matrix[:, :2] @ (np.array(center) - 0.5)
    # Shrinking without a filter would leave patterns that no camera makes.
    if factor < 0.75:
        photo = np.asarray(cv2.GaussianBlur(photo, (0, 0), 0.35 / factor), np.uint8)
    taken = [
        cv2.warpAffine(image, matrix, (side, side), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        for image in (photo, mask)
    ]
    return np.asarray(taken[0], np.uint8), np.asarray(taken[1], np.float32)


def relit(photo: Bytes, generator: np.random.Generator, one_band: float = 0.0) -> Floats:
    """Returns a picture in other light, taken by another camera: (H, W, 3) float32 in [0, 1].

    Rendered views have drawn their looks already; this moves each a little further.

    Args:
        photo: (H, W, 3) RGB.
        generator: The only source of randomness.
        one_band: Share of pictures that lose their colours altogether, as if of another sensor.
    """
    gamma = np.exp(generator.normal(0.0, 0.12))
    gains = np.exp(generator.normal(0.0, 0.08) + generator.normal(0.0, 0.03, 3))
    # Light changes each channel by itself: a table of 256 values instead of a power per pixel.
    table = (np.linspace(0.0, 1.0, 256)[:, None] ** gamma * gains).astype(np.float32)
    picture = np.asarray(cv2.LUT(photo, table[None]), np.float32)
    if one_band and generator.random() < one_band:
        picture = _one_band(picture, generator)
    elif generator.random() < 0.25:
        grey = picture @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
        saturation = np.float32(generator.uniform(0.0, 1.3))
        picture = grey[..., None] + saturation * (picture - grey[..., None])
    if generator.random() < 0.25:
        sigma = generator.uniform(0.0, 0.03)
        picture = picture + sigma * generator.standard_normal(picture.shape, dtype=np.float32)
    clipped: Floats = np.clip(picture, 0.0, 1.0, dtype=np.float32)
    return clipped


def _one_band(picture: Floats, generator: np.random.Generator) -> Floats:
    """Returns a picture as another sensor may see it: one band, its tones bent or inverted."""
    band = picture @ generator.dirichlet((1.0, 1.0, 1.0)).astype(np.float32)
    low, high = np.quantile(band[::4, ::4], (0.01, 0.99))
    tones = np.clip((band - low) / max(high - low, 0.05), 0.0, 1.0, dtype=np.float32)
    if generator.random() < 0.3:
        tones = 1 - tones
    tones = tones ** np.float32(np.exp(generator.normal(0.0, 0.4)))
    floor, gain = generator.uniform(0.0, 0.15), generator.uniform(0.7, 1.0)
    return np.repeat((floor + gain * tones)[..., None], 3, axis=2).astype(np.float32)
