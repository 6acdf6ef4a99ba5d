"""What parameters of methods that search round a prior have in common."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Self

from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import ConfigError
from lodbench.kernels.raster_rule import GUARD_PX
from lodbench.photos.measurements import Measurements

# A search looks so many of the prior's stated standard deviations to either side.
REACH = 3.0


def set_sizes(params: object, names: Iterable[str], least_px: int = 1) -> None:
    """Makes pairs of whole numbers of some settings of a frozen dataclass: widths and heights, pixels.

    OmegaConf hands over lists where a tuple is declared, and checks neither lengths nor ranges.

    Raises:
        ConfigError: One is no pair, or a side is out of what can be drawn.
    """
    for name in names:
        size = tuple(int(side) for side in getattr(params, name))
        if len(size) != 2 or min(size) < least_px or max(size) > GUARD_PX:
            sides = f"{least_px} to {GUARD_PX} px"
            raise ConfigError(f"method.{name} is a width and a height, {sides}, not {list(size)}.")
        object.__setattr__(params, name, size)


class SearchRange:
    """What parameters with full widths of the prior's error have in common; metres and degrees."""

    __slots__ = ()
    range_x_m: float
    range_y_m: float
    range_z_m: float
    range_yaw_deg: float
    range_tilt_deg: float

    def for_prior(self, prior: UniformPrior) -> Self:
        """Returns these parameters for a prior's error of other half widths."""
        ranges: dict[str, Any] = ranges_of(prior) | {"range_tilt_deg": prior.pitch_deg + prior.roll_deg}
        return replace(self, **ranges)  # type: ignore[type-var]

    def over_measured(self, measured: Measurements | None) -> Self:
        """Returns these parameters with ranges as wide as stated deviations of a photo's prior say.

        Eq. (M8) of docs/methods/index.md.
        """
        if measured is None:
            return self
        x, y, z, pitch, roll, yaw = measured.sigmas
        names = ("range_x_m", "range_y_m", "range_z_m", "range_yaw_deg")
        widths = {
            name: 2.0 * REACH * s for name, s in zip(names, (x, y, z, yaw), strict=True) if s is not None
        }
        if "range_yaw_deg" in widths:
            widths["range_yaw_deg"] = min(widths["range_yaw_deg"], 360.0)
        if pitch is not None or roll is not None:
            halves = [0.5 * self.range_tilt_deg if s is None else REACH * s for s in (pitch, roll)]
            widths["range_tilt_deg"] = 2.0 * max(halves)
        return replace(self, **widths) if widths else self  # type: ignore[type-var]

    def half_widths(self) -> tuple[float, ...]:
        """Returns the half widths of x, y, z, pitch, roll and yaw; at least 1 mm and 0.0001 degrees."""
        place = (self.range_x_m, self.range_y_m, self.range_z_m)
        turn = (self.range_tilt_deg, self.range_tilt_deg, self.range_yaw_deg)
        return (*(max(0.5 * w, 1e-3) for w in place), *(max(0.5 * w, 1e-4) for w in turn))

    def reach(self) -> tuple[float, float]:
        """Returns how far from the prior the camera may be, metres, and how far turned, degrees.

        Full widths, where half would do: steps may lead out of the range, though the prior calls back.
        """
        reach_m = math.hypot(self.range_x_m, self.range_y_m, self.range_z_m)
        return reach_m, self.range_yaw_deg + 2.0 * self.range_tilt_deg


def ranges_of(prior: UniformPrior) -> dict[str, Any]:
    """Returns the full widths of all that a prior leaves open, metres and degrees, as settings call them."""
    return {
        "range_x_m": 2.0 * prior.x_m,
        "range_y_m": 2.0 * prior.y_m,
        "range_z_m": 2.0 * prior.z_m,
        "range_yaw_deg": 2.0 * prior.yaw_deg,
    }
