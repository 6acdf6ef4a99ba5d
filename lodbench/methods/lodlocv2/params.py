"""Parameters of LoD-Loc v2; the defaults are the paper's where it gives them (docs/methods/lodlocv2.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import ConfigError, require_choice, require_numbers, require_within
from lodbench.geometry import AxisRange, PoseGrid
from lodbench.methods.search_params import set_sizes
from lodbench.plugins import load_plugin

VARIANTS = ("full", "no_refine", "no_select")


@dataclass(frozen=True, slots=True)
class LodLocV2Params:
    """Everything LoD-Loc v2 can be told.

    Attributes:
        name: Name to report.
        variant: ``full``; ``no_refine`` stops after the grid; ``no_select`` starts the filter at the prior.
        fit: What poses are ranked by, an entry point under ``lodbench.fits``; the paper's is ``iou``.
            ``semantic_iou`` compares roofs and walls apart; ``region`` looks at the photo and needs no mask.
        coarse_size: Width and height of masks in the grid stage, pixels.
        range_x_m: Full width of the grid, metres; likewise y and z.
        range_y_m: See range_x_m.
        range_z_m: See range_x_m.
        range_yaw_deg: Full width of the grid in yaw, degrees.
        count_x: Samples along x, ends included; likewise y, z and yaw.
        count_y: See count_x.
        count_z: See count_x.
        count_yaw: See count_x.
        fine_size: Width and height of masks in the filter, pixels.
        beams: Independent searches.
        steps: Filter steps.
        candidates: Poses per step, over all beams, the kept ones included.
        kept: Best poses each beam carries on unchanged.
        sigma_m: Standard deviation of the first step's moves along each axis, metres.
        spread_yaw_deg: Half width of the first step's uniform turns, degrees.
        gamma: Floor of the linear decay of both.
    """

    name: str = "lodlocv2"
    variant: str = "full"
    fit: str = "iou"
    coarse_size: tuple[int, int] = (301, 224)
    range_x_m: float = 20.0
    range_y_m: float = 20.0
    range_z_m: float = 60.0
    range_yaw_deg: float = 15.0
    count_x: int = 3
    count_y: int = 3
    count_z: int = 7
    count_yaw: int = 8
    fine_size: tuple[int, int] = (602, 448)
    beams: int = 2
    steps: int = 40
    candidates: int = 52
    kept: int = 2
    sigma_m: float = 1.5
    spread_yaw_deg: float = 2.0
    gamma: float = 0.3

    def __post_init__(self) -> None:
        set_sizes(self, ("coarse_size", "fine_size"))
        require_choice("method.variant", self.variant, VARIANTS)
        load_plugin("fits", self.fit)
        require_numbers(self, "method", ("beams", "steps", "kept"), 1)
        if self.children_per_parent < 1 or self.candidates != self.beams * self.kept * (
            1 + self.children_per_parent
        ):
            raise ConfigError(
                f"method.candidates={self.candidates} is not beams x kept x (1 + whole children).",
                f"With {self.beams} beams and {self.kept} kept, use a multiple of {self.beams * self.kept}.",
            )
        require_numbers(self, "method", ("sigma_m", "spread_yaw_deg"), 0)
        require_numbers(self, "method", ("range_x_m", "range_y_m", "range_z_m", "range_yaw_deg"), 0)
        require_numbers(self, "method", ("count_x", "count_y", "count_z", "count_yaw"), 1)
        require_within("method.gamma", self.gamma, 0, 1)

    @property
    def children_per_parent(self) -> int:
        """Returns how many moved copies each kept pose gets per step."""
        return self.candidates // (self.beams * self.kept) - 1

    def grid(self) -> PoseGrid:
        """Returns the coarse grid (paper equation 1)."""
        return PoseGrid(
            AxisRange(self.range_x_m, self.count_x),
            AxisRange(self.range_y_m, self.count_y),
            AxisRange(self.range_z_m, self.count_z),
            AxisRange(self.range_yaw_deg, self.count_yaw),
        )

    def for_prior(self, prior: UniformPrior) -> LodLocV2Params:
        """Returns these parameters with a grid that covers a prior's error at the same stride.

        Eq. (L2) of docs/methods/lodlocv2.md.

        An axis of one sample has no stride and stays as it is.
        """
        wanted = {"x": prior.x_m, "y": prior.y_m, "z": prior.z_m, "yaw": prior.yaw_deg}
        changes: dict[str, float] = {}
        for axis, half_width in wanted.items():
            width_name = f"range_{axis}_deg" if axis == "yaw" else f"range_{axis}_m"
            width, count = getattr(self, width_name), getattr(self, f"count_{axis}")
            if count > 1 and width > 0:
                steps = 2 * half_width / (width / (count - 1))
                changes |= {
                    width_name: 2.0 * half_width,
                    # A stride that divides the width but for rounding takes no step more.
                    f"count_{axis}": math.ceil(steps - 1e-9) + 1,
                }
        return replace(self, **changes)  # type: ignore[arg-type]

    def scale(self, step: int) -> float:
        """Returns the factor on sigma and spread at a step: linear decay with a floor at gamma.

        Eq. (L6) of docs/methods/lodlocv2.md.
        """
        return max(self.gamma, (self.steps - step) / self.steps)
