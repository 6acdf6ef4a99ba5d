"""Whether a method knows how good its answers are: probabilities against what was found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.evaluation.statistics import Interval, wilson_interval

Floats = NDArray[np.float64]
Hits = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ReliabilityBin:
    """The queries whose probability lies in one range.

    Attributes:
        low: Lower end of the range, inside it.
        high: Upper end, outside it unless it is 1.
        count: Queries.
        confidence: Their mean probability, in [0, 1].
        found: Share that was found, in [0, 1].
        interval: 95 % interval of that share, in [0, 1].
    """

    low: float
    high: float
    count: int
    confidence: float
    found: float
    interval: Interval


@dataclass(frozen=True, slots=True)
class Calibration:
    """How a method's probabilities compare with what it found.

    Attributes:
        bins: Of equal width from 0 to 1, empty ones left out.
        ece: Expected calibration error: mean distance of confidence and share found, over the bins,
            weighted by their queries, in [0, 1]; NaN without queries.
        brier: Mean squared distance of probability and outcome; NaN without queries.
        coverage: (N + 1,) share of queries answered as less and less sure ones are let in, 0 to 1.
        risk: (N + 1,) share of those answered that were not found.
        aurc: Area under the risk-coverage curve, in [0, 1].
    """

    bins: tuple[ReliabilityBin, ...]
    ece: float
    brier: float
    coverage: Floats
    risk: Floats
    aurc: float


def calibrate(
    probabilities: Sequence[float] | Floats, hits: Sequence[bool] | Hits, num_bins: int = 10
) -> Calibration:
    """Returns how well probabilities of being found agree with what was found.

    Args:
        probabilities: (N,) in [0, 1]; 0 for a query without an answer.
        hits: (N,) whether each was found.
        num_bins: Bins of the reliability diagram.
    """
    confidence, found = np.asarray(probabilities, dtype=np.float64), np.asarray(hits, dtype=np.bool_)
    bins = _bins(confidence, found, num_bins)
    coverage, risk = risk_coverage(confidence, found)
    count = len(confidence)
    error = sum(b.count * abs(b.found - b.confidence) for b in bins) / count if count else math.nan
    return Calibration(
        bins=bins,
        ece=error,
        brier=float(np.mean((confidence - found) ** 2)) if count else math.nan,
        coverage=coverage,
        risk=risk,
        aurc=float(risk[1:].mean()) if count else math.nan,
    )


def risk_coverage(probabilities: Floats, hits: Hits) -> tuple[Floats, Floats]:
    """Returns coverage and risk, (N + 1,) each, the surest queries first; the first risk is the second's.

    Queries of equal probability are let in together in no order: each stands for their mean.
    """
    order = np.argsort(-probabilities, kind="stable")
    _, group, counts = np.unique(-probabilities[order], return_inverse=True, return_counts=True)
    missed = np.bincount(group, weights=(~hits[order]).astype(np.float64), minlength=len(counts)) / counts
    share = np.arange(1, len(hits) + 1)
    risk = np.cumsum(missed[group]) / share
    first = risk[:1] if len(risk) else np.zeros(1)
    return np.concatenate([[0.0], share / max(1, len(hits))]), np.concatenate([first, risk])


def _bins(confidence: Floats, found: Hits, num_bins: int) -> tuple[ReliabilityBin, ...]:
    index = np.minimum((confidence * num_bins).astype(np.int64), num_bins - 1)
    bins = []
    for b in np.unique(index):
        mine = index == b
        low, high = wilson_interval(found[mine])
        bins.append(
            ReliabilityBin(
                low=float(b) / num_bins,
                high=float(b + 1) / num_bins,
                count=int(mine.sum()),
                confidence=float(confidence[mine].mean()),
                found=float(found[mine].mean()),
                interval=(low / 100.0, high / 100.0),
            )
        )
    return tuple(bins)
