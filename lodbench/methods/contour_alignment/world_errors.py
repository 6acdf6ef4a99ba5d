"""What map and camera may be wrong about: the few hypotheses between which a view decides (docs/adr/0026)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Whole pixels that a mask may be grown or shrunk by: standard deviation.
_BIAS_PX = 0.5


@dataclass(frozen=True, slots=True)
class WorldErrors:
    """How a city may differ from its map: Gaussian errors in metres, common ones and each building's own.

    Attributes:
        name: In a word.
        odds: How likely before the view is seen; relative to the other hypotheses.
        roof_m: Standard deviation of each building's height.
        part_m: The same of parts of its roof.
        base_m: The same of where its walls are seen to end.
        roofs_m: Mean and standard deviation of what the heights of all buildings err by together.
        bases_m: The same of where all walls end.
    """

    name: str
    odds: float
    roof_m: float
    part_m: float
    base_m: float
    roofs_m: tuple[float, float]
    bases_m: tuple[float, float]

    @property
    def shared_mean(self) -> Floats:
        """Returns (3,) means of what all points share: roofs and bases in metres, the outline in pixels."""
        return np.array([self.roofs_m[0], self.bases_m[0], 0.0])

    @property
    def shared_sigmas(self) -> Floats:
        """Returns (3,) standard deviations of the same."""
        return np.array([self.roofs_m[1], self.bases_m[1], _BIAS_PX])


_EXACT = WorldErrors("exact", 0.30, 0.2, 0.2, 0.05, (0.0, 0.2), (0.0, 0.05))
_FAIR = WorldErrors("fair", 0.30, 0.6, 0.6, 0.1, (-0.2, 0.4), (0.0, 0.1))
# Blocks reach the middle of a roof or its ridge; what is seen of it are mostly its eaves.
_COARSE = WorldErrors("coarse", 0.30, 1.3, 1.3, 0.2, (-0.7, 0.8), (0.0, 0.1))
_VAGUE = WorldErrors("vague", 0.10, 3.0, 3.0, 0.6, (0.0, 2.0), (0.0, 0.3))
# A map older than its roofs, or drawn up to the eaves.
_TOO_LOW = WorldErrors("too low", 0.01, 0.3, 0.3, 0.05, (1.2, 0.5), (0.0, 0.05))
# Hedges, cars and slopes hide the feet of walls: they end higher, never lower. Rough masks of few buildings
# look like it too, hence the odds: where feet are hidden the evidence is 20 and more in its logarithm,
# elsewhere seldom 10.
_HIDDEN = WorldErrors("feet hidden", 1e-3, 0.2, 0.2, 0.3, (0.0, 0.2), (1.2, 0.8))
_COARSE_HIDDEN = WorldErrors("coarse, feet hidden", 1e-3, 1.3, 1.3, 0.6, (-0.7, 0.8), (1.2, 0.8))

# Which hypotheses are followed together, and whether the lens is free there. A pose that explains hidden feet
# by wrong roofs looks good from where it stands, so the two are followed apart and compared at their ends.
TRACKS: tuple[tuple[tuple[WorldErrors, ...], bool], ...] = (
    ((_EXACT, _FAIR, _COARSE, _VAGUE, _TOO_LOW), False),
    ((_HIDDEN, _COARSE_HIDDEN), False),
    ((_EXACT, _FAIR, _COARSE, _HIDDEN), True),
)
