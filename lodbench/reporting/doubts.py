"""Why a pose is not to be trusted fully: what its method stored of it, in words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lodbench.evaluation.predictions import Prediction
from lodbench.geometry import Pose
from lodbench.methods.region.trust import SIGNS_STAGE, ConfidenceFeatures, contradictions
from lodbench.reporting.answers import GOOD, TRUSTED_OVERLAP, UNTRUSTED, percent_text, trust_of

Floats = NDArray[np.float64]
# What is said of the candidates' log-probabilities, best first, in a trace.
NATS = "[nats]"
# Standard deviations from which on 2 m and 2 degrees are in doubt.
_SIGMA_M, _SIGMA_DEG = 1.0, 1.0
# A candidate less probable than this, beside the best, is no reason for doubt.
_LEAST_CANDIDATE = 0.01
_NO_SINGLE = "the method's own estimate: nothing single stands out"


def why_of(found: Prediction) -> tuple[str, ...]:
    """Returns why an answer is not to be trusted fully, and its method's notes; empty for neither."""
    if found.pose is None:
        return ()
    # Of the upper triangle, row by row.
    variances = np.array(found.covariance)[[0, 6, 11, 15, 18, 20]] if found.covariance else None
    return reasons_for_doubt(
        trust_of(found),
        found.pose,
        found.notes,
        variances,
        found.alternatives,
        found.alternative_probabilities,
        overlap=found.score if found.mask_png else None,
        trace=found.trace,
    )


def reasons_for_doubt(
    trust: str,
    pose: Pose,
    notes: Sequence[str],
    variances: Floats | None,
    alternatives: Sequence[Pose] = (),
    alternative_probabilities: Sequence[float] = (),
    *,
    overlap: float | None = None,
    trace: Mapping[str, Sequence[float]] | None = None,
) -> tuple[str, ...]:
    """Returns why an answer is not to be trusted fully, after its method's notes; empty for neither.

    Args:
        trust: In a word (``trust_of``); where that is good, or nothing is known, only notes are returned.
        pose: The answer.
        notes: Of the method.
        variances: (6,) of x, y, z, square metres, and of three angles, square degrees; or None.
        alternatives: Other poses, best first, in the same frame.
        alternative_probabilities: Of each, or empty.
        overlap: IoU of mask and model, where there was a mask.
        trace: Numbers of the search by stage.
    """
    if trust in (GOOD, "-", "failed"):
        return tuple(notes)
    trace = trace or {}
    reasons = [*notes]
    if trust == UNTRUSTED and overlap is not None and overlap < TRUSTED_OVERLAP:
        reasons.append(f"IoU of mask and model only {math.floor(100 * overlap) / 100:.2f}")
    reasons += _second_best(pose, alternatives, alternative_probabilities, trace)
    reasons += [] if variances is None else _uncertain(np.sqrt(np.maximum(variances, 0.0)))
    features = trace.get(SIGNS_STAGE, ())
    if len(features) == len(ConfidenceFeatures._fields):
        reasons += contradictions(ConfidenceFeatures(*features))
    return tuple(reasons) or (_NO_SINGLE,)


def _second_best(
    pose: Pose, others: Sequence[Pose], probabilities: Sequence[float], trace: Mapping[str, Sequence[float]]
) -> Iterator[str]:
    """Yields where the next candidate is and how probable, unless it is improbable."""
    if not others:
        return
    away = others[0].center - pose.center
    place = f"2nd best pose {float(np.linalg.norm(away)):.1f} m away, {away[2]:+.1f} m in height"
    nats = next((values for name, values in trace.items() if name.endswith(NATS) and len(values) > 1), None)
    if probabilities:
        if probabilities[0] >= _LEAST_CANDIDATE:
            yield f"{place} ({percent_text(probabilities[0])})"
    elif nats is None:
        yield f"{place} (worse fit)"
    elif (share := math.exp(nats[1] - nats[0])) >= _LEAST_CANDIDATE:
        yield f"{place} ({share:.2f} times as probable)"


def _uncertain(sigmas: Floats) -> Iterator[str]:
    """Yields which of position and angles are not known well enough for 2 m and 2 degrees."""
    in_space = float(np.linalg.norm(sigmas[:3]))
    if in_space >= _SIGMA_M:
        parts = ", ".join(
            f"{name} {value:.1f}" for name, value in zip(("east", "north", "height"), sigmas, strict=False)
        )
        yield f"position +-{in_space:.1f} m ({parts})"
    if (worst := float(sigmas[3:].max())) >= _SIGMA_DEG:
        yield f"direction +-{worst:.1f} deg"
