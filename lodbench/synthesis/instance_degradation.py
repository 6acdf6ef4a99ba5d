"""True masks of single buildings made as wrong as an instance segmentation network's.

The outline of all of them together is given, made wrong by ``mask_degradation``. Within it borders between
buildings wobble, neighbours are taken for one building, and buildings for two.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.synthesis.mask_degradation import smooth_noise, typical_pixels_per_m

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
        buildings: (H, W) int32, which building is seen in truth, -1 for none.
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
    found, counts = np.unique(np.sort(np.concatenate(touching), axis=1), axis=0, return_counts=True)
    return {(int(a), int(b)): int(n) for (a, b), n in zip(found, counts, strict=True)}


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
