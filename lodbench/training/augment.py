"""Random changes of a picture and its mask that leave buildings buildings.

Strong random changes of what a picture looks like: other paints, other light, other sensors, other optics.
A network that learns from drawn pictures learns their colours too, and real roofs have others (domain
randomisation: Tobin et al., https://arxiv.org/abs/1703.06907). Where a building stands never changes here.
"""

from __future__ import annotations

from collections.abc import Callable

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
        mask: (H, W), or (H, W, classes).
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
        mask: (H, W), or (H, W, classes), in [0, 1].
        side: Pixels.
        scale: Range of the enlargement, drawn evenly in its logarithm.
        generator: The only source of randomness.
    """
    height, width = mask.shape[:2]
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


Generator = np.random.Generator
_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)
# Palettes of thermal cameras, by their nearest in OpenCV.
_PALETTES = (
    cv2.COLORMAP_INFERNO,
    cv2.COLORMAP_PLASMA,
    cv2.COLORMAP_MAGMA,
    cv2.COLORMAP_HOT,
    cv2.COLORMAP_JET,
    cv2.COLORMAP_TURBO,
    cv2.COLORMAP_BONE,
)
# Components smaller than this are left as they are, pixels; and so are all beyond so many.
_LEAST_PIXELS, _MOST_COMPONENTS = 30, 24


def other_appearance(photo: Bytes, mask: Floats, generator: Generator) -> Floats:
    """Returns a picture with other paints, light, sensor and optics: (H, W, 3) float32 in [0, 1].

    Args:
        photo: (H, W, 3) RGB.
        mask: (H, W) in [0, 1], the buildings: their paint changes one by one.
        generator: The only source of randomness.
    """
    picture = photo.astype(np.float32) / np.float32(255)
    if generator.random() < 0.6:
        picture = _repainted(picture, mask, generator)
    if generator.random() < 0.35:
        picture = _unevenly_lit(picture, generator)
    picture = _drawn(generator, _SENSORS)(picture, generator)
    picture = _toned(picture, generator)
    for share, change in _OPTICS:
        if generator.random() < share:
            picture = change(picture, generator)
    clipped: Floats = np.clip(picture, 0.0, 1.0, dtype=np.float32)
    return clipped


def covered(photo: Bytes, mask: Floats, grounds: tuple[Bytes, Bytes], generator: Generator) -> Bytes:
    """Returns a drawn picture with the ground of photos on its ground, and at times on its buildings too.

    Both may bear what only a camera sees: which of them a pixel is must not show by that.

    Args:
        photo: (H, W, 3) RGB.
        mask: (H, W) in [0, 1], the buildings.
        grounds: (H, W, 3) photos of ground, for the ground and for buildings.
        generator: The only source of randomness.
    """
    picture = photo.astype(np.float32)
    # Light and shade of the drawn picture stay.
    shade = cv2.GaussianBlur(picture @ _LUMA, (0, 0), 1.0)[..., None]
    shade = np.clip(shade / max(float(np.median(shade)), 1.0), 0.2, 2.0)
    outside = (1 - mask)[..., None] * np.float32(generator.uniform(0.3, 1.0))
    inside = mask[..., None] * np.float32(generator.uniform(0.2, 0.8) * (generator.random() < 0.5))
    for share, ground in zip((outside, inside), grounds, strict=True):
        picture = picture + share * (shade ** np.float32(generator.uniform(0.3, 1.0)) * ground - picture)
    return np.clip(picture, 0, 255).astype(np.uint8)


def _repainted(picture: Floats, mask: Floats, generator: Generator) -> Floats:
    """Returns a picture with colour, contrast and stripes of its buildings changed, each its own way."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats((mask >= 0.5).astype(np.uint8))
    painted = picture.copy()
    for number in range(1, min(count, _MOST_COMPONENTS + 1)):
        x, y, width, height, area = stats[number]
        if area < _LEAST_PIXELS or generator.random() < 0.3:
            continue
        window = (slice(y, y + height), slice(x, x + width))
        inside = labels[window] == number
        pixels = painted[window][inside]
        mean = pixels.mean(axis=0)
        # Mostly greys, which real roofs are and drawn ones are not.
        paint = generator.uniform(0.05, 0.95) + generator.normal(0.0, generator.choice((0.02, 0.15)), 3)
        colour = mean + generator.uniform(0.2, 1.0) * (paint - mean)
        pixels = colour + generator.uniform(0.4, 1.4) * (pixels - mean)
        if generator.random() < 0.4:
            pixels = pixels * _stripes(inside, generator)[:, None]
        painted[window][inside] = pixels
    return np.asarray(painted, np.float32)


def _stripes(inside: NDArray[np.bool_], generator: Generator) -> Floats:
    """Returns (N,) factors of the pixels of a building: corrugated sheets, panels, seams along its sides."""
    rows, columns = np.nonzero(inside)
    angle = np.deg2rad(cv2.minAreaRect(np.stack([columns, rows], axis=1).astype(np.int32))[2])
    angle += generator.choice((0.0, 0.5 * np.pi))
    along = columns * np.cos(angle) + rows * np.sin(angle)
    wave = np.sin(2 * np.pi * along / generator.uniform(2.5, 20.0))
    if generator.random() < 0.5:
        wave = np.sign(wave - generator.uniform(-0.8, 0.8))
    return np.asarray(1 + generator.uniform(0.02, 0.25) * wave, np.float32)


def _field(shape: tuple[int, ...], generator: Generator, channels: int) -> Floats:
    """Returns (H, W, channels) smooth random numbers, about within -1 to 1."""
    cells = int(generator.integers(2, 7))
    coarse = generator.uniform(-1.0, 1.0, (cells, cells, channels)).astype(np.float32)
    field = cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return np.asarray(field.reshape(*shape[:2], channels), np.float32)


def _unevenly_lit(picture: Floats, generator: Generator) -> Floats:
    """Returns a picture with the shades of clouds, and with colours that drift from place to place."""
    shade = np.exp(generator.uniform(0.1, 0.6) * _field(picture.shape, generator, 1))
    return np.asarray(picture * shade + generator.uniform(0.0, 0.12) * _field(picture.shape, generator, 3))


def _as_is(picture: Floats, _generator: Generator) -> Floats:
    return picture


def _other_colours(picture: Floats, generator: Generator) -> Floats:
    """Returns a picture with hue turned and saturation changed."""
    grey = (picture @ _LUMA)[..., None]
    turn = generator.uniform(-np.pi, np.pi)
    # A turn about the axis of greys, by Rodrigues' formula.
    axis = np.full((3, 1), 1 / np.sqrt(3.0))
    cross = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / np.sqrt(3.0)
    matrix = np.cos(turn) * np.eye(3) + np.sin(turn) * cross + (1 - np.cos(turn)) * (axis @ axis.T)
    chroma = (picture - grey) @ matrix.T.astype(np.float32)
    return np.asarray(grey + np.float32(generator.uniform(0.0, 1.6)) * chroma, np.float32)


def _swapped(picture: Floats, generator: Generator) -> Floats:
    """Returns a picture with its channels in another order."""
    return np.ascontiguousarray(picture[..., generator.permutation(3)])


def _near_infrared(picture: Floats, generator: Generator) -> Floats:
    """Returns a picture as near-infrared, red and green: what is green becomes bright red."""
    green = picture[..., 1] - 0.5 * (picture[..., 0] + picture[..., 2])
    infrared = picture @ _LUMA + np.float32(generator.uniform(1.5, 4.0)) * np.clip(green, -0.05, None)
    return np.asarray(np.stack([infrared, picture[..., 0], picture[..., 1]], axis=2), np.float32)


def _grey(picture: Floats, generator: Generator) -> Floats:
    """Returns a picture of one band, at times its negative, in greys."""
    return np.repeat(_band(picture, generator)[..., None], 3, axis=2)


def _thermal(picture: Floats, generator: Generator) -> Floats:
    """Returns a picture of one band in a thermal camera's false colours."""
    levels = (255 * _band(picture, generator)).astype(np.uint8)
    coloured = cv2.applyColorMap(levels, _PALETTES[int(generator.integers(len(_PALETTES)))])
    return np.asarray(coloured[..., ::-1], np.float32) / np.float32(255)


def _band(picture: Floats, generator: Generator) -> Floats:
    """Returns (H, W) one band in [0, 1], stretched, at times with its tones turned round."""
    band = picture @ generator.dirichlet((1.0, 1.0, 1.0)).astype(np.float32)
    if generator.random() < 0.5:
        band = band + np.float32(generator.uniform(0.0, 0.4)) * _field(band.shape, generator, 1)[..., 0]
    low, high = np.quantile(band[::4, ::4], (0.01, 0.99))
    tones = np.clip((band - low) / max(high - low, 0.05), 0.0, 1.0, dtype=np.float32)
    if generator.random() < 0.4:
        tones = 1 - tones
    return np.asarray(tones ** np.float32(np.exp(generator.normal(0.0, 0.5))), np.float32)


def _toned(picture: Floats, generator: Generator) -> Floats:
    """Returns a picture with other exposure, contrast and balance, and at times in haze."""
    gamma = np.float32(np.exp(generator.normal(0.0, 0.3)))
    gains = np.exp(generator.normal(0.0, 0.15) + generator.normal(0.0, 0.08, 3)).astype(np.float32)
    picture = np.clip(picture, 0.0, 1.0) ** gamma * gains
    if generator.random() < 0.2:
        haze, air = generator.uniform(0.0, 0.6), generator.uniform(0.4, 1.0)
        picture = picture + np.float32(haze) * (np.float32(air) - picture)
    return np.asarray(picture, np.float32)


def _blurred(picture: Floats, generator: Generator) -> Floats:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), generator.uniform(0.3, 1.6)), np.float32)


def _sharpened(picture: Floats, generator: Generator) -> Floats:
    soft = cv2.GaussianBlur(picture, (0, 0), generator.uniform(0.6, 1.5))
    return np.asarray(picture + np.float32(generator.uniform(0.3, 1.5)) * (picture - soft), np.float32)


def _noisy(picture: Floats, generator: Generator) -> Floats:
    noise = generator.standard_normal(picture.shape, dtype=np.float32)
    return np.asarray(picture + np.float32(generator.uniform(0.0, 0.06)) * noise, np.float32)


def _compressed(picture: Floats, generator: Generator) -> Floats:
    levels = (255 * np.clip(picture, 0.0, 1.0)).astype(np.uint8)
    _, content = cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, int(generator.integers(25, 90))])
    return np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR), np.float32) / np.float32(255)


Change = Callable[[Floats, Generator], Floats]
# Odds and changes: one of the first, each of the second by itself.
_SENSORS: tuple[tuple[float, Change], ...] = (
    (0.35, _as_is),
    (0.27, _other_colours),
    (0.12, _swapped),
    (0.05, _near_infrared),
    (0.09, _grey),
    (0.12, _thermal),
)
_OPTICS: tuple[tuple[float, Change], ...] = (
    (0.25, _blurred),
    (0.25, _sharpened),
    (0.4, _noisy),
    (0.35, _compressed),
)


def _drawn(generator: Generator, odds: tuple[tuple[float, Change], ...]) -> Change:
    shares = np.cumsum([share for share, _ in odds])
    return odds[int(np.searchsorted(shares, generator.random() * shares[-1]))][1]
