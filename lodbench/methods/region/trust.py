"""How far to trust an answer: signs that it is right, and the one model that weighs them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import expit, logit

# Probabilities by the covariance are not believed beyond this; what places are apart by chance, metres;
# the least fit, nats per pixel; how far beyond the range of heights counts, of its half width.
_LEAST_PROBABILITY, _APART_M, _LEAST_FIT, _MOST_BEYOND = 0.02, 0.3, 0.01, 0.5
# Logistic regression on 142 answers of the search before docs/adr/0052, then fitted again, held to those
# weights, to 128 of the present one, 108 of them within (2 m, 2 deg): drawn photos in the look `hard`, seeds
# 102 and 103, over UAVD4L-LoD1, 3DBAG, PLATEAU 52397519 and North Rhine-Westphalia, and the eight labelled
# real photos, which weigh as much as all drawn ones. Each weight was held to one sign. docs/adr/0053 says
# what it does on what it has not seen.
_CONSTANT = -0.23
_OF_ODDS, _OF_AGREEMENT, _OF_SHARPNESS, _OF_FIT, _OF_BEYOND = 0.56, 1.22, 4.93, 1.01, 17.5


class Signs(NamedTuple):
    """What tells right answers from wrong ones.

    Attributes:
        probability: Of (2 m, 2 deg) by the posterior's curvature: how well the photo says the pose, if it is
            the one and the map is right.
        apart_m: How far the place by the model's lines is from the best by regions and outlines.
        sharpness: How sharply the photo's edges fall off beside the lines, 0 to 1: whether map and pose are
            exact.
        fit: Of regions and outlines as tops are chosen by, nats per pixel.
        beyond: How far the height is beyond the prior's range, in half widths of it; 0 within.
    """

    probability: float
    apart_m: float
    sharpness: float
    fit: float
    beyond: float


# Of an answer that no line was laid over: as the median answer has it; and where none is in view.
TYPICAL_LINES, NO_LINES = (1.1, 0.53), (3.0, 0.0)


def trust_of(signs: Signs) -> float:
    """Returns the probability that an answer is within (2 m, 2 deg)."""
    probability = np.clip(signs.probability, _LEAST_PROBABILITY, 1.0 - _LEAST_PROBABILITY)
    return float(
        expit(
            _CONSTANT
            + _OF_ODDS * logit(probability)
            - _OF_AGREEMENT * np.log(signs.apart_m + _APART_M)
            + _OF_SHARPNESS * np.clip(signs.sharpness, 0.0, 1.0)
            + _OF_FIT * np.log(max(signs.fit, _LEAST_FIT))
            - _OF_BEYOND * np.clip(signs.beyond, 0.0, _MOST_BEYOND)
        )
    )
