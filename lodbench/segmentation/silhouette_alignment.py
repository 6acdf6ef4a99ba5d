"""Where a silhouette that is a little off lies in a photo: moved and turned until it splits it best."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.rendering import ContourFit, RegionFit, appearance_bins, edge_bins
from lodbench.rendering.bits import pack_mask

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]

# Samples of the search: every so many pixels, this many turns, this many starts of a climb, masks at a time.
_STEP_PX, _TURNS, _STARTS, _CHUNK = 4.0, 7, 4, 128
# First steps of a climb: pixels, pixels, degrees, logarithm of the scale.
_FIRST_STEPS = np.array([2.5, 2.5, 1.2, 0.01])
_EVALUATIONS = 140
# Weight of edges along the outline beside regions, and their blur.
_EDGE_WEIGHT, _EDGE_BLUR_PX = 2.0, 1.0
# Silhouettes that are enlarged are penalised: nats per pixel at one standard deviation of the logarithm.
_SCALE_SIGMA, _SCALE_PENALTY = 0.02, 5e-4
# Alignments nearer to each other than this are the same: pixels, degrees.
_SAME = np.array([3.0, 3.0, 1.5])


class Alignment(NamedTuple):
    """A silhouette laid over a photo.

    Attributes:
        mask: (H, W) where it lies.
        fit: Nats per pixel that it explains of the photo; see ``RegionFit``.
        motion: (4,) pixels to the right and down, degrees counter-clockwise, logarithm of the scale.
    """

    mask: Mask
    fit: float
    motion: Floats


def aligned(
    photo: NDArray[np.uint8], guide: Mask, reach_px: float, turn_deg: float, count: int
) -> list[Alignment]:
    """Returns how a silhouette may lie in a photo, best first; none twice.

    A grid of shifts and turns is tried by the code length that the photo's colours save when those inside
    and outside are coded apart. From the best, Nelder and Mead's simplex climbs, the
    photo's edges along the outline counted as well.

    Args:
        photo: (H, W, 3) BGR, at the size to work at.
        guide: (H + 2 M, W + 2 M) the silhouette, with a margin M on all sides from which it is moved in.
        reach_px: Longest shift.
        turn_deg: Largest turn.
        count: At most so many.
    """
    height, width = photo.shape[:2]
    colours = RegionFit(*appearance_bins(photo, (width, height), has_texture=False))
    edges = ContourFit(*edge_bins(photo, (width, height), _EDGE_BLUR_PX))

    def value(motion: Floats) -> float:
        words = pack_mask(moved(guide, motion, (width, height)))[None]
        penalty = _SCALE_PENALTY * (motion[3] / _SCALE_SIGMA) ** 2
        return float(colours(words)[0] + _EDGE_WEIGHT * edges(words)[0] - penalty)

    grid = _grid(reach_px, turn_deg)
    fits = np.concatenate(
        [
            colours(np.stack([pack_mask(moved(guide, m, (width, height))) for m in grid[k : k + _CHUNK]]))
            for k in range(0, len(grid), _CHUNK)
        ]
    )
    tops = []
    for start in _apart(grid, fits, np.array([1.5 * _STEP_PX, 1.5 * _STEP_PX, turn_deg / 2.0]), _STARTS):
        simplex = np.vstack([start, start + np.diag(_FIRST_STEPS)])
        options = {"initial_simplex": simplex, "maxfev": _EVALUATIONS, "xatol": 0.02, "fatol": 1e-6}
        found = scipy.optimize.minimize(lambda m: -value(m), start, method="Nelder-Mead", options=options)
        tops.append(np.asarray(found.x, np.float64))
    values = np.array([value(top) for top in tops])
    return [
        Alignment(moved(guide, motion, (width, height)), value(motion), motion)
        for motion in _apart(np.array(tops), values, _SAME, count)
    ]


def moved(guide: Mask, motion: Floats, size: tuple[int, int]) -> Mask:
    """Returns the (H, W) part of a guide that lies over the photo after a motion about its centre."""
    right, down, turn, log_scale = (float(v) for v in motion)
    height, width = guide.shape
    centre = (0.5 * (width - 1), 0.5 * (height - 1))
    matrix = cv2.getRotationMatrix2D(centre, turn, math.exp(log_scale))
    matrix[:, 2] += (right - 0.5 * (width - size[0]), down - 0.5 * (height - size[1]))
    drawn = cv2.warpAffine(guide.astype(np.uint8) * 255, matrix, size, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(drawn >= 128)


def _grid(reach_px: float, turn_deg: float) -> Floats:
    steps = math.ceil(reach_px / _STEP_PX)
    shifts = np.linspace(-reach_px, reach_px, 2 * steps + 1)
    turns = np.linspace(-turn_deg, turn_deg, _TURNS)
    grid = np.stack(np.meshgrid(turns, shifts, shifts, indexing="ij"), axis=-1).reshape(-1, 3)[:, [1, 2, 0]]
    grid = grid[np.hypot(grid[:, 0], grid[:, 1]) <= reach_px * 1.05]
    return np.column_stack([grid, np.zeros(len(grid))])


def _apart(points: Floats, values: Floats, least: Floats, count: int) -> list[Floats]:
    """Returns the best points, none within ``least`` of a better one in every number."""
    chosen: list[Floats] = []
    for i in np.argsort(-values, kind="stable"):
        if all((np.abs(points[i] - other)[:3] > least).any() for other in chosen):
            chosen.append(points[i])
        if len(chosen) == count:
            break
    return chosen
