"""The ground of the town: smooth hills that fall to the river."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """Ground heights as a few long waves on a slope.

    Attributes:
        base_m: Height at the town's middle before the waves, metres above sea level.
        slope: (2,) metres of rise per metre, away from the river.
        waves: (N, 4) rows of wave vector x, y (radians per metre), phase (radians), amplitude (m).
    """

    base_m: float
    slope: Points
    waves: Points

    @classmethod
    def draw(cls, generator: np.random.Generator, uphill: Points) -> Terrain:
        """Returns hills that rise along a unit direction, (2,), by about 20 m over the town."""
        waves = []
        for wavelength, amplitude in ((900.0, 4.0), (620.0, 2.5), (380.0, 1.0)):
            turn, phase = generator.uniform(0, 2 * np.pi, 2)
            number = 2 * np.pi / wavelength
            waves.append([number * np.cos(turn), number * np.sin(turn), phase, amplitude])
        slope = np.asarray(uphill) * generator.uniform(0.012, 0.018)
        return cls(float(generator.uniform(180.0, 260.0)), slope, np.array(waves))

    def height(self, points: Points) -> Points:
        """Returns the ground height, (N,) metres, at local positions, (N, 2)."""
        phase = points @ self.waves[:, :2].T + self.waves[:, 2]
        return np.asarray(self.base_m + points @ self.slope + np.sin(phase) @ self.waves[:, 3])
