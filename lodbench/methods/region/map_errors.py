"""How far a map's own errors may have led an answer astray: its covariance.

The curvature of a likelihood says how well a photo tells poses apart if the map is right. Houses stand half a
metre beside where the map has them, and roofs are higher or lower, each building's outline as a whole: few
buildings leave much open that thousands of pixels seem to say (docs/adr/0043).
"""

from __future__ import annotations

import math

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.methods.contour_alignment.correlated import error_covariance
from lodbench.methods.contour_alignment.outline import OutlinePoints

Floats = NDArray[np.float64]

# Standard deviations, metres: where a building stands, how high its roof is as a whole and by parts, how high
# all roofs are, where walls end.
_PLACE_M, _ROOF_M, _PART_M, _ROOFS_M, _BASE_M = 0.5, 0.7, 0.7, 0.35, 0.1
# Pixels of the fine size: how far outlines of a photo err together with what is near them, and each point by
# itself; over which distance they do, and parts of a roof.
_TOGETHER_PX, _OWN_PX, _NEAR_PX, _PART_PX = 1.0, 1.0, 12.0, 20.0
# Columns of an outline's slopes: the pose, the lens, then its building's roof and base.
_POSE, _EAST_NORTH, _LENS, _ROOF, _BASE = slice(0, 6), slice(0, 2), 6, 7, 8
# More points say no more; fewer say nothing.
_MOST_POINTS, _LEAST_POINTS = 600, 6
# So that directions that no outline tells can be divided by, as a share of the others.
_UNSEEN = 1e-6


def covariance_under_map_errors(
    information: Floats, prior_information: Floats, points: OutlinePoints, lens_percent: float
) -> Floats:
    """Returns the covariance (6, 6) of an answer's error, metres and degrees.

    Eq. (R19) of docs/methods/region.md.

    An answer is where the slopes of likelihood and prior cancel; each error of the map adds to the former in
    the way in which it moves the outline. So the curvature is that of outlines whose every pixel is worth the
    same, and the error is the sandwich of that curvature and the variance of its slope (White, "Maximum
    likelihood estimation of misspecified models", 1982).

    Args:
        information: (6, 6) curvature of the likelihood: how much a photo says if the map is right.
        prior_information: (6, 6) the same of the prior.
        points: The outline from the answer, at the fine size.
        lens_percent: Standard deviation of the focal length, percent.
    """
    if len(points) < _LEAST_POINTS:
        return np.asarray(np.linalg.inv(prior_information))
    # Every so many-th point stands for those that are left out.
    stride = math.ceil(len(points) / _MOST_POINTS)
    lengths = points.lengths[::stride] * stride
    slopes = (points.moves * points.normals[:, None, :]).sum(axis=2)[::stride]
    pulls = slopes[:, _POSE] * lengths[:, None]
    outline = pulls.T @ slopes[:, _POSE]
    outline += _UNSEEN * np.trace(outline) / len(outline) * np.eye(len(outline))
    worth = max(float(np.median(scipy.linalg.eigh(information, outline, eigvals_only=True))), 0.0)
    variance = _variance_of_pulls(pulls, slopes, points.pixels[::stride], points.buildings[::stride])
    for column, sigma in ((_ROOF, _ROOFS_M), (_LENS, lens_percent)):
        of_all = pulls.T @ slopes[:, column]
        variance += sigma**2 * np.outer(of_all, of_all)
    curvature = worth * outline + prior_information
    back = np.linalg.inv(curvature)
    covariance = back @ (curvature + worth**2 * variance) @ back
    return np.asarray(0.5 * (covariance + covariance.T))


def _variance_of_pulls(pulls: Floats, slopes: Floats, pixels: Floats, buildings: NDArray[np.int64]) -> Floats:
    """Returns (6, 6) how the sum of N points' pulls on the pose, (N, 6) per pixel, varies with buildings."""
    lower = error_covariance(
        np.ascontiguousarray(pixels),
        np.ascontiguousarray(slopes[:, _ROOF]),
        np.ascontiguousarray(slopes[:, _BASE]),
        np.ascontiguousarray(buildings),
        (_TOGETHER_PX**2, _OWN_PX**2),
        (_NEAR_PX, _PART_PX),
        (_ROOF_M**2, _PART_M**2, _BASE_M**2),
    )
    # Not by a library whose sums depend on how many threads it has.
    half = np.einsum("ia,ib->ab", pulls, np.einsum("ij,jb->ib", lower, pulls))
    own = np.einsum("ia,i,ib->ab", pulls, np.diagonal(lower), pulls)
    variance = half + half.T - own
    # A building that stands elsewhere moves as the camera does, the other way.
    of_buildings = np.zeros((int(buildings.max()) + 1, 6, 2))
    np.add.at(of_buildings, buildings, pulls[:, :, None] * slopes[:, None, _EAST_NORTH])
    return np.asarray(variance + _PLACE_M**2 * np.einsum("kai,kbi->ab", of_buildings, of_buildings))
