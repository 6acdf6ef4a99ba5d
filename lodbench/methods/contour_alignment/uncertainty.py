"""How sure an estimate is: where the hypotheses that are left put the camera, and how likely each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import Pose
from lodbench.geometry.pose_vector import pose_from_vector, turn_per_angle
from lodbench.methods.contour_alignment.refinement import Refined
from lodbench.storage import random_stream

Floats = NDArray[np.float64]

# What the probability is of.
WITHIN_M, WITHIN_DEG = 2.0, 2.0
_NUMBERS = (("x", "m"), ("y", "m"), ("z", "m"), ("pitch", "deg"), ("roll", "deg"), ("yaw", "deg"))
# Draws of the error: enough for a probability to a percent or two.
_DRAWS = 2048
# Hypotheses less likely than this are left out; answers less likely are no alternatives.
_LEAST_WEIGHT, _LEAST_ALTERNATIVE = 0.002, 0.02
# An end of the alignment whose IoU is less by this is believed 1/e as much.
_RIVAL_IOU = 0.004
# A mask that holds no more than the one of mapped buildings above their surroundings does not show them; by
# the other it is as good as outlines are taken to be (see ``mapped_overlap``).
_NO_OVERLAP, _OVERLAP = 0.3, 0.7


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """The point of a mixture that is most likely near the truth.

    Attributes:
        vector: (6,) centre in metres and angles in degrees.
        covariance: (6, 6) of the error there, what the hypotheses disagree about included.
        probability: That it is within (2 m, 2 deg).
        alternatives: Where other hypotheses put the camera, beyond that, the likeliest first.
        alternative_probabilities: Of each.
    """

    vector: Floats
    covariance: Floats
    probability: float
    alternatives: tuple[Pose, ...]
    alternative_probabilities: tuple[float, ...]


def answer_of(refined: Refined) -> Answer:
    """Returns the answer that a mixture of hypotheses gives.

    Eq. (C13) of docs/methods/contour_alignment.md.
    """
    kept = int(np.count_nonzero(refined.weights >= _LEAST_WEIGHT))
    modes, weights = refined.modes[:kept], refined.weights[:kept] / refined.weights[:kept].sum()
    counts = np.maximum(8, np.rint(_DRAWS * weights).astype(int))
    drawn = [_draws(mode.information, mode.step, n) for mode, n in zip(modes, counts, strict=True)]
    errors, shares = np.concatenate(drawn), np.repeat(weights / counts, counts)
    turn = turn_per_angle(refined.vector)
    means = [mode.step[:6] for mode in modes]
    chances = [_within(errors - mean, shares, turn) for mean in (*means, shares @ errors)]
    best = int(np.argmax(chances))
    center = (*means, shares @ errors)[best]
    spread = (shares[:, None] * (errors - center)).T @ (errors - center)
    overlap = float(np.clip((refined.overlap - _NO_OVERLAP) / (_OVERLAP - _NO_OVERLAP), 0.0, 1.0))
    others = _others(means, weights, center, turn)
    return Answer(
        refined.vector[:6] + center,
        0.5 * (spread + spread.T),
        chances[best] * overlap,
        tuple(pose_from_vector(refined.vector[:6] + mean) for mean, _ in others),
        tuple(overlap * weight for _, weight in others),
    )


def among_rivals(answer: Answer, ends: Floats, ious: Floats) -> Answer:
    """Returns an answer whose probabilities are shared with places where the silhouette fits nearly as well.

    Eq. (C14) of docs/methods/contour_alignment.md.

    Outlines there are other points, whose densities do not compare with the answer's; IoUs do.

    Args:
        answer: What the end of highest IoU led to.
        ends: (N, 7) where the alignment of the starts ended.
        ious: (N,) of silhouette and mask there.
    """
    order = np.argsort(-ious, kind="stable")
    apart: list[int] = []
    for k in order:
        if all(np.linalg.norm(ends[k, :3] - ends[j, :3]) >= WITHIN_M for j in apart):
            apart.append(int(k))
    weights = np.exp((ious[apart] - ious[apart[0]]) / _RIVAL_IOU)
    shares = weights / weights.sum()
    # The answer may have moved on to where another one ended.
    turn = turn_per_angle(answer.vector)
    rivals = [
        (pose_from_vector(ends[k]), float(share))
        for k, share in zip(apart[1:], shares[1:], strict=True)
        if share >= _LEAST_ALTERNATIVE and not _is_near(ends[k, :6] - answer.vector, turn)
    ]
    known = zip(answer.alternatives, shares[0] * np.array(answer.alternative_probabilities), strict=True)
    others = sorted([*known, *rivals], key=lambda other: -other[1])
    return replace(
        answer,
        probability=answer.probability * float(shares[0]),
        alternatives=tuple(pose for pose, _ in others),
        alternative_probabilities=tuple(float(share) for _, share in others),
    )


def _others(
    means: Sequence[Floats], weights: Floats, center: Floats, turn: Floats
) -> list[tuple[Floats, float]]:
    """Returns where else the camera may be, with the weight of all hypotheses that put it near there."""
    others: list[tuple[Floats, float]] = []
    for mean, weight in zip(means, weights, strict=True):
        if _is_near(mean - center, turn):
            continue
        near = [k for k, (other, _) in enumerate(others) if _is_near(mean - other, turn)]
        if near:
            others[near[0]] = others[near[0]][0], others[near[0]][1] + float(weight)
        else:
            others.append((mean, float(weight)))
    likely = [other for other in others if other[1] >= _LEAST_ALTERNATIVE]
    return sorted(likely, key=lambda other: -other[1])


def probability_within(covariance_6: Floats, vector: Floats) -> float:
    """Returns the probability that an estimate with a Gaussian error lies within (2 m, 2 deg).

    Eq. (M4) of docs/methods/index.md.

    Args:
        covariance_6: (6, 6) of x, y, z (metres), pitch, roll and yaw (degrees).
        vector: (6,) the estimate.
    """
    errors = _gaussian(covariance_6, _DRAWS)
    return _within(errors, np.full(_DRAWS, 1.0 / _DRAWS), turn_per_angle(vector))


def beyond_range(offset: Floats, covariance: Floats, half_widths: Sequence[float]) -> tuple[str, ...]:
    """Returns a sentence for an answer beyond the range that the prior was said to have, or nothing.

    Args:
        offset: (6,) of the answer from the prior: metres and degrees.
        covariance: (6, 6) of the answer.
        half_widths: Of the range, in the same order.
    """
    beyond = np.abs(offset) - np.asarray(half_widths)
    # Twice what the answer may be wrong by: on the edge of the range it is no news.
    is_out = beyond > np.maximum(2.0 * np.sqrt(np.diagonal(covariance)), (1.0, 1.0, 1.0, 0.5, 0.5, 0.5))
    out = [f"{name} {offset[k]:+.1f} {unit}" for k, (name, unit) in enumerate(_NUMBERS) if is_out[k]]
    if not out:
        return ()
    return (f"the pose lies outside the stated range of the prior: {', '.join(out)}",)


def _draws(information: Floats, step: Floats, count: int) -> Floats:
    """Returns (count, 6) draws of a hypothesis, lens and shared errors left out."""
    inverse = np.linalg.inv(information)[:6, :6]
    return np.asarray(step[:6] + _gaussian(0.5 * (inverse + inverse.T), count))


def _gaussian(covariance_6: Floats, count: int) -> Floats:
    values, axes = np.linalg.eigh(covariance_6)
    # The same draws for every query: the answer is a function of the covariances alone.
    standard = random_stream(0, "probability within").standard_normal((_DRAWS + 8, 6))[:count]
    return np.asarray(standard @ (axes * np.sqrt(np.maximum(values, 0.0))).T)


def _within(errors: Floats, shares: Floats, turn: Floats) -> float:
    away = np.linalg.norm(errors[:, :3], axis=1)
    turned = np.linalg.norm(errors[:, 3:] @ turn.T, axis=1)
    return min(1.0, float(shares[(away < WITHIN_M) & (turned < WITHIN_DEG)].sum()))


def _is_near(error: Floats, turn: Floats) -> bool:
    return bool(np.linalg.norm(error[:3]) < WITHIN_M and np.linalg.norm(turn @ error[3:]) < WITHIN_DEG)
