"""A photo as numbers per pixel: appearance in bins, and strength of change along every direction."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.errors import RenderingError
from lodbench.kernels import quantise_edges
from lodbench.kernels.arguments import DIRECTIONS, EDGE_LEVELS, MAX_STRENGTH, STRENGTH_STEPS

# A mean changes slowly: it is taken of a picture so small that its kernel is this wide, pixels. At the
# borders it is then the exact one to a fiftieth of the picture's deviation, elsewhere to a five-hundredth.
_KERNEL_PX = 16.0


def gaussian_mean(picture: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """Returns the Gaussian mean around each pixel of an (H, W) picture."""
    height, width = picture.shape
    smaller = max(1, int(sigma_px / _KERNEL_PX))
    if smaller == 1 or min(height, width) < 2 * smaller:
        return np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma_px), dtype=np.float32)
    small = cv2.resize(picture, (width // smaller, height // smaller), interpolation=cv2.INTER_AREA)
    mean = cv2.GaussianBlur(small, (0, 0), sigma_px / smaller)
    return np.asarray(cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.float32)


Picture = NDArray[np.float32]

# Levels of brightness and of texture of a grey or thermal photo; of L, a, b and texture of a colour photo.
_GREY_LEVELS = (16, 8)
_COLOUR_LEVELS = (6, 6, 8, 3)
# Channels of a grey photo stored in colour differ by no more than this on average, of 255.
_GREY_SPREAD = 2.0
# How much of the average around a pixel is taken off, over which part of the width.
_LOCAL_SHARE, _LOCAL_PARTS = 0.7, 8.0
# Levels of the strength of edges, and the part of the width that their mean is taken over.
_EDGE_LEVELS = 12
_MEAN_SHARE = 12.0
# Over how many pixels the texture is smoothed, standard deviation.
_TEXTURE_PX = 2.0


class AppearanceBins(NamedTuple):
    """A quantised photo."""

    bins: NDArray[np.uint16]  # (H, W) uint16 bin of each pixel
    num_bins: int  # how many there are


def appearance_bins(photo: NDArray[Any], size: tuple[int, int], has_texture: bool = True) -> AppearanceBins:
    """Returns a photo's pixels as bins of brightness, colour and texture, at a working size.

    A grey photo, thermal ones among them, gives 16 levels of brightness by 8 of texture; a colour photo 6 of
    L by 6 of a by 8 of b (CIE Lab) by 3 of texture. Texture is the absolute Laplacian of the brightness,
    smoothed over 2 pixels. Most of each channel's average over an eighth of the width is taken off, so that
    haze, vignettes and the sky's light do not part a photo; levels are quantiles, so that exposure changes
    nothing.

    Args:
        photo: (H, W) or (H, W, 3) BGR, 8 bits.
        size: Width and height to work at, pixels.
        has_texture: Whether texture counts: it separates roofs from grass, and blurs where one ends.

    Raises:
        RenderingError: The photo has another shape.
    """
    if photo.ndim not in (2, 3) or photo.size == 0 or (photo.ndim == 3 and photo.shape[2] != 3):
        raise RenderingError(f"A photo has shape {photo.shape}, not (height, width) or (height, width, 3).")
    small: Picture = cv2.resize(photo, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    levels: tuple[int, ...]
    if small.ndim == 2 or _is_grey(small):
        grey = small if small.ndim == 2 else small[..., 1]
        channels, levels = [grey, _texture(grey)], _GREY_LEVELS
    else:
        lab: Picture = np.asarray(cv2.cvtColor(small / np.float32(255), cv2.COLOR_BGR2LAB), dtype=np.float32)
        channels, levels = [lab[..., 0], lab[..., 1], lab[..., 2], _texture(lab[..., 0])], _COLOUR_LEVELS
    channels = [_local(channel) for channel in channels]
    if not has_texture:
        channels, levels = channels[:-1], levels[:-1]
    bins = np.zeros(small.shape[:2], dtype=np.int64)
    for channel, count in zip(channels, levels, strict=True):
        bins = bins * count + _levels(channel, count)
    return AppearanceBins(bins.astype(np.uint16), int(np.prod(levels)))


class EdgeBins(NamedTuple):
    """How strongly a photo changes, in levels."""

    horizontal_gradient: NDArray[np.uint16]  # (H, W) uint16 level of the change from left to right
    vertical_gradient: NDArray[np.uint16]  # (H, W) uint16 level of the change from top to bottom
    num_bins: int  # how many levels there are


def edge_bins(photo: NDArray[Any], size: tuple[int, int], blur_px: float) -> EdgeBins:
    """Returns how strongly brightness and colour change across each pixel, in 12 equally full levels.

    Gradients of L, a and b (Sobel) are taken after a blur and divided by their mean about the pixel, so that
    a sharp foreground does not outweigh what lies in haze. Photo and size as of ``appearance_bins``; the
    blur's standard deviation is in pixels of that size.
    """
    lab = _blurred_lab(photo, size, blur_px)
    gradients = [np.abs(cv2.Sobel(lab, cv2.CV_32F, *axis)).sum(axis=2) for axis in ((1, 0), (0, 1))]
    local_mean = gaussian_mean(gradients[0] + gradients[1], size[0] / _MEAN_SHARE) + np.float32(1e-3)
    across, down = (_levels(gradient / local_mean, _EDGE_LEVELS).astype(np.uint16) for gradient in gradients)
    return EdgeBins(across, down, _EDGE_LEVELS)


def _blurred_lab(photo: NDArray[Any], size: tuple[int, int], blur_px: float) -> Picture:
    """Returns a photo's (H, W, 3) L, a and b (CIE Lab) at a working size, blurred."""
    small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    if small.ndim == 2:
        small = np.repeat(small[..., None], 3, axis=2)
    small /= np.float32(255)
    lab = cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_BGR2LAB), (0, 0), blur_px)
    return np.asarray(lab, dtype=np.float32)


def _is_grey(photo: Picture) -> bool:
    spread = photo.max(axis=2) - photo.min(axis=2)
    return float(spread.mean()) <= _GREY_SPREAD


def _local(channel: Picture) -> Picture:
    """Returns a channel less most of its own average around each pixel: what haze and vignettes change.

    Eq. (R1) of docs/methods/region.md.
    """
    local_mean = gaussian_mean(channel, channel.shape[1] / _LOCAL_PARTS)
    return np.asarray(channel - np.float32(_LOCAL_SHARE) * local_mean, dtype=np.float32)


def _texture(grey: Picture) -> Picture:
    edges = np.abs(cv2.Laplacian(grey, cv2.CV_32F))
    return np.asarray(cv2.GaussianBlur(edges, (0, 0), _TEXTURE_PX), dtype=np.float32)


def _levels(values: Picture, count: int) -> NDArray[np.int64]:
    """Returns which of some equally full parts each value lies in; equal values share one."""
    levels = np.zeros(values.shape, dtype=np.int64)
    # So few are compared in less time than they are searched.
    for edge in np.quantile(values, np.arange(1, count) / count):
        levels += values >= edge
    return levels


Levels = NDArray[np.uint8]

# Every so many-th row and column says where one level ends and the next begins.
_STEP = 3


def gradient_forms(
    photo: NDArray[Any], size: tuple[int, int], blur_px: float, least_mean: float
) -> NDArray[np.float32]:
    """Returns (H, W, 3) xx, xy and yy of the gradients of L, a and b, over their mean strength nearby.

    The square of the strength along any direction is a quadratic form of these: sums over the channels.
    Arguments as of ``edge_bins``; ``least_mean`` is added to the mean strength, of CIE Lab's 0 to 100 a
    pixel.
    """
    lab = _blurred_lab(photo, size, blur_px)
    # Channels apart: numpy's sums over an axis of three take ten times as long.
    across, down = (cv2.split(cv2.Sobel(lab, cv2.CV_32F, *axis, scale=0.125)) for axis in ((1, 0), (0, 1)))
    pairs = ((across, across), (across, down), (down, down))
    xx, xy, yy = (one[0] * other[0] + one[1] * other[1] + one[2] * other[2] for one, other in pairs)
    squares = (gaussian_mean(np.sqrt(xx + yy), size[0] / _MEAN_SHARE) + np.float32(least_mean)) ** 2
    return np.asarray(cv2.merge([xx / squares, xy / squares, yy / squares]), dtype=np.float32)


def directed_edge_levels(photo: NDArray[Any], size: tuple[int, int], blur_px: float) -> Levels:
    """Returns (H, W, 12) uint8 how strongly brightness and colour change along each direction, 0 to 15.

    As ``edge_bins``, for any direction: ``k`` is ``k * pi / 12`` from the picture's x axis towards its y
    axis.
    """
    forms = gradient_forms(photo, size, blur_px, 1e-3)
    angles = np.arange(DIRECTIONS) * (np.pi / DIRECTIONS)
    turns = np.stack(
        [np.cos(angles) ** 2, 2.0 * np.cos(angles) * np.sin(angles), np.sin(angles) ** 2], axis=1
    )
    some = np.sqrt(np.maximum(forms[::_STEP, ::_STEP] @ turns.T, 0.0)) * STRENGTH_STEPS
    levels: Levels = np.empty((*forms.shape[:2], DIRECTIONS), dtype=np.uint8)
    quantise_edges(forms, turns, _level_table(np.minimum(some, MAX_STRENGTH).astype(np.int64)), levels)
    return levels


def _level_table(steps: NDArray[np.int64]) -> Levels:
    """Returns (4096,) the level of each fine step of strength, so that levels are equally full.

    A search for the level of each strength would take longer than all else.
    """
    up_to = np.bincount(steps.ravel(), minlength=MAX_STRENGTH + 1).cumsum()
    places = np.arange(1, EDGE_LEVELS) / EDGE_LEVELS * (steps.size - 1)
    low, high = (np.searchsorted(up_to, whole(places), side="right") for whole in (np.floor, np.ceil))
    ends = low + (high - low) * (places - np.floor(places))
    return np.searchsorted(ends, np.arange(MAX_STRENGTH + 1), side="right").astype(np.uint8)
