"""A clean building mask made as wrong as a segmentation network's: one generator for every use.

Every kind of error is drawn once, as a field that says at which strength each pixel turns wrong
(``mask_error_fields``). Strength 1 is an outline that wobbles by about 0.4 m.
One number, the strength, then turns the whole mask from clean to hopeless, and bisection finds the
strength that meets a target IoU without drawing a random number twice.

Fields of mask errors: for each kind, at which strength a pixel turns wrong. (H, W) float32, infinite where
it never does. ``mask_degradation`` turns them into masks.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.errors import LodbenchError
from lodbench.rendering.masks import signed_distance
from lodbench.storage import random_stream

Labels = NDArray[np.int32]

# Standard deviation of the borders' place, metres, and the wavelengths it has.
_BORDER_M, _BORDER_BANDS_M = 0.8, (9.0, 3.2)


def degraded_instances(
    buildings: Labels,
    mask: NDArray[np.bool_],
    generator: np.random.Generator,
    *,
    merged: float = 0.1,
    split: float = 0.05,
) -> NDArray[np.uint16]:
    """Returns labels of buildings, 0 for none, with the errors of a network: they fill a given mask.

    Labels, (H, W) uint16, are 1, 2, ... where the mask is set; parts of it that hold no building of the truth
    have labels of their own.

    Args:
        buildings: (H, W) int32, which building the truth shows, -1 for none.
        mask: (H, W) bool, where the network says building.
        generator: The only source of randomness.
        merged: Share of buildings that are taken for one with the neighbour they share most pixels with.
        split: Share of what is then left that is cut in two.
    """
    joined = _merged(_wobbled(buildings, generator), merged, generator)
    return filled(_split(joined, split, generator), mask)


def _wobbled(buildings: Labels, generator: np.random.Generator) -> Labels:
    """Returns labels read beside their places, by a smooth random step."""
    pixels_per_m = typical_pixels_per_m(buildings.shape)
    steps = [np.zeros(buildings.shape, np.float32) for _ in range(2)]
    for step in steps:
        for wavelength_m in _BORDER_BANDS_M:
            step += smooth_noise(buildings.shape, wavelength_m * pixels_per_m, generator)
        step *= np.float32(_BORDER_M * pixels_per_m / len(_BORDER_BANDS_M) ** 0.5)
    rows, columns = np.indices(buildings.shape, dtype=np.float32)
    # Exact in float32: no scene has 2**24 buildings in view.
    numbers, places = buildings.astype(np.float32), (columns + steps[0], rows + steps[1])
    return cv2.remap(numbers, *places, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE).astype(np.int32)


def _merged(labels: Labels, share: float, generator: np.random.Generator) -> Labels:
    """Returns labels where some buildings have their neighbour's."""
    pairs = _borders(labels)
    if not (labels >= 0).any():
        return labels
    first_of = np.arange(int(labels.max()) + 1)
    for building in np.unique(labels[labels >= 0]):
        draw = generator.uniform()
        lengths = {b if a == building else a: n for (a, b), n in pairs.items() if building in (a, b)}
        if draw < share and lengths:
            neighbour = max(lengths, key=lambda other: (lengths[other], -other))
            first_of[first_of == first_of[building]] = first_of[neighbour]
    return np.where(labels >= 0, first_of[np.maximum(labels, 0)], -1).astype(np.int32)


def _borders(labels: Labels) -> dict[tuple[int, int], int]:
    """Returns how many pixels of pairs of buildings lie side by side."""
    sides = [(labels[:, :-1], labels[:, 1:]), (labels[:-1], labels[1:])]
    touching = [np.stack([a, b], axis=-1)[(a != b) & (a >= 0) & (b >= 0)] for a, b in sides]
    pairs, counts = np.unique(np.sort(np.concatenate(touching), axis=1), axis=0, return_counts=True)
    return {(int(a), int(b)): int(n) for (a, b), n in zip(pairs, counts, strict=True)}


def _split(labels: Labels, share: float, generator: np.random.Generator) -> Labels:
    """Returns labels where some buildings are cut in two, each by a line through its middle."""
    result, beyond = labels.copy(), int(labels.max(initial=-1)) + 1
    for building in np.unique(labels[labels >= 0]):
        draw, angle = generator.uniform(), generator.uniform(0.0, np.pi)
        if draw < share:
            rows, columns = np.nonzero(labels == building)
            side = (rows - rows.mean()) * np.sin(angle) + (columns - columns.mean()) * np.cos(angle) > 0
            result[rows[side], columns[side]] = beyond
            beyond += 1
    return result


def filled(labels: Labels, mask: NDArray[np.bool_]) -> NDArray[np.uint16]:
    """Returns (H, W) labels 1, 2, ... that fill a mask: of the nearest building, else of each patch.

    ``labels`` are -1 where there is no building.
    """
    _, patches = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    held = labels >= 0
    has_building = np.bincount(patches[mask & held], minlength=patches.max() + 1) > 0
    filled = np.where(mask, labels.max(initial=-1) + 1 + patches, -1)
    if (mask & held).any():
        seed = (~(mask & held)).astype(np.uint8)
        _, nearest = cv2.distanceTransformWithLabels(
            seed, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        of_seed = np.zeros(int(nearest.max()) + 1, np.int32)
        of_seed[nearest[seed == 0]] = labels[seed == 0]
        filled = np.where(mask & has_building[patches], of_seed[nearest], filled)
    _, numbered = np.unique(filled[mask], return_inverse=True)
    result = np.zeros(mask.shape, np.uint16)
    result[mask] = numbered + 1
    return result


Mask = NDArray[np.bool_]
Field = NDArray[np.float32]
Pair = tuple[float, float]

# Wobble at strength 1, metres.
_WOBBLE_M = 0.4
# Wavelengths of the wobble in metres and their shares: leaning outlines, bays, ragged edges.
_WOBBLE_BANDS = ((26.0, 0.75), (9.0, 0.55), (3.2, 0.28))
# Standard deviation of the blur that rounds corners, as networks draw them.
_BLUR_M = 0.8
# Distances beyond this say no more than "far".
_FAR_PX = 50.0


def distances_to_buildings(mask: Mask) -> tuple[Field, Labels]:
    """Returns the signed distance to the outline, and which building each pixel is nearest to.

    Of a (H, W) mask with a building pixel: distances as of ``signed_distance``, and labels 1, 2, ... of the
    nearest connected building, (H, W) int32.
    """
    outside, labels = cv2.distanceTransformWithLabels(
        (~mask).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_CCOMP
    )
    return np.where(mask, signed_distance(mask), 0.5 - outside), np.asarray(labels, dtype=np.int32)


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


# How close the achieved IoU comes to the target, unless one pixel is already more than that.
IOU_TOLERANCE = 0.005
# Halvings of the bracket around the strength: down to a millionth, finer than any tie of pixels.
_BISECTIONS = 20
# Pixels per metre of a 602-pixel-wide view from about 160 m, the benchmark's usual distance.
_TYPICAL_PIXELS_PER_M = 2.6


def degrade_mask(
    mask: Mask,
    target_iou: float,
    generator: np.random.Generator,
    *,
    trees: bool = True,
    pixels_per_m: float | None = None,
    truth: Mask | None = None,
) -> tuple[Mask, float]:
    """Returns a mask with the errors of a segmentation network, at an IoU with the clean one.

    The errors are connected, never independent per pixel: an outline that wobbles and rounds its
    corners, trees in front of buildings, roofs and small buildings missed, and patches added.

    Args:
        mask: (H, W) bool, True on buildings.
        target_iou: Wanted IoU with ``mask``, in (0, 1]; 1 returns a copy of the mask.
        generator: The only source of randomness.
        trees: Whether trees stand in front of buildings.
        pixels_per_m: Image scale at the buildings, for the size of trees and patches; by default
            that of the benchmark's drone views (2.6 pixels per metre in an image 602 wide).
        truth: (H, W) bool, the mask to measure the IoU with, where it is not ``mask``: with trees that
            hide buildings already taken out of ``mask``. Where they alone take more than the target
            allows, ``mask`` comes back as it is.

    Returns:
        The degraded mask, (H, W) bool, and the IoU achieved: within `IOU_TOLERANCE` of the target,
        or as near as single pixels allow in a mask of a few hundred pixels. An empty mask comes
        back empty with IoU 0, for it has no buildings to be wrong about.

    Raises:
        LodbenchError: The mask is not a bool image, the target lies outside (0, 1], or the scale is
            not positive.
    """
    if mask.ndim != 2 or mask.dtype != np.bool_:
        raise LodbenchError(f"A mask is a bool image (H, W), not {mask.dtype} of shape {mask.shape}.")
    if not 0.0 < target_iou <= 1.0:
        raise LodbenchError(f"A target IoU lies in (0, 1], not {target_iou}.")
    if pixels_per_m is not None and not pixels_per_m > 0.0:
        raise LodbenchError(f"An image scale is positive, not {pixels_per_m} pixels per metre.")
    truth = mask if truth is None else truth
    if not mask.any():
        return mask.copy(), 0.0
    if mask_iou(mask, truth) <= target_iou:
        return mask.copy(), mask_iou(mask, truth)
    errors = _draw_errors(mask, generator, trees, pixels_per_m or typical_pixels_per_m(mask.shape))
    wrong = errors.apply(mask, _strength_for(errors, mask, truth, target_iou))
    return wrong, mask_iou(wrong, truth)


def mask_iou(a: Mask, b: Mask) -> float:
    """Returns intersection over union of two (H, W) masks; 0 when both are empty."""
    union = int(np.count_nonzero(a | b))
    return int(np.count_nonzero(a & b)) / union if union else 0.0


def typical_pixels_per_m(shape: tuple[int, ...]) -> float:
    """Returns the image scale of the benchmark's drone views at a size, (height, width) pixels."""
    height, width = shape
    return _TYPICAL_PIXELS_PER_M * math.sqrt(height * width / (602 * 448))


class _Errors(NamedTuple):
    """The fields of errors in the order they act in.

    First the outline moves, then buildings are missed or hidden together with what their outline gained,
    then ground is added.
    """

    outline: Field
    hidden: Field
    added: Field

    def apply(self, mask: Mask, strength: float) -> Mask:
        """Returns the mask, (H, W), with the errors of a strength."""
        moved = (mask ^ (self.outline < strength)) & (self.hidden >= strength)
        return np.asarray(moved | (~mask & (self.added < strength)))


def _draw_errors(mask: Mask, generator: np.random.Generator, trees: bool, pixels_per_m: float) -> _Errors:
    """Draws every field once; each has a stream of its own, so leaving trees out changes no other."""
    seed = int(generator.integers(2**63))
    streams = [random_stream(seed, kind) for kind in ("outline", "dropped", "trees", "added")]
    distance, labels = distances_to_buildings(mask)
    outline = moved_outline(distance, streams[0], pixels_per_m)
    hidden = dropped_areas(mask, labels, streams[1], pixels_per_m)
    if trees:
        np.minimum(hidden, trees_in_front(mask, streams[2], pixels_per_m), out=hidden)
    return _Errors(outline, hidden, added_blobs(mask, streams[3], pixels_per_m))


def _strength_for(errors: _Errors, mask: Mask, truth: Mask, target: float) -> float:
    """Returns the strength whose errors bring the IoU with the truth nearest to the target."""
    # Pixels outside the mask never leave it, and the other way about: each field is needed in one place.
    lost_at = np.minimum(errors.outline, errors.hidden)
    held, surplus = lost_at[mask & truth], lost_at[mask & ~truth]
    missed, free = (_Errors(*(field[area] for field in errors)) for area in (truth & ~mask, ~truth & ~mask))
    num_true = int(np.count_nonzero(truth))

    def gained(area: _Errors, strength: float) -> int:
        return int(np.count_nonzero(area.apply(np.zeros(len(area.added), bool), strength)))

    def iou(strength: float) -> float:
        shared = int(np.count_nonzero(held >= strength)) + gained(missed, strength)
        beyond = int(np.count_nonzero(surplus >= strength)) + gained(free, strength)
        return shared / (num_true + beyond)

    # Every building pixel is missed at some strength, so doubling gets below any target.
    low, high = 0.0, 1.0
    while iou(high) > target:
        low, high = high, 2 * high
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if iou(middle) > target else (low, middle)
    return min((low, high), key=lambda strength: abs(iou(strength) - target))
