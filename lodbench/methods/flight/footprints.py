"""What footprints of the map are wrong about, which no photo tells: cameras go aside with a building.

Walls of a block stand where the lowest level of detail draws them, metres beside those of the hall that is
there. More photos say nothing of that, more buildings do: their errors have little to do with each other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lodbench.methods.flight.photo_terms import PhotoTerms
from lodbench.methods.flight.roof_parts import RoofParts

Floats = NDArray[np.float64]


def footprint_covariance(
    terms: Sequence[PhotoTerms | None], roofs: RoofParts, footprint_m: float, size: int
) -> Floats:
    """Returns the covariance of what all cameras are off by with the buildings they show, (size, size).

    Eq. (F17) of docs/methods/flight.md.

    East and north come first, square metres; all else is 0.

    Args:
        terms: What photos say: the parts of roofs that they show.
        roofs: Whose parts these are.
        footprint_m: By how much one building's footprint is off along each axis, standard deviation, metres.
        size: Numbers in all.
    """
    shown = [roofs.building[term.parts] for term in terms if term is not None]
    buildings = np.concatenate([np.zeros(0, np.int64), *shown])
    counts = np.bincount(buildings[buildings >= 0]).astype(np.float64)
    found = np.zeros((size, size))
    # Weights as parts of roofs that photos show: so many buildings of one weight would say as much.
    alike = counts.sum() ** 2 / (counts**2).sum() if counts.any() else 1.0
    found[0, 0] = found[1, 1] = footprint_m**2 / alike
    return found
