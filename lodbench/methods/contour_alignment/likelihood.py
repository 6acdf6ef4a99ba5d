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

from lodbench.kernels.estimation import error_covariance, whiten
from lodbench.methods.contour_alignment.alignment import Residuals
from lodbench.methods.contour_alignment.params import Params

Floats = NDArray[np.float64]

# Whole pixels that a mask may be grown or shrunk by: standard deviation.
_BIAS_PX = 0.5


@dataclass(frozen=True, slots=True)
class WorldErrors:
    """How a city may differ from its map: Gaussian errors in metres, common ones and each building's own.

    Attributes:
        name: In a word.
        odds: How likely before the view is seen; relative to the other hypotheses.
        roof_m: Standard deviation of each building's height.
        part_m: The same of parts of its roof.
        base_m: The same of where its walls are seen to end.
        roofs_m: Mean and standard deviation of what the heights of all buildings err by together.
        bases_m: The same of where all walls end.
    """

    name: str
    odds: float
    roof_m: float
    part_m: float
    base_m: float
    roofs_m: tuple[float, float]
    bases_m: tuple[float, float]

    @property
    def shared_mean(self) -> Floats:
        """Returns (3,) means of what all points share: roofs and bases in metres, the outline in pixels."""
        return np.array([self.roofs_m[0], self.bases_m[0], 0.0])

    @property
    def shared_sigmas(self) -> Floats:
        """Returns (3,) standard deviations of the same."""
        return np.array([self.roofs_m[1], self.bases_m[1], _BIAS_PX])


_EXACT = WorldErrors("exact", 0.30, 0.2, 0.2, 0.05, (0.0, 0.2), (0.0, 0.05))
_FAIR = WorldErrors("fair", 0.30, 0.6, 0.6, 0.1, (-0.2, 0.4), (0.0, 0.1))
# Blocks reach the middle of a roof or its ridge; what is seen of it are mostly its eaves.
_COARSE = WorldErrors("coarse", 0.30, 1.3, 1.3, 0.2, (-0.7, 0.8), (0.0, 0.1))
_VAGUE = WorldErrors("vague", 0.10, 3.0, 3.0, 0.6, (0.0, 2.0), (0.0, 0.3))
# A map older than its roofs, or drawn up to the eaves.
_TOO_LOW = WorldErrors("too low", 0.01, 0.3, 0.3, 0.05, (1.2, 0.5), (0.0, 0.05))
# Hedges, cars and slopes hide the feet of walls: they end higher, never lower. Rough masks of few buildings
# look like it too, hence the odds: where feet are hidden the evidence is 20 and more in its logarithm,
# elsewhere seldom 10.
_HIDDEN = WorldErrors("feet hidden", 1e-3, 0.2, 0.2, 0.3, (0.0, 0.2), (1.2, 0.8))
_COARSE_HIDDEN = WorldErrors("coarse, feet hidden", 1e-3, 1.3, 1.3, 0.6, (-0.7, 0.8), (1.2, 0.8))

# Which hypotheses are followed together, and whether the lens is free there. A pose that explains hidden feet
# by wrong roofs looks good from where it stands, so the two are followed apart and compared at their ends.
TRACKS: tuple[tuple[tuple[WorldErrors, ...], bool], ...] = (
    ((_EXACT, _FAIR, _COARSE, _VAGUE, _TOO_LOW), False),
    ((_HIDDEN, _COARSE_HIDDEN), False),
    ((_EXACT, _FAIR, _COARSE, _HIDDEN), True),
)


# The numbers of a camera: three of place, three of direction, the lens.
CAMERA = 7
# Points in one matrix, which costs their number cubed.
_MOST_POINTS = 128
# Rows of chunks are as high as this, pixels of the fine size.
_BAND_PX = 90.0
# The outline's noise is looked for among points nearer than this, and is never less or more than that, px.
_FAR_PX = 20.0
_NOISE_PX = (0.5, 6.0)
# An outline as good as traced by hand hides nothing; one as rough as a network's does.
_FINE_PX, _ROUGH_PX = 1.75, 2.75
# Points that agree less with the mask's direction say nothing about its noise.
_AGREES = 0.3
# Share of the outline's variance that each point has for itself.
_OWN_SHARE = 0.3
# An outline that could be anywhere lies within so many pixels of the mask's: standard deviation.
_ANYWHERE_PX = 10.0
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

    Eq. (C8) of docs/methods/contour_alignment.md.

    Args:
        here: The points.
        distances: (N,) pixels, less what is known to be shared.
    """
    near = np.abs(distances[(here.agreement > _AGREES) & (np.abs(distances) < _FAR_PX)])
    low, high = _NOISE_PX
    return float(np.clip(1.4826 * np.median(near), low, high)) if len(near) else high


def sum_up(points: Points, world: WorldErrors, shared: Floats, params: Params, anywhere: float) -> Sums:
    """Returns what an outline says under a hypothesis. Eqs. (C5), (C10) of docs/methods/contour_alignment.md.

    Args:
        points: The outline.
        world: The hypothesis.
        shared: (3,) what is thought of the shared errors so far.
        params: The method's. Its ``heat`` divides all that is said: the model is not the whole truth, and
            points that it takes for independent are not quite.
        anywhere: The logarithm of the outline's density by ``density_anywhere``.
    """
    slopes = points.slopes
    distances, noise_px, weights = _judged(points, world, shared, params)
    information, gradient, log_density = np.zeros((10, 10)), np.zeros(10), -anywhere
    roofs_and_bases = (world.roof_m**2, world.part_m**2, world.base_m**2)
    for chunk in points.chunks:
        matrix = _covariance(points, chunk, noise_px, roofs_and_bases, params)
        # Outliers have an error of their own beside the shared one.
        matrix[np.diag_indices(len(chunk))] += noise_px**2 * (1.0 / weights[chunk] - 1.0)
        columns = np.ascontiguousarray(np.column_stack([slopes[chunk], distances[chunk]]))
        log_determinant = float(whiten(matrix, columns))
        jacobian, residuals = columns[:, :-1], columns[:, -1]
        information += jacobian.T @ jacobian
        gradient += jacobian.T @ residuals
        log_density -= 0.5 * (float(residuals @ residuals) + log_determinant)
    return Sums(information / params.heat, gradient / params.heat, log_density / params.heat)


def density_anywhere(points: Points, world: WorldErrors, shared: Floats, params: Params) -> float:
    """Returns the logarithm of an outline's density if it lay anywhere near the mask's.

    Evidence is measured against it. Cameras at two places see other points of the model, and the one that
    sees fewer, from further up, would have the higher density: each point's is below 1.

    Args:
        points: The outline.
        world: The hypothesis that says which points are outliers, and by how much.
        shared: (3,) what is thought of its shared errors.
        params: The method's.
    """
    distances, noise_px, weights = _judged(points, world, shared, params)
    log_density = 0.0
    for chunk in points.chunks:
        matrix = _covariance(points, chunk, _ANYWHERE_PX, (0.0, 0.0, 0.0), params)
        matrix[np.diag_indices(len(chunk))] += noise_px**2 * (1.0 / weights[chunk] - 1.0)
        residuals = np.ascontiguousarray(distances[chunk][:, None])
        log_determinant = float(whiten(matrix, residuals))
        log_density -= 0.5 * (float((residuals**2).sum()) + log_determinant)
    return log_density


def _covariance(
    points: Points,
    chunk: NDArray[np.int64],
    noise_px: float,
    roofs_and_bases: tuple[float, float, float],
    params: Params,
) -> Floats:
    """Returns half of a chunk's covariance: Eqs. (C6), (C7) of docs/methods/contour_alignment.md."""
    return np.asarray(
        error_covariance(
            points.pixels[chunk],
            points.slopes[chunk, CAMERA],
            points.slopes[chunk, CAMERA + 1],
            points.here.points.buildings[chunk],
            ((1.0 - _OWN_SHARE) * noise_px**2, _OWN_SHARE * noise_px**2),
            (params.outline_px, params.roof_part_px),
            roofs_and_bases,
        )
    )


def _judged(
    points: Points, world: WorldErrors, shared: Floats, params: Params
) -> tuple[Floats, float, Floats]:
    """Returns distances less what is shared, (N,), the outline's noise in pixels and weights, (N,)."""
    distances = points.here.distances + points.slopes[:, CAMERA:] @ shared
    noise_px = outline_noise(points.here, distances)
    weights = _weights(points.here, points.slopes, distances, noise_px, world, params)
    return distances, noise_px, weights


def _weights(
    here: Residuals, slopes: Floats, distances: Floats, noise_px: float, world: WorldErrors, params: Params
) -> Floats:
    """Returns (N,) in (0, 1]: little for points far beyond what the hypothesis expects.

    Eq. (C9) of docs/methods/contour_alignment.md.
    """
    expected = max(noise_px, 1.0) ** 2 + (slopes[:, CAMERA] ** 2) * (world.roof_m**2 + world.part_m**2)
    expected += (slopes[:, CAMERA + 1] * world.base_m) ** 2
    rough = float(np.clip((noise_px - _FINE_PX) / (_ROUGH_PX - _FINE_PX), 0.0, 1.0))
    hidden_sigmas = (1.0 - rough) * params.outlier_sigmas + rough * params.hidden_sigmas
    sigmas = np.where(distances < 0, hidden_sigmas, params.outlier_sigmas)
    kernel = 1.0 / (1.0 + distances**2 / (sigmas**2 * expected))
    return np.asarray(np.maximum(kernel**2 * np.maximum(here.agreement, 1e-3), _LEAST_WEIGHT))
