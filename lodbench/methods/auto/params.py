"""Parameters of the method that chooses between pixels and mask."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

from lodbench.datasets.priors import UniformPrior
from lodbench.errors import require_numbers
from lodbench.methods.contour_alignment import Params as MaskParams
from lodbench.methods.region import Params as PixelParams
from lodbench.methods.search_params import ranges_of

_RANGES = ("range_x_m", "range_y_m", "range_z_m", "range_yaw_deg", "range_tilt_deg")


@dataclass(frozen=True, slots=True)
class Params:
    """What both methods search; all else is at the defaults of ``region`` and ``contour_alignment``.

    Attributes:
        name: Name to report.
        range_x_m: Full width of the search east and west of the prior, metres.
        range_y_m: The same north and south.
        range_z_m: The same up and down.
        range_yaw_deg: The same in heading, degrees.
        range_tilt_deg: The same in pitch and roll; 0 holds them at the prior's.
    """

    name: str = "auto"
    range_x_m: float = 20.0
    range_y_m: float = 20.0
    range_z_m: float = 60.0
    range_yaw_deg: float = 15.0
    range_tilt_deg: float = 2.0

    def __post_init__(self) -> None:
        require_numbers(self, "method", _RANGES, 0)

    def by_pixels(self) -> PixelParams:
        """Returns the parameters of ``region``."""
        return replace(PixelParams(), **self._ranges())

    def by_mask(self) -> MaskParams:
        """Returns the parameters of ``contour_alignment``."""
        return replace(MaskParams(), **self._ranges())

    def for_prior(self, prior: UniformPrior) -> Params:
        """Returns these parameters for a prior's error of other half widths."""
        return replace(self, **ranges_of(prior), range_tilt_deg=prior.pitch_deg + prior.roll_deg)

    def _ranges(self) -> dict[str, Any]:
        return {name: value for name, value in asdict(self).items() if name in _RANGES}
