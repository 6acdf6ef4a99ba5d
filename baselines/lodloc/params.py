"""Settings of LoD-Loc (v1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import require_within
from lodbench.geometry import AxisRange, PoseGrid
from lodbench.methods.fits import ranges_of

_BOUNDS = {
    "size": (64, 4096),
    "spacing_m": (0.01, 1000.0),
    "points": (60, 1_000_000),
    "range_x_m": (0.0, 1e4),
    "range_y_m": (0.0, 1e4),
    "range_z_m": (0.0, 1e4),
    "range_yaw_deg": (0.0, 360.0),
    "count_x": (1, 1000),
    "count_y": (1, 1000),
    "count_z": (1, 1000),
    "count_yaw": (1, 1000),
    "spread": (0.0, 100.0),
    "iterations": (0, 1000),
    "rounds": (1, 10),
    "least_score": (-1e6, 1e6),
}


@dataclass(frozen=True, slots=True)
class LodLocParams:
    """Settings of ``method=lodloc``.

    Attributes:
        name: Name to report.
        weights: ONNX file of ``lodbench train method=lodloc``; None for the weights in the package.
        size: Long side that photos are brought to, pixels.
        spacing_m: Between neighbouring points on an edge.
        points: At most so many points, chosen at random.
        range_x_m: Full width of the first stage's grid, metres; likewise y and z.
        range_y_m: See range_x_m.
        range_z_m: See range_x_m.
        range_yaw_deg: Full width of the first stage's grid in yaw, degrees.
        count_x: Samples of each stage along x, ends included; likewise y, z and yaw.
        count_y: See count_x.
        count_z: See count_x.
        count_yaw: See count_x.
        spread: Half width of a further stage's grid, in standard deviations of the stage before.
        iterations: Gauss-Newton steps.
        rounds: How often all but the first stage is done, each time with the edges that the last pose sees.
        least_score: An answer whose wireframe scores no more is a failure. Places outside the photo score 0:
            what scores no more fits no better than nothing.

    Raises:
        ConfigError: A value is out of range; the message names it.
    """

    name: str = "lodloc"
    weights: str | None = None
    size: int = 512
    spacing_m: float = 1.0
    points: int = 2000
    range_x_m: float = 20.0
    range_y_m: float = 20.0
    range_z_m: float = 60.0
    range_yaw_deg: float = 15.0
    count_x: int = 10
    count_y: int = 10
    count_z: int = 30
    count_yaw: int = 8
    spread: float = 0.8
    iterations: int = 15
    rounds: int = 2
    least_score: float = 0.0

    def __post_init__(self) -> None:
        for name, (low, high) in _BOUNDS.items():
            require_within(f"method.{name}", getattr(self, name), low, high)

    def grid(self) -> PoseGrid:
        """Returns the first stage's grid."""
        return PoseGrid(
            AxisRange(self.range_x_m, self.count_x),
            AxisRange(self.range_y_m, self.count_y),
            AxisRange(self.range_z_m, self.count_z),
            AxisRange(self.range_yaw_deg, self.count_yaw),
        )

    def for_prior(self, prior: UniformPrior) -> LodLocParams:
        """Returns these parameters with a first stage that covers a prior's error; counts stay."""
        return replace(self, **ranges_of(prior))
