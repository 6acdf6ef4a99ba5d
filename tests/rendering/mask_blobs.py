"""Masks of a few boxes, to compare silhouettes with."""

import numpy as np

from lodbench.rendering.bits import pack_mask


def blobs(rng, width, height, count):
    """Returns masks of a few boxes each, some empty, some full."""
    masks = np.zeros((count, height, width), dtype=bool)
    for n in range(count):
        for _ in range(n % 4):
            left, right = np.sort(rng.integers(0, width + 1, 2))
            top, bottom = np.sort(rng.integers(0, height + 1, 2))
            masks[n, top:bottom, left:right] ^= True
    masks[-1] = True
    return masks


def packed(masks):
    """Returns masks as the engine has them."""
    return np.stack([pack_mask(mask) for mask in masks])
