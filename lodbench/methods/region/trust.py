"""The trust model: features of an answer, and the probability that it is right, by logistic regression."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy

# Probabilities by the covariance are kept this far from 0 and 1.
_LEAST_PROBABILITY = 0.02
# Added to the distance before its logarithm, metres: distances below are chance.
_DISTANCE_OFFSET_M = 0.3
# Added to the lines' log-ratio before its logarithm, nats: less is chance.
_LINE_OFFSET_NATS = 10.0
# The largest log-ratio of lines that counts, nats: towards the horizon thousands of short lines meet edges.
_MOST_LINE_NATS = 300.0
# The largest distance of the height from the prior's range that counts, half widths.
_MOST_BEYOND_HALF_WIDTHS = 0.5
# Logistic regression on 684 answers, 531 of them within (2 m, 2 deg): drawn photos in the look `hard`, seeds
# 103 and 104, over thirteen files; thermal query, labelled and traced real photos, 122 of these from priors
# of +-50 m and +-30 deg. Labelled photos weigh three times as much. Each weight was held to one sign.
# docs/adr/0013, point 3 says what it does on other answers.
_INTERCEPT, _WEIGHT_LOGIT, _WEIGHT_LOG_DISTANCE, _WEIGHT_LOG_NATS = -18.62, 0.63, 0.19, 3.2
_WEIGHT_SHARPNESS, _WEIGHT_BEYOND_HALF_WIDTHS = 7.06, 44.39


# The trace of an answer stores its features under this key, which runs hold.
CONFIDENCE_STAGE = "signs [as of trust_of]"
# Beyond these, ``contradictions`` names a feature: distance in metres, log-ratio in nats, sharpness.
_FAR_APART_M, _FEW_LINE_NATS, _LOW_SHARPNESS = 2.0, 50.0, 0.2


class ConfidenceFeatures(NamedTuple):
    """The features of the trust model."""

    probability: float  # probability of (2 m, 2 deg) by the covariance if the mode and the map are right
    apart_m: float  # distance between the position by the model's lines and that of the search's mode, metres
    line_log_ratio_nats: float  # log-ratio of the photo's edges on the lines to edges anywhere, nats
    # Whether edges lie on the lines, 1, or next to them, 0 or less: whether the map is exact
    sharpness: float
    beyond: float  # how far the height is beyond the prior's range, half widths of it; 0 within


class LineFeatures(NamedTuple):
    """The three features that come from the model's lines; see ``ConfidenceFeatures``."""

    apart_m: float
    line_log_ratio_nats: float
    sharpness: float


# Features where lines are not used: those of the median answer; and where no line is in view.
TYPICAL_LINES, NO_LINES = LineFeatures(1.1, 150.0, 0.5), LineFeatures(3.0, 0.0, 0.0)


def success_probability(features: ConfidenceFeatures) -> float:
    """Returns the probability that an answer is within (2 m, 2 deg), given that its mode is the right one.

    Eq. (R20) of docs/methods/region.md.
    """
    probability = np.clip(features.probability, _LEAST_PROBABILITY, 1.0 - _LEAST_PROBABILITY)
    line_nats = np.clip(features.line_log_ratio_nats, 0.0, _MOST_LINE_NATS)
    return float(
        scipy.special.expit(
            _INTERCEPT
            + _WEIGHT_LOGIT * scipy.special.logit(probability)
            - _WEIGHT_LOG_DISTANCE * np.log(features.apart_m + _DISTANCE_OFFSET_M)
            + _WEIGHT_LOG_NATS * np.log(line_nats + _LINE_OFFSET_NATS)
            + _WEIGHT_SHARPNESS * np.clip(features.sharpness, 0.0, 1.0)
            - _WEIGHT_BEYOND_HALF_WIDTHS * np.clip(features.beyond, 0.0, _MOST_BEYOND_HALF_WIDTHS)
        )
    )


def contradictions(features: ConfidenceFeatures) -> Iterator[str]:
    """Yields a sentence on each feature that makes an answer doubtful."""
    if features.apart_m > _FAR_APART_M:
        yield f"edges along the map's lines fit best {features.apart_m:.1f} m away"
    if features.line_log_ratio_nats < _FEW_LINE_NATS:
        yield "few edges in the photo along the map's lines"
    elif features.sharpness < _LOW_SHARPNESS:
        yield "edges in the photo lie beside the map's lines"
    if features.beyond > 0:
        yield "the height is outside the range of the prior"
