"""Random changes of a picture and its mask that leave buildings buildings."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]


def flipped(photo: Bytes, mask: Floats, generator: np.random.Generator) -> tuple[Bytes, Floats]:
    """Returns both mirrored left to right and top to bottom, each with even odds."""
    for axis in (1, 0):
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


def relit(photo: Bytes, generator: np.random.Generator) -> Floats:
    """Returns a picture in other light, taken by another camera: (H, W, 3) float32 in [0, 1].

    Rendered views have drawn their looks already; this moves each a little further.
    """
    gamma = np.exp(generator.normal(0.0, 0.12))
    gains = np.exp(generator.normal(0.0, 0.08) + generator.normal(0.0, 0.03, 3))
    # Light changes each channel by itself: a table of 256 values instead of a power per pixel.
    table = (np.linspace(0.0, 1.0, 256)[:, None] ** gamma * gains).astype(np.float32)
    picture = np.asarray(cv2.LUT(photo, table[None]))
    if generator.random() < 0.25:
        grey = picture @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
        saturation = np.float32(generator.uniform(0.0, 1.3))
        picture = grey[..., None] + saturation * (picture - grey[..., None])
    if generator.random() < 0.25:
        sigma = generator.uniform(0.0, 0.03)
        picture = picture + sigma * generator.standard_normal(picture.shape, dtype=np.float32)
    clipped: Floats = np.clip(picture, 0.0, 1.0, dtype=np.float32)
    return clipped
