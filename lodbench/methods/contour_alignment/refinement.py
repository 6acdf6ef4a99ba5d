"""The last steps: least squares that know how the errors of an outline go together.

A mask's outline leans over tens of pixels, so near points tell the same twice; how much it errs is
found from the view itself. A roof of the map may be too high or too low, as a whole and by parts.
Both are rows of one covariance matrix: what roofs or a leaning outline could explain moves the pose
little, and widens the answer's own covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.methods.contour_alignment.alignment import Aligner, Linearization, Residuals
from lodbench.methods.contour_alignment.correlated import error_covariance, whiten
from lodbench.methods.contour_alignment.params import Params

Floats = NDArray[np.float64]

# Points in one matrix, which costs their number cubed; every so many-th point goes into one, the next into
# the next, and what the matrices say is averaged. So all points count, and none depends on the start.
_MOST_POINTS = 250
_MOST_SUBSETS = 8
# The outline's noise is looked for among points nearer than this, and is never less or more than that, px.
_FAR_PX = 20.0
_NOISE_PX = (0.5, 6.0)
# Points that agree less with the mask's direction say nothing about its noise.
_AGREES = 0.3
# Share of the outline's variance that each point has for itself.
_OWN_SHARE = 0.3
# A point that weighs less than this has a variance that no factorisation feels.
_LEAST_WEIGHT = 1e-8
# Maps from nearly exact to as coarse as the parameters allow.
_ROOF_SHARES = (0.1, 0.4, 1.0)
# By how much the logarithm of the evidence for a better map must be larger.
_CLEAR = 40.0


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A pose at the end of its steps.

    Attributes:
        vector: (6,) centre in metres and angles in degrees.
        at: What the outlines say there.
    """

    vector: Floats
    at: Linearization


def refine(aligner: Aligner, vector: Floats, params: Params) -> Refined | None:
    """Returns a pose after the last steps; None if too little outline is seen.

    How far roofs may be wrong is chosen halfway, by what explains the view.
    """
    at, share = None, 1.0
    for step in range(params.final_steps + 1):
        here = aligner.measure(vector, params.fine_size)
        if here is None:
            return None
        if step == params.final_steps // 2:
            share = _roof_share(aligner, vector, here, params)
        at = _linearize(aligner, vector, here, params, share)
        if step < params.final_steps:
            vector = vector + at.step()
    return Refined(vector, at) if at is not None else None


def _roof_share(aligner: Aligner, vector: Floats, here: Residuals, params: Params) -> float:
    """Returns the share of the parameters' roof errors that a view calls for: all of it unless it is clear.

    A pose can make up for wrong roofs, so that little evidence for a good map is none.
    """
    evidence = {s: _linearize(aligner, vector, here, params, s).evidence for s in _ROOF_SHARES}
    best = max(evidence, key=lambda s: evidence[s])
    return best if evidence[best] > evidence[1.0] + _CLEAR else 1.0


def outline_noise(here: Residuals) -> float:
    """Returns the standard deviation of the mask's outline in pixels, from the median distance."""
    near = np.abs(here.distances[(here.agreement > _AGREES) & (np.abs(here.distances) < _FAR_PX)])
    low, high = _NOISE_PX
    return float(np.clip(1.4826 * np.median(near), low, high)) if len(near) else high


def _linearize(
    aligner: Aligner, vector: Floats, here: Residuals, params: Params, roof_share: float
) -> Linearization:
    noise_px = outline_noise(here)
    roofs_m = roof_share * params.roof_m, roof_share * params.roof_part_m
    subsets = -(-len(here.distances) // _MOST_POINTS)
    used = min(subsets, _MOST_SUBSETS)
    information, gradient = aligner.prior_terms(vector)
    evidence = 0.0
    for k in range(used):
        chosen = slice(k * subsets // used, None, subsets)
        jacobian, residuals, log_determinant = _whitened(here, chosen, noise_px, roofs_m, params)
        information = information + jacobian.T @ jacobian / used
        gradient = gradient + jacobian.T @ residuals / used
        evidence -= 0.5 * (float(residuals @ residuals) + log_determinant) / used
    # The pose is integrated out: what is left of the misfit at the linearisation's own optimum.
    evidence += 0.5 * float(gradient @ np.linalg.solve(information, gradient))
    evidence -= 0.5 * float(np.linalg.slogdet(information)[1])
    return Linearization(information, gradient, here.iou, evidence)


def _whitened(
    here: Residuals, chosen: slice, noise_px: float, roofs_m: tuple[float, float], params: Params
) -> tuple[Floats, Floats, float]:
    """Returns slopes (N, 6) and distances (N,) made independent, of unit variance, and the log determinant.

    Args:
        here: All points.
        chosen: Which of them.
        noise_px: Standard deviation of the mask's outline.
        roofs_m: Standard deviations of a roof's height as a whole and by parts.
        params: The method's.
    """
    distances, slopes = here.distances[chosen], here.slopes[chosen]
    reach_px = params.outlier_sigmas * max(noise_px, 1.0)
    kernel = 1.0 / (1.0 + (distances / reach_px) ** 2)
    weights = np.maximum(kernel**2 * np.maximum(here.agreement[chosen], 1e-3), _LEAST_WEIGHT)
    variance = noise_px**2
    matrix = error_covariance(
        here.points.pixels[chosen] / here.scale,
        slopes[:, 6],
        here.points.buildings[chosen],
        ((1.0 - _OWN_SHARE) * variance, _OWN_SHARE * variance),
        (params.outline_px, params.roof_part_px),
        (roofs_m[0] ** 2, roofs_m[1] ** 2),
    )
    # Outliers have an error of their own beside the shared one.
    matrix[np.diag_indices(len(distances))] += variance * (1.0 / weights - 1.0)
    columns = np.ascontiguousarray(np.column_stack([slopes[:, :6], distances]))
    log_determinant = float(whiten(matrix, columns))
    return columns[:, :6], columns[:, 6], log_determinant
