"""The 4D grid of pose hypotheses around a prior (paper equation 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import LodbenchError
from lodbench.geometry.pose import Pose


@dataclass(frozen=True, slots=True)
class AxisRange:
    """One axis of the grid: full width (metres or degrees) and number of samples."""

    width: float
    count: int

    def __post_init__(self) -> None:
        if self.count < 1 or not 0 <= self.width < math.inf:
            raise LodbenchError(
                f"A grid axis needs a width >= 0 and a count >= 1, not {self.width} and {self.count}."
            )

    def offsets(self) -> NDArray[np.float64]:
        """Returns ``count`` offsets from -width/2 to +width/2, ends included; one sample is the centre.

        Eq. (L1) of docs/methods/lodlocv2.md.
        """
        if self.count == 1:
            return np.zeros(1)
        steps = np.arange(self.count, dtype=np.float64)
        return -self.width / 2 + steps * (self.width / (self.count - 1))


@dataclass(frozen=True, slots=True)
class PoseGrid:
    """The Cartesian product of four axes, in the order (yaw, x, y, z), z fastest."""

    x: AxisRange
    y: AxisRange
    z: AxisRange
    yaw: AxisRange

    def __len__(self) -> int:
        return self.x.count * self.y.count * self.z.count * self.yaw.count

    def around(self, prior: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the hypotheses around a prior; pitch and roll stay the prior's.

        Returns:
            Camera centres, (N, 3), world metres, and yaws, (N,), degrees.
        """
        yaws = prior.euler.yaw_deg + self.yaw.offsets()
        axes = np.meshgrid(self.x.offsets(), self.y.offsets(), self.z.offsets(), indexing="ij")
        centers = prior.center + np.stack([axis.ravel() for axis in axes], axis=1)
        return np.tile(centers, (self.yaw.count, 1)), np.repeat(yaws, len(centers))
