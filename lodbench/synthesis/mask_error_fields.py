"""Fields of mask errors: for each kind, at which strength a pixel turns wrong.

(H, W) float32, infinite where it never does. ``mask_degradation`` turns them into masks.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Field = NDArray[np.float32]
Labels = NDArray[np.int32]
Pair = tuple[float, float]

# Wobble at strength 1, metres.
_WOBBLE_M = 0.4
# Wavelengths of the wobble in metres and their shares: leaning outlines, bays, ragged edges.
_WOBBLE_BANDS = ((26.0, 0.75), (9.0, 0.55), (3.2, 0.28))
# Standard deviation of the blur that rounds corners, as networks draw them.
_BLUR_M = 0.8
# Distances beyond this say no more than "far".
_FAR_PX = 50.0


def signed_distance(mask: Mask) -> tuple[Field, Labels]:
    """Returns the signed distance to the outline, and which building each pixel is nearest to.

    Of a (H, W) mask with a building pixel: distances of pixel centres, (H, W) float32 pixels, positive inside
    (infinite where there is no background), and labels 1, 2, ... of the nearest connected building, (H, W)
    int32.
    """
    outside, labels = cv2.distanceTransformWithLabels(
        (~mask).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_CCOMP
    )
    nearest = np.asarray(labels, dtype=np.int32)
    if mask.all():
        return np.full(mask.shape, np.inf, dtype=np.float32), nearest
    inside = cv2.distanceTransform(mask.view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    # The outline runs between two pixel centres, half a pixel from each.
    distance = inside - outside + np.where(mask, -0.5, 0.5)
    return np.asarray(distance, dtype=np.float32), nearest


def smooth_noise(shape: tuple[int, ...], wavelength: float, generator: np.random.Generator) -> Field:
    """Returns band-limited noise of unit variance, (H, W): a cubic B-spline surface over random knots.

    The wavelength is the pixels between crests, twice the spacing of the knots; each knot is one normal draw.
    """
    spacing = max(wavelength / 2, 1.0)
    counts = [math.ceil(size / spacing) + 4 for size in shape]
    surface = generator.standard_normal(counts).astype(np.float32)
    # Rows last: taking whole rows is quick, and by then the array is large.
    for axis in (1, 0):
        size = shape[axis]
        position = np.arange(size, dtype=np.float64) / spacing
        knot = position.astype(np.int64)
        t = position - knot
        inner = 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1
        weights = np.stack([(1 - t) ** 3, *inner, t**3]) / 6
        # Unit variance at every pixel, between the knots as on them.
        weights /= np.sqrt((weights**2).sum(axis=0))
        columns = [-1, 1] if axis == 0 else [1, -1]
        surface = sum(
            np.take(surface, knot + k, axis=axis) * weights[k].astype(np.float32).reshape(columns)
            for k in range(4)
        )
    return surface


def moved_outline(distance: Field, generator: np.random.Generator, pixels_per_m: float) -> Field:
    """Returns the strength at which an outline, blurred and moved by smooth noise, passes each pixel."""
    noise = np.zeros_like(distance)
    for wavelength_m, share in _WOBBLE_BANDS:
        noise += np.float32(share) * smooth_noise(distance.shape, wavelength_m * pixels_per_m, generator)
    reach = noise * np.float32(-_WOBBLE_M * pixels_per_m)
    sharp = np.clip(distance, -_FAR_PX, _FAR_PX)
    blurred = cv2.GaussianBlur(sharp, (0, 0), _BLUR_M * pixels_per_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        reached = blurred / reach
        rounded = 2 * sharp / (sharp - blurred)
    reached[~(reached > 0)] = np.inf
    # A corner that the blur takes off stays on where the noise soon moves the outline back.
    return np.where(sharp * blurred > 0, reached, np.where(reached < 4, np.float32(np.inf), rounded))


def dropped_areas(mask: Mask, labels: Labels, generator: np.random.Generator, pixels_per_m: float) -> Field:
    """Returns the strength at which each pixel's building is missed: holes in roofs, small buildings.

    Every pixel is missed at some strength, so that any IoU can be reached.
    """
    noise = 0.8 * smooth_noise(mask.shape, 40.0 * pixels_per_m, generator)
    noise += 0.6 * smooth_noise(mask.shape, 12.0 * pixels_per_m, generator)
    # exp(1.7 n) / (1 + exp(1.7 n)) is close to the normal distribution function: the strength grows
    # as the odds of the noise, and 3 % of the roofs are holes at strength 3.
    holes = 90.0 * np.exp(1.7 * noise)
    area = np.bincount(labels[mask], minlength=int(labels.max()) + 1)
    # Small buildings go first: a shed of 30 m2 at a strength of about 3, a house of 150 m2 at 8.
    birth = generator.exponential(1.0, len(area)) * 0.6 * np.sqrt(area) / pixels_per_m + 0.5
    birth[area > 0.15 * area.sum()] = np.inf
    # A building goes patch by patch over a short stretch of strength, so the IoU has no jump.
    dwindling = birth.astype(np.float32)[labels] + np.float32(0.3) * noise
    return np.asarray(np.minimum(holes, dwindling), dtype=np.float32)


def trees_in_front(mask: Mask, generator: np.random.Generator, pixels_per_m: float) -> Field:
    """Returns the strength at which a tree crown hides each pixel.

    Trees stand on the ground before the lower outlines, where an oblique view shows facades, some
    of them in rows; their crowns are 5 to 12 m wide.
    """
    strength = np.full(mask.shape, np.inf, np.float32)
    rows, columns = np.nonzero(mask[:-1] & ~mask[1:])
    if len(rows) == 0:
        return strength
    ragged = 0.2 * smooth_noise(mask.shape, 3.5 * pixels_per_m, generator)
    for anchor in generator.integers(len(rows), size=max(1, round(len(rows) / (9.0 * pixels_per_m)))):
        birth, radius_m = generator.uniform(0.3, 10.0), generator.uniform(2.4, 6.0)
        step = round(1.7 * radius_m * pixels_per_m)
        for k in range(int(generator.integers(1, 4))):
            radius = radius_m * generator.uniform(0.8, 1.2) * pixels_per_m
            drop = generator.uniform(-0.4, 0.7) * radius
            # The next tree of the row stands where the same outline crosses the next column.
            x = int(columns[anchor]) + k * step
            near = np.nonzero((columns == x) & (np.abs(rows - rows[anchor]) < 2 * step))[0]
            if len(near):
                center = (float(rows[near[0]]) - drop, float(x))
                _stamp(strength, ragged, center, (radius, radius), 0.0, birth)
    return strength


def added_blobs(mask: Mask, generator: np.random.Generator, pixels_per_m: float) -> Field:
    """Returns the strength at which ground is taken for a building: yards, lorries, bridges."""
    height, width = mask.shape
    odds = np.exp(1.7 * smooth_noise(mask.shape, 30.0 * pixels_per_m, generator))
    strength = np.asarray(200.0 * odds, dtype=np.float32)
    ragged = 0.2 * smooth_noise(mask.shape, 5.0 * pixels_per_m, generator)
    for _ in range(max(4, round(height * width / (32.0 * pixels_per_m) ** 2))):
        center = (generator.uniform(0, height), generator.uniform(0, width))
        half, stretch = generator.uniform(1.5, 4.5) * pixels_per_m, generator.uniform(1.0, 3.0)
        turn, birth = generator.uniform(0, math.pi), generator.uniform(0.5, 12.0)
        _stamp(strength, ragged, center, (half * stretch, half), turn, birth)
    return strength


def _stamp(strength: Field, ragged: Field, center: Pair, radii: Pair, turn: float, birth: float) -> None:
    """Lowers the strength inside one ellipse with a ragged edge: to ``birth`` at its middle.

    It grows to full size over half a unit of strength, so that the IoU has no jump.
    """
    reach = math.ceil(1.5 * max(radii))
    rows = slice(max(0, int(center[0]) - reach), max(0, int(center[0]) + reach))
    columns = slice(max(0, int(center[1]) - reach), max(0, int(center[1]) + reach))
    window = strength[rows, columns]
    y = np.arange(window.shape[0], dtype=np.float32)[:, None] + np.float32(rows.start - center[0])
    x = np.arange(window.shape[1], dtype=np.float32)[None, :] + np.float32(columns.start - center[1])
    along = (x * math.cos(turn) + y * math.sin(turn)) / radii[0]
    across = (y * math.cos(turn) - x * math.sin(turn)) / radii[1]
    rho = np.sqrt(along * along + across * across) + ragged[rows, columns]
    np.minimum(window, birth + 0.5 * np.maximum(rho, 0), out=window, where=rho < 1)
