"""The likelihood of a mask's outline under hypotheses of how the map errs.

How much the mask errs is estimated from the view itself. Points are split into chunks of neighbouring
buildings: within one all errors are one covariance matrix, between two only what all points share.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lodbench.estimation.optimization import Quadratic
from lodbench.estimation.outline_alignment import (
    LEAST_WEIGHT,
    OWN_BASE,
    OWN_ROOF,
    Residuals,
    add_outliers,
    near_distances,
    outline_covariance,
    outline_noise,
)
from lodbench.kernels import whiten
from lodbench.methods.contour_alignment.params import ContourAlignmentParams

Floats = NDArray[np.float64]

# Whole pixels that a mask may be grown or shrunk by: standard deviation.
_BIAS_PX = 0.5


@dataclass(frozen=True, slots=True)
class WorldErrors:
    """How a city may differ from its map: Gaussian errors in metres, common ones and each building's own."""

    name: str  # in a word
    odds: float  # how likely before the photo; relative to the other hypotheses
    roof_m: float  # standard deviation of each building's height
    part_m: float  # the same of parts of its roof
    base_m: float  # the same of where its walls end in photos
    # Mean and standard deviation of what the heights of all buildings err by together
    roofs_m: tuple[float, float]
    bases_m: tuple[float, float]  # the same of where all walls end

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


# Points in one matrix, which costs their number cubed.
_MOST_POINTS = 128
# Rows of chunks are as high as this, pixels of the fine size.
_BAND_PX = 90.0
# An outline as good as traced by hand hides nothing; one as rough as a network's does.
_FINE_PX, _ROUGH_PX = 1.75, 2.75
# An outline that could be anywhere lies within so many pixels of the mask's: standard deviation.
_ANYWHERE_PX = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """A measured outline, in chunks of neighbouring buildings."""

    here: Residuals  # the points
    pixels: Floats  # (N, 2) of the fine size
    slopes: Floats  # (N, 10) how distances change with the camera, common roofs and bases, and a grown mask
    chunks: tuple[NDArray[np.int64], ...]  # indices of the points of each chunk

    def covariance(
        self,
        chunk: NDArray[np.int64],
        noise_px: float,
        lengths_px: tuple[float, float],
        errors_m2: tuple[float, float, float],
    ) -> Floats:
        """Returns half of the covariance of a chunk's distances; see ``outline_covariance``."""
        by_map = self.slopes[chunk, OWN_ROOF], self.slopes[chunk, OWN_BASE]
        buildings = self.here.points.buildings[chunk]
        return outline_covariance(self.pixels[chunk], *by_map, buildings, noise_px, lengths_px, errors_m2)


def in_chunks(here: Residuals) -> Outline:
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
    return Outline(here, pixels, slopes, tuple(order[a:b] for a, b in pairwise(cuts)))


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


def log_likelihood(
    outline: Outline, world: WorldErrors, shared: Floats, params: ContourAlignmentParams, anywhere: float
) -> Quadratic:
    """Returns the log-likelihood of an outline under a hypothesis to second order, of ten numbers.

    Eqs. (C5), (C10) of docs/methods/contour_alignment.md. It is of the shared errors, (3,), as estimated so
    far, less the log density ``anywhere``. ``heat`` divides the whole: the model is not the whole truth, and
    points that it takes for independent are not quite.
    """
    slopes, lengths_px = outline.slopes, (params.outline_px, params.roof_part_px)
    distances, noise_px, weights = _reweighted(outline, world, shared, params)
    information, gradient, log_density = np.zeros((10, 10)), np.zeros(10), -anywhere
    errors_m2 = (world.roof_m**2, world.part_m**2, world.base_m**2)
    for chunk in outline.chunks:
        columns = np.ascontiguousarray(np.column_stack([slopes[chunk], distances[chunk]]))
        matrix = outline.covariance(chunk, noise_px, lengths_px, errors_m2)
        add_outliers(matrix, noise_px, weights[chunk])
        log_determinant = float(whiten(matrix, columns))
        jacobian, residuals = columns[:, :-1], columns[:, -1]
        information += jacobian.T @ jacobian
        gradient += jacobian.T @ residuals
        log_density -= 0.5 * (float(residuals @ residuals) + log_determinant)
    return Quadratic(information / params.heat, gradient / params.heat, log_density / params.heat)


def density_anywhere(
    outline: Outline, world: WorldErrors, shared: Floats, params: ContourAlignmentParams
) -> float:
    """Returns the logarithm of an outline's density if it lay anywhere near the mask's.

    Evidence is measured against it. Cameras at two places see other points of the model, and the one that
    sees fewer, from further up, would have the higher density: each point's is below 1. The hypothesis says
    which points are outliers, and by how much.
    """
    distances, noise_px, weights = _reweighted(outline, world, shared, params)
    log_density, lengths_px = 0.0, (params.outline_px, params.roof_part_px)
    for chunk in outline.chunks:
        matrix = outline.covariance(chunk, _ANYWHERE_PX, lengths_px, (0.0, 0.0, 0.0))
        add_outliers(matrix, noise_px, weights[chunk])
        residuals = np.ascontiguousarray(distances[chunk][:, None])
        log_determinant = float(whiten(matrix, residuals))
        log_density -= 0.5 * (float((residuals**2).sum()) + log_determinant)
    return log_density


def _reweighted(
    outline: Outline, world: WorldErrors, shared: Floats, params: ContourAlignmentParams
) -> tuple[Floats, float, Floats]:
    """Returns distances less what is shared, (N,), the outline's noise in pixels and weights, (N,)."""
    distances = outline.here.distances + outline.slopes[:, OWN_ROOF:] @ shared
    noise_px = outline_noise(near_distances(distances, outline.here.agreement))
    weights = _weights(outline.here, outline.slopes, distances, noise_px, world, params)
    return distances, noise_px, weights


def _weights(
    here: Residuals,
    slopes: Floats,
    distances: Floats,
    noise_px: float,
    world: WorldErrors,
    params: ContourAlignmentParams,
) -> Floats:
    """Returns (N,) in (0, 1]: little for points far beyond what the hypothesis expects.

    Eq. (C9) of docs/methods/contour_alignment.md.
    """
    expected = max(noise_px, 1.0) ** 2 + (slopes[:, OWN_ROOF] ** 2) * (world.roof_m**2 + world.part_m**2)
    expected += (slopes[:, OWN_BASE] * world.base_m) ** 2
    rough = float(np.clip((noise_px - _FINE_PX) / (_ROUGH_PX - _FINE_PX), 0.0, 1.0))
    hidden_sigmas = (1.0 - rough) * params.outlier_sigmas + rough * params.hidden_sigmas
    sigmas = np.where(distances < 0, hidden_sigmas, params.outlier_sigmas)
    kernel = 1.0 / (1.0 + distances**2 / (sigmas**2 * expected))
    return np.asarray(np.maximum(kernel**2 * np.maximum(here.agreement, 1e-3), LEAST_WEIGHT))
