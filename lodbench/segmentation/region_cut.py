"""A mask from a silhouette that is nearly right: what lies inside looks alike, and outlines follow edges."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.geometry.signed_distance import signed_distance
from lodbench.kernels.estimation import least_total
from lodbench.rendering import appearance_bins

Mask = NDArray[np.bool_]
Floats = NDArray[np.float32]

# Halves of a chequerboard of this side, pixels, are measured by what the other half looks like.
_BLOCK_PX = 16
# Of what a pixel looks like against the silhouette, and the largest that it may say: nats.
_COLOUR_WEIGHT, _COLOUR_LIMIT = 0.5, 2.5
# The silhouette: nats far inside or outside, and the distance from its outline that reaches them, pixels:
# from one to the other as the outline's exactness goes from the first to the second; see ``exactness``.
_SHAPE_NATS, _SHAPE_PX, _EXACTNESS = 6.0, (8.0, 2.0), (1.1, 1.5)
# How far from an outline its change is looked at, and what still lies on it, pixels.
_ACROSS_PX, _ON_PX = 5, 1
# Cost of an outline per pixel where the photo is flat; at its edges this share of it is left.
_OUTLINE_NATS, _EDGE_SHARE = 1.5, 0.08
# Pixels near the outline say less of their side: full weight from here on, and the least.
_SURE_PX, _LEAST_WEIGHT = 2.0, 0.1
_ITERATIONS = 150


def cut(photo: NDArray[np.uint8], silhouette: Mask, looks: NDArray[np.floating] | None = None) -> Floats:
    """Returns the (H, W) probability of building: 0 or 1 nearly everywhere.

    The global minimum of: nats of each pixel's colour and texture against the silhouette's two histograms,
    plus nats of its distance to the outline, plus the length of the new outline, which is cheap along edges
    of the photo (weighted total variation: Chan, Esedoglu and Nikolova 2006, Bresson et al. 2007; solved as
    Chambolle and Pock 2011). A pixel's histograms are those of other parts of the photo, so that what the
    silhouette covers wrongly does not vouch for itself.

    Args:
        photo: (H, W, 3) BGR, at the size to work at.
        silhouette: (H, W).
        looks: (H, W) nats by which each pixel looks like the inside, where more than this photo tells them.
    """
    stated = cross_fitted(photo, silhouette) if looks is None else looks
    colours = np.clip(stated, -_COLOUR_LIMIT, _COLOUR_LIMIT)
    reach_px = float(np.interp(exactness(photo, silhouette), _EXACTNESS, _SHAPE_PX))
    shape = np.clip(signed_distance(silhouette) / reach_px, -1.0, 1.0)
    against = -(_COLOUR_WEIGHT * colours + _SHAPE_NATS * shape)
    beside, upright = _outline_costs(photo)
    return np.asarray(least_total(against.astype(np.float32), beside, upright, _ITERATIONS), np.float32)


def cross_fitted(photo: NDArray[np.uint8], silhouette: Mask) -> Floats:
    """Returns (H, W) nats by which a pixel looks like the inside rather than the outside, by other pixels."""
    height, width = silhouette.shape
    bins, num_bins = appearance_bins(photo, (width, height))
    distance = signed_distance(silhouette)
    weight = np.clip(np.abs(distance) / _SURE_PX, _LEAST_WEIGHT, 1.0)
    rows, columns = np.arange(height)[:, None] // _BLOCK_PX, np.arange(width) // _BLOCK_PX
    half = (rows + columns) % 2
    nats = np.zeros((height, width), np.float32)
    for held_out in (0, 1):
        others = half != held_out
        logs = []
        for side in (silhouette & others, ~silhouette & others):
            counts = np.bincount(bins[side], weight[side], num_bins) + 0.5
            logs.append(np.log(counts / counts.sum()))
        nats[~others] = (logs[0] - logs[1])[bins[~others]]
    return np.asarray(cv2.GaussianBlur(nats, (0, 0), 1.0), np.float32)


def held_out_evidence(photo: NDArray[np.uint8], silhouette: Mask) -> float:
    """Returns nats per pixel that a photo's looks tell of a silhouette's sides, measured by other pixels."""
    nats = cross_fitted(photo, silhouette).astype(np.float64)
    share = min(max(float(silhouette.mean()), 1e-6), 1.0 - 1e-6)
    inside, outside = np.log(share), np.log(1.0 - share)
    stated = np.where(silhouette, inside + nats, outside) - np.logaddexp(inside + nats, outside)
    return float(stated.mean() - share * inside - (1.0 - share) * outside)


def exactness(photo: NDArray[np.uint8], silhouette: Mask) -> float:
    """Returns how much more a photo changes across an outline on it than beside it; 1 for no more.

    A silhouette that shows buildings as they are has the photo's edges on its outline, a rough one beside it.
    """
    lab = cv2.cvtColor(photo.astype(np.float32) / np.float32(255), cv2.COLOR_BGR2LAB)
    lab = np.asarray(cv2.GaussianBlur(lab, (0, 0), 0.8), np.float32)
    distance = signed_distance(silhouette)
    beside, upright = _gradient(np.asarray(cv2.GaussianBlur(distance, (0, 0), 1.5), np.float32))
    steepness = np.hypot(beside, upright) + np.float32(1e-6)
    beside, upright = beside / steepness, upright / steepness
    by_column, by_row = _gradient(np.asarray(lab, np.float32))
    change = np.abs(by_column * beside[..., None] + by_row * upright[..., None]).sum(axis=2)
    rows, columns = np.nonzero(np.abs(distance) < 1.0)
    across = np.arange(-_ACROSS_PX, _ACROSS_PX + 1, dtype=np.float32)[:, None]
    x = columns + across * beside[rows, columns]
    y = rows + across * upright[rows, columns]
    profile = cv2.remap(change, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    shares = profile / (profile.sum(axis=0) + np.float32(1e-6))
    on = np.abs(across[:, 0]) <= _ON_PX
    return float(shares[on].mean() * len(across)) if len(rows) else 1.0


def _gradient(picture: Floats) -> tuple[Floats, Floats]:
    """Returns the change of a picture from left to right and from top to bottom."""
    beside, upright = (cv2.Sobel(picture, cv2.CV_32F, *axis) for axis in ((1, 0), (0, 1)))
    return np.asarray(beside, np.float32), np.asarray(upright, np.float32)


def _outline_costs(photo: NDArray[np.uint8]) -> tuple[Floats, Floats]:
    """Returns what an outline costs between each pixel and its right and its lower neighbour."""
    smooth = cv2.GaussianBlur(photo.astype(np.float32), (0, 0), 0.7)
    beside, upright = np.zeros(photo.shape[:2], np.float32), np.zeros(photo.shape[:2], np.float32)
    beside[:, :-1] = np.abs(np.diff(smooth, axis=1)).max(axis=2)
    upright[:-1] = np.abs(np.diff(smooth, axis=0)).max(axis=2)
    usual = float((beside**2).mean() + (upright**2).mean()) + 1e-6
    costs = (
        _OUTLINE_NATS * (_EDGE_SHARE + (1 - _EDGE_SHARE) * np.exp(-(c**2) / usual)) for c in (beside, upright)
    )
    first, second = costs
    return first.astype(np.float32), second.astype(np.float32)
