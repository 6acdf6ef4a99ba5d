"""How far to trust an answer: signs that it is right, and the one model that weighs them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy

# Probabilities by the covariance are not believed beyond this; what places are apart by chance, metres;
# what lines say by chance, nats; how far beyond the range of heights counts, of its half width.
_LEAST_PROBABILITY, _APART_M, _LEAST_LINES, _MOST_BEYOND = 0.02, 0.3, 10.0, 0.5
# Lines say no more than this: towards the horizon thousands of short ones find edges anywhere.
_MOST_LINES = 300.0
# Logistic regression on 684 answers, 531 of them within (2 m, 2 deg): drawn photos in the look `hard`, seeds
# 103 and 104, over thirteen files; thermal query, labelled and traced real photos, 122 of these from priors
# of +-50 m and +-30 deg. Labelled photos weigh three times as much. Each weight was held to one sign.
# docs/adr/0013, point 3 says what it does on other answers.
_CONSTANT = -18.62
_OF_ODDS, _OF_AGREEMENT, _OF_LINES, _OF_SHARPNESS, _OF_BEYOND = 0.63, 0.19, 3.2, 7.06, 44.39


# What an answer's trace calls its signs; where lines say another place, few edges, or edges beside them.
SIGNS_STAGE = "signs [as of trust_of]"
_FAR_APART_M, _FEW_NATS, _BLUNT = 2.0, 50.0, 0.2


class ConfidenceFeatures(NamedTuple):
    """The features of the trust model.

    Attributes:
        probability: Of (2 m, 2 deg) by the posterior's curvature: how well the photo says the pose, if it is
            the one and the map is right.
        apart_m: How far the place by the model's lines is from the best by regions and outlines.
        lines: Nats by which the photo's edges along the lines are likelier than anywhere.
        sharpness: Whether edges lie on the lines or beside them (R14): whether the map is exact.
        beyond: How far the height is beyond the prior's range, in half widths of it; 0 within.
    """

    probability: float
    apart_m: float
    lines: float
    sharpness: float
    beyond: float


class LineFeatures(NamedTuple):
    """Three of the features, which the model's lines give."""

    apart_m: float
    lines: float
    sharpness: float


# Of an answer that no line was laid over: as the median answer has it; and where none is in view.
TYPICAL_LINES, NO_LINES = LineFeatures(1.1, 150.0, 0.5), LineFeatures(3.0, 0.0, 0.0)


def success_probability(features: ConfidenceFeatures) -> float:
    """Returns the probability that an answer is within (2 m, 2 deg). Eq. (R20) of docs/methods/region.md."""
    probability = np.clip(features.probability, _LEAST_PROBABILITY, 1.0 - _LEAST_PROBABILITY)
    return float(
        scipy.special.expit(
            _CONSTANT
            + _OF_ODDS * scipy.special.logit(probability)
            - _OF_AGREEMENT * np.log(features.apart_m + _APART_M)
            + _OF_LINES * np.log(np.clip(features.lines, 0.0, _MOST_LINES) + _LEAST_LINES)
            + _OF_SHARPNESS * np.clip(features.sharpness, 0.0, 1.0)
            - _OF_BEYOND * np.clip(features.beyond, 0.0, _MOST_BEYOND)
        )
    )


def contradictions(features: ConfidenceFeatures) -> Iterator[str]:
    """Yields what speaks against an answer, in words."""
    if features.apart_m > _FAR_APART_M:
        yield f"edges along the map's lines fit best {features.apart_m:.1f} m away"
    if features.lines < _FEW_NATS:
        yield "few edges in the photo along the map's lines"
    elif features.sharpness < _BLUNT:
        yield "edges in the photo lie beside the map's lines"
    if features.beyond > 0:
        yield "the height is outside the range of the prior"
