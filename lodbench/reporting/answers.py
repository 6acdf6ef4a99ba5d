"""The answers of a run without a truth, a line per query; why one is not to be trusted fully."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from decimal import ROUND_FLOOR, Decimal
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lodbench.evaluation.predictions import Prediction
from lodbench.geometry import Pose
from lodbench.geometry.angles import look_from_rotation
from lodbench.methods.region.trust import CONFIDENCE_STAGE, ConfidenceFeatures, contradictions
from lodbench.reporting.aligned_text import format_columns, plain_text
from lodbench.reporting.table_heads import finite_text

if TYPE_CHECKING:
    import pandas as pd

# Below this probability, or this overlap of mask and model, a pose is not to be trusted.
TRUSTED_PROBABILITY, TRUSTED_OVERLAP = 0.5, 0.5
GOOD, DOUBTFUL, UNTRUSTED = "good", "doubtful", "do not trust"
# From these probabilities of being within 2 m and 2 degrees on.
_WORDS = ((0.9, GOOD), (TRUSTED_PROBABILITY, DOUBTFUL), (0.0, UNTRUSTED))
# How answers are counted by their words, in this order.
_COUNTED = {
    GOOD: "good", DOUBTFUL: "doubtful", UNTRUSTED: "not to be trusted", "-": "of unknown trust",
    "failed": "failed",
}  # fmt: skip
Floats = NDArray[np.float64]
# What is said of the candidates' log-probabilities, best first, in a trace.
NATS = "[nats]"
# Standard deviations from which on 2 m and 2 degrees are in doubt.
_SIGMA_M, _SIGMA_DEG = 1.0, 1.0
# A candidate less probable than this, beside the best, is no reason for doubt.
_LEAST_CANDIDATE = 0.01
_NO_SINGLE = "the method's own estimate: nothing single stands out"


def format_answers(queries: pd.DataFrame, predictions: Mapping[str, Prediction]) -> str:
    """Returns position, heading, pitch, roll, score, probability and a word of trust per query, as text.

    Columns are aligned; headings are clockwise from grid north.

    Args:
        queries: As ``lodbench.evaluation.metrics`` has them.
        predictions: By the index of the queries; poses in the dataset's frame.
    """
    head = ["", "x m", "y m", "z m", "heading deg", "pitch deg", "roll deg", "score", "probability", "trust"]
    lines = [_cells(str(key), predictions[str(key)]) for key in queries.index]
    answered = sum(predictions[str(key)].pose is not None for key in queries.index)
    is_said = any(predictions[str(key)].probability is not None for key in queries.index)
    notes = [f"{key}: {note}" for key in queries.index for note in predictions[str(key)].notes]
    reasons = Counter(
        answer.failure for key in queries.index if (answer := predictions[str(key)]).pose is None
    )
    notes = [f"{count} x {reason}" for reason, count in sorted(reasons.items()) if reason] + notes
    basis = "goes by the probability that the method gives of being within 2 m and 2 degrees"
    return (
        f"No ground truth to compare with; the poses themselves:\n\n{format_columns([head, *lines])}\n\n"
        f"{answered} of {len(lines)} queries have an answer: "
        f"{trust_counts(trust_label(predictions[str(key)]) for key in queries.index)}. "
        f"Trust {basis if is_said else 'is not known: this method gives no probability'}.\n"
        + "".join(f"{plain_text(note)}\n" for note in notes)
    )


def trust_label(prediction: Prediction) -> str:
    """Returns how far an answer may be trusted, in a word; "-" where nothing tells."""
    if prediction.pose is None:
        return "failed"
    if not is_trusted(prediction.probability, prediction.score, bool(prediction.mask_png)):
        return UNTRUSTED
    return "-" if prediction.probability is None else trust_word(prediction.probability)


def is_trusted(probability: float | None, score: float | None, has_mask: bool) -> bool:
    """Tells whether a pose is more likely right than wrong, as far as can be known.

    Args:
        probability: That it is within 2 m and 2 degrees, where the method knows it.
        score: Of the method.
        has_mask: Whether a mask was looked at; the score is then its overlap with the model.
    """
    # Outlines may agree with a mask that is the wrong way round. Without a mask a score has no known unit.
    if has_mask and score is not None and score < TRUSTED_OVERLAP:
        return False
    return probability is None or probability >= TRUSTED_PROBABILITY


def untrusted_note(predictions: Iterable[Prediction]) -> str:
    """Returns a line that says how many poses are unreliable, and what to do; "" if none."""
    answered = [answer for answer in predictions if answer.pose is not None]
    count = sum(trust_label(answer) == UNTRUSTED for answer in answered)
    if not count:
        return ""
    has_masks = any(answer.mask_png for answer in answered)
    overlap = f", or IoU of mask and model below {TRUSTED_OVERLAP:g}" if has_masks else ""
    return (
        f"{count} of {len(answered)} poses are unreliable (probability below "
        f"{TRUSTED_PROBABILITY:g}{overlap}): check their overlays, "
        f"{'add or correct masks, ' if has_masks else ''}or give better priors"
    )


def columns_legend(has_probability: bool, has_score: bool) -> str:
    """Returns what columns of a table of answers mean: probability and trust, standard deviations, score."""
    likely = (
        f"Probability: of being within 2 m and 2 deg; {GOOD} from {_WORDS[0][0]:g}, {DOUBTFUL} from "
        f"{TRUSTED_PROBABILITY:g}, else {UNTRUSTED} (as with an IoU of mask and model below "
        f"{TRUSTED_OVERLAP:g}). ± and +-: one standard deviation, as the method estimates it."
    )
    fit = "Score: the method's own measure of the fit, higher is better; other methods measure otherwise."
    return " ".join([*([likely] if has_probability else []), *([fit] if has_score else [])])


def trust_word(probability: float) -> str:
    """Returns how far a pose may be trusted that is within 2 m and 2 degrees with a probability."""
    return next((word for least, word in _WORDS if probability >= least), _WORDS[-1][1])


def rounded_down(probability: float, digits: int) -> float:
    """Returns a probability with so many decimals that is no more than it: 0.8999 is not the 0.90 of good.

    Example:
        >>> rounded_down(0.8999, 2), rounded_down(0.29, 2), rounded_down(1.0, 2)
        (0.89, 0.29, 1.0)
    """
    return float(Decimal(repr(float(probability))).quantize(Decimal(1).scaleb(-digits), ROUND_FLOOR))


def probability_text(probability: float, digits: int = 2) -> str:
    """Returns a probability as it is shown beside a word of trust: rounded down, so that both agree."""
    return f"{rounded_down(probability, digits):.{digits}f}"


def percent_text(probability: float) -> str:
    """Returns a probability in whole percent, rounded down.

    Example:
        >>> percent_text(0.8999), percent_text(0.29)
        ('89 %', '29 %')
    """
    return f"{100 * rounded_down(probability, 2):.0f} %"


def trust_counts(words: Iterable[str]) -> str:
    """Returns how many answers there are of each word of ``trust_label``.

    Example:
        >>> trust_counts(["good", "do not trust", "doubtful", "doubtful"])
        '1 good, 2 doubtful, 1 not to be trusted'
    """
    count = Counter(words)
    return ", ".join(f"{count[word]} {called}" for word, called in _COUNTED.items() if count[word])


def _cells(key: str, answer: Prediction) -> list[str]:
    place = ["-"] * 6
    if answer.pose is not None:
        look = look_from_rotation(answer.pose.rotation)
        place = [f"{value:z.2f}" for value in (*answer.pose.center, *look)]
    score = finite_text(math.nan if answer.score is None else answer.score, ".3f")
    sure = "-" if answer.probability is None else probability_text(answer.probability, 3)
    return [plain_text(key), *place, score, sure, trust_label(answer)]


def why_of(answer: Prediction) -> tuple[str, ...]:
    """Returns why an answer is not to be trusted fully, and its method's notes; empty for neither."""
    if answer.pose is None:
        return ()
    # Of the upper triangle, row by row.
    variances = np.array(answer.covariance)[[0, 6, 11, 15, 18, 20]] if answer.covariance else None
    return reasons_for_doubt(
        trust_label(answer),
        answer.pose,
        answer.notes,
        variances,
        answer.alternatives,
        answer.alternative_probabilities,
        overlap=answer.score if answer.mask_png else None,
        trace=answer.trace,
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
        trust: In a word (``trust_label``); where that is good, or nothing is known, only notes are returned.
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
    features = trace.get(CONFIDENCE_STAGE, ())
    if len(features) == len(ConfidenceFeatures._fields):
        reasons += contradictions(ConfidenceFeatures(*features))
    return tuple(reasons) or (_NO_SINGLE,)


def _second_best(
    pose: Pose, others: Sequence[Pose], probabilities: Sequence[float], trace: Mapping[str, Sequence[float]]
) -> Iterator[str]:
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
