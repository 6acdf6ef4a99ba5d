"""What an outline says under one hypothesis of the world: sums over its points, errors that go together.

A mask's outline leans over tens of pixels, so near points tell the same twice; how much it errs is found from
the view itself. Roofs and bases err building by building. Points are dealt out to chunks of neighbouring
buildings: within one all errors are one covariance matrix, between two only what all points share.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lodbench.methods.contour_alignment.alignment import Residuals
from lodbench.methods.contour_alignment.correlated import error_covariance, whiten
from lodbench.methods.contour_alignment.params import Params
from lodbench.methods.contour_alignment.world_errors import WorldErrors

Floats = NDArray[np.float64]

# The numbers of a camera: three of place, three of direction, the lens.
CAMERA = 7
# Points in one matrix, which costs their number cubed.
_MOST_POINTS = 128
# Rows of chunks are as high as this, pixels of the fine size.
_BAND_PX = 90.0
# The outline's noise is looked for among points nearer than this, and is never less or more than that, px.
_FAR_PX = 20.0
_NOISE_PX = (0.5, 6.0)
# Points that agree less with the mask's direction say nothing about its noise.
_AGREES = 0.3
# Share of the outline's variance that each point has for itself.
_OWN_SHARE = 0.3
# A point that weighs less than this has a variance that no factorisation feels.
_LEAST_WEIGHT = 1e-8


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """The logarithm of a likelihood to second order, in the camera's seven numbers and three shared errors.

    Attributes:
        information: (10, 10).
        gradient: (10,) of its negative.
        log_density: At the point of linearisation, up to a constant that all hypotheses share.
    """

    information: Floats
    gradient: Floats
    log_density: float


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """A measured outline, dealt out.

    Attributes:
        here: The points.
        pixels: (N, 2) of the fine size.
        slopes: (N, 10) how distances change with the camera, common roofs and bases, and a grown mask.
        chunks: Indices of the points of each chunk.
    """

    here: Residuals
    pixels: Floats
    slopes: Floats
    chunks: tuple[NDArray[np.int64], ...]


def deal_out(here: Residuals) -> Points:
    """Returns an outline in chunks: buildings stay whole, and neighbours in the picture together."""
    pixels = here.points.pixels / here.scale
    _, building, counts = np.unique(here.points.buildings, return_inverse=True, return_counts=True)
    middle_x, middle_y = (np.bincount(building, pixels[:, k]) / counts for k in (0, 1))
    band = np.floor(middle_y / _BAND_PX)
    # There and back again, so that the end of a band lies beside the start of the next.
    ranked = np.lexsort((np.where(band % 2 == 0, middle_x, -middle_x), band))
    rank = np.empty(len(counts), np.int64)
    rank[ranked] = np.arange(len(counts))
    order = np.argsort(rank[building], kind="stable")
    cuts = [0, *_cuts(counts[ranked]), len(order)]
    slopes = np.column_stack([here.slopes, np.ones(len(order))])
    return Points(here, pixels, slopes, tuple(order[a:b] for a, b in pairwise(cuts)))


def _cuts(counts: NDArray[np.int64]) -> list[int]:
    """Returns where chunks end but the last, given the points of each building in order."""
    cuts, end, held = [], 0, 0
    for count in counts:
        if held and held + count > _MOST_POINTS:
            cuts.append(end)
            held = 0
        whole = (int(count) - 1) // _MOST_POINTS
        cuts.extend(end + (k + 1) * _MOST_POINTS for k in range(whole))
        held += int(count) - whole * _MOST_POINTS
        end += int(count)
    return cuts


def outline_noise(here: Residuals, distances: Floats) -> float:
    """Returns the standard deviation of the mask's outline in pixels, from the median distance.

    Args:
        here: The points.
        distances: (N,) pixels, less what is known to be shared.
    """
    near = np.abs(distances[(here.agreement > _AGREES) & (np.abs(distances) < _FAR_PX)])
    low, high = _NOISE_PX
    return float(np.clip(1.4826 * np.median(near), low, high)) if len(near) else high


def sum_up(points: Points, world: WorldErrors, shared: Floats, params: Params) -> Sums:
    """Returns what an outline says under a hypothesis.

    Args:
        points: The outline.
        world: The hypothesis.
        shared: (3,) what is thought of the shared errors so far.
        params: The method's. Its ``heat`` divides all that is said: the model is not the whole truth, and
            points that it takes for independent are not quite.
    """
    here, slopes = points.here, points.slopes
    distances = here.distances + slopes[:, CAMERA:] @ shared
    noise_px = outline_noise(here, distances)
    variance = noise_px**2
    weights = _weights(here, slopes, distances, noise_px, world, params)
    information, gradient, log_density = np.zeros((10, 10)), np.zeros(10), 0.0
    for chunk in points.chunks:
        matrix = error_covariance(
            points.pixels[chunk],
            slopes[chunk, CAMERA],
            slopes[chunk, CAMERA + 1],
            here.points.buildings[chunk],
            ((1.0 - _OWN_SHARE) * variance, _OWN_SHARE * variance),
            (params.outline_px, params.roof_part_px),
            (world.roof_m**2, world.part_m**2, world.base_m**2),
        )
        # Outliers have an error of their own beside the shared one.
        matrix[np.diag_indices(len(chunk))] += variance * (1.0 / weights[chunk] - 1.0)
        columns = np.ascontiguousarray(np.column_stack([slopes[chunk], distances[chunk]]))
        log_determinant = float(whiten(matrix, columns))
        jacobian, residuals = columns[:, :-1], columns[:, -1]
        information += jacobian.T @ jacobian
        gradient += jacobian.T @ residuals
        log_density -= 0.5 * (float(residuals @ residuals) + log_determinant)
    return Sums(information / params.heat, gradient / params.heat, log_density / params.heat)


def _weights(
    here: Residuals, slopes: Floats, distances: Floats, noise_px: float, world: WorldErrors, params: Params
) -> Floats:
    """Returns (N,) in (0, 1]: little for points far beyond what the hypothesis expects."""
    expected = max(noise_px, 1.0) ** 2 + (slopes[:, CAMERA] ** 2) * (world.roof_m**2 + world.part_m**2)
    expected += (slopes[:, CAMERA + 1] * world.base_m) ** 2
    kernel = 1.0 / (1.0 + distances**2 / (params.outlier_sigmas**2 * expected))
    return np.asarray(np.maximum(kernel**2 * np.maximum(here.agreement, 1e-3), _LEAST_WEIGHT))
