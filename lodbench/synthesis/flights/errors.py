"""What a drone is wrong about: alike in all photos of a flight, and in each by itself."""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import ConfigError
from lodbench.geometry import EulerAngles, Pose

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SensorErrors:
    """Half widths of uniform errors, either a flight's or a photo's own.

    Raises:
        ConfigError: One is negative or not finite.
    """

    horizontal_m: float  # east and north, metres
    height_m: float  # up, metres
    tilt_deg: float  # pitch and roll, degrees
    yaw_deg: float  # yaw, degrees

    def __post_init__(self) -> None:
        if not all(0 <= width < np.inf for width in astuple(self)):
            names = ", ".join(field.name for field in fields(self))
            raise ConfigError(f"A flight's errors ({names}) are finite and >= 0, not {astuple(self)}.")

    def draw(self, generator: np.random.Generator) -> Floats:
        """Returns (6,) errors of x, y, z (metres), pitch, roll and yaw (degrees)."""
        place = (self.horizontal_m, self.horizontal_m, self.height_m)
        widths = np.array([*place, self.tilt_deg, self.tilt_deg, self.yaw_deg])
        return np.asarray(generator.uniform(-1.0, 1.0, size=6) * widths)


def moved(pose: Pose, error: Floats) -> Pose:
    """Returns a pose whose centre and angles are off by (6,) metres and degrees."""
    angles = np.array(pose.euler) + error[3:]
    return Pose.from_euler(EulerAngles(*map(float, angles)), pose.center + error[:3])
