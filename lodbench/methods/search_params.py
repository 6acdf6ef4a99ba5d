"""What parameters of methods that search round a prior have in common."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from lodbench.datasets.priors import UniformPrior
from lodbench.errors import ConfigError
from lodbench.kernels.raster_rule import GUARD_PX


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


def ranges_of(prior: UniformPrior) -> dict[str, Any]:
    """Returns the full widths of all that a prior leaves open, metres and degrees, as settings call them."""
    return {
        "range_x_m": 2.0 * prior.x_m,
        "range_y_m": 2.0 * prior.y_m,
        "range_z_m": 2.0 * prior.z_m,
        "range_yaw_deg": 2.0 * prior.yaw_deg,
    }
