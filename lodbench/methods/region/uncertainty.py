"""How sure a mode is: the curvature of the posterior around it, and what other modes leave it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lodbench.methods.region.evidence import Evidence
from lodbench.methods.region.search import Surroundings
from lodbench.storage import random_stream

Floats = NDArray[np.float64]

# Poses that the curvature is read from: a quadratic of six numbers has 28 coefficients.
_SAMPLES = 192
# How far apart their outlines lie, pixels: beyond the stairs of single pixels, within the mode.
_REACH_PX = 1.5
_PAIRS = np.triu_indices(6)


def information_at(
    nats: Callable[[Floats], Floats], vector: Floats, evidence: Evidence, around: Surroundings
) -> Floats:
    """Returns the curvature (6, 6) of the likelihood at a mode: what the photo says if the map is right.

    Eq. (R18) of docs/methods/region.md.

    A quadratic is fitted to the likelihood of poses around the mode. What curves upwards there says nothing.

    Args:
        nats: (N, 6) poses to the (N,) logarithm of their likelihood.
        vector: (6,) the mode.
        evidence: Knows the prior and the working size.
        around: How the outline moves.
    """
    shape = around.cloud(vector, evidence, _REACH_PX)
    if shape is None:
        return np.zeros((6, 6))
    squares, axes = np.linalg.eigh(shape.covariance)
    roots = axes * np.sqrt(np.maximum(squares, 0.0))
    # The same draws for every query: the answer is a function of the mode alone.
    draws = random_stream(0, "curvature of the region fit").standard_normal((_SAMPLES // 2, 6))
    draws = np.concatenate([draws, -draws])
    values = nats(vector + draws @ roots.T)
    design = np.column_stack([np.ones(len(draws)), draws, draws[:, _PAIRS[0]] * draws[:, _PAIRS[1]]])
    coefficients = np.linalg.lstsq(design, values, rcond=None)[0]
    hessian = np.zeros((6, 6))
    hessian[_PAIRS] = coefficients[7:]
    curvature, directions = np.linalg.eigh(-(hessian + hessian.T))
    back = np.linalg.inv(roots)
    seen = back.T @ (directions * np.maximum(curvature, 0.0)) @ directions.T @ back
    return np.asarray(0.5 * (seen + seen.T))


def share_of_best(evidence: Floats) -> float:
    """Returns the posterior share of the best of some modes, their widths taken to be alike.

    Eq. (R13) of docs/methods/region.md.

    Args:
        evidence: (M,) the logarithm of what speaks for each, up to a constant.
    """
    return float(1.0 / np.exp(evidence - evidence.max()).sum())
