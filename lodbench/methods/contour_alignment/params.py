"""Parameters of contour alignment; docs/methods/contour_alignment.md says where the defaults come from."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from lodbench.errors import require_choice, require_numbers, require_within
from lodbench.estimation.outline_alignment import OutlineModel
from lodbench.geometry import AxisRange, PoseGrid
from lodbench.methods.fits import SearchRange, set_sizes
from lodbench.photos.measurements import Measurements

_RANGES = ("range_x_m", "range_y_m", "range_z_m", "range_yaw_deg", "range_tilt_deg")
SEARCHES = ("auto", "grid", "basins")
_POSITIVE = (
    "stride_m",
    "stride_yaw_deg",
    "basin_stride_m",
    "basin_yaw_deg",
    "basin_reach_px",
    "spacing_px",
    "reach_px",
    "near_px",
    "noise_px",
    "correlation_px",
    "outline_px",
    "outlier_sigmas",
    "hidden_sigmas",
    "roof_part_px",
    "lens_percent",
    "lens_doubt_percent",
    "tilt_doubt_factor",
    "heat",
)
_PROBABILITIES = ("lens_doubt", "tilt_doubt")
# Between a lens as declared and one in doubt.
_START_LENS_PERCENT = 0.5
# Starts lie this close in the picture, pixels of the fine size, however near buildings are: little more than
# alignment reaches. They are never closer than half of what they are over far ones.
_STRIDE_PX, _CLOSEST = 60.0, 0.5
# Grids of more poses than this are left for basins: four times those of the published priors' grid.
_MOST_POSES = 2000


@dataclass(frozen=True, slots=True)
class ContourAlignmentParams(SearchRange):
    """The settings of ``method=contour_alignment``.

    Attributes:
        name: Name to report.
        coarse_size: Width and height of masks in the grid stage, pixels.
        fine_size: Width and height of masks where outlines are aligned, pixels.
        range_x_m: Full width of the prior's error in x, metres; likewise y and z.
        range_y_m: See range_x_m.
        range_z_m: See range_x_m.
        range_yaw_deg: Full width in yaw, degrees.
        range_tilt_deg: Full width in pitch and in roll, degrees.
        stride_m: Largest distance between samples of the grid along x, y and z, metres; less where buildings
            are so near that it is more than 60 pixels.
        stride_yaw_deg: The same in yaw, degrees.
        search: ``grid`` scores every sample; ``basins`` scores wider ones on small masks and aligns the
            outlines of the best from afar; ``auto`` takes the grid unless it is large.
        basin_stride_m: As stride_m, in ``basins``.
        basin_yaw_deg: As stride_yaw_deg, in ``basins``.
        basin_share: Share of the wider samples whose outlines are aligned.
        basin_reach_px: How far their outlines may lie apart in the first step, pixels of the fine size.
        basin_steps: Alignment steps of each, on masks of a quarter of the fine size.
        starts: Best poses of the grid whose outlines are aligned; up to twice as many over near buildings.
        steps: Alignment steps of each start, on masks of half the size.
        final_steps: Alignment steps of the best of them, at full size.
        spacing_px: Distance between outline points, pixels.
        reach_px: Scale of the robust kernel in the first step: how far outlines may lie apart, pixels of
            the fine size.
        near_px: The same in the last of these steps.
        noise_px: Standard deviation of a mask's outline to begin with, pixels of the fine size; the final
            steps find it from the view.
        correlation_px: Length of outline that counts as one observation until then, pixels.
        outline_px: Distance over which the errors of a mask's outline go together, pixels of the fine size.
        outlier_sigmas: Scale of the robust kernel in the final steps, in standard deviations of the outline.
        hidden_sigmas: The same where the map's outline lies outside a rough mask: networks miss parts of
            buildings, behind trees and in shadows, more often than they take anything else for one.
        roof_m: Standard deviation of each building's height in the map until the final steps, which find it
            from the view, metres; 0 trusts the map.
        pitched_lower_m: How much lower than in the map the roofs of blocks are beforehand where its source
            states that they are pitched, metres.
        roof_part_px: Distance over which a roof's error goes together, pixels of the fine size.
        lens_percent: Standard deviation of the focal length, percent.
        lens_doubt: Probability that the focal length is worse than that.
        lens_doubt_percent: Its standard deviation then, percent.
        tilt_doubt: Probability that the prior's tilt is worse than declared.
        tilt_doubt_factor: How many times as wide it is then.
        heat: What the final steps' likelihood is divided by in its logarithm: 1 takes the model of errors for
            the whole truth.
    """

    name: str = "contour_alignment"
    coarse_size: tuple[int, int] = (301, 224)
    fine_size: tuple[int, int] = (602, 448)
    range_x_m: float = 20.0
    range_y_m: float = 20.0
    range_z_m: float = 60.0
    range_yaw_deg: float = 15.0
    range_tilt_deg: float = 2.0
    stride_m: float = 10.0
    stride_yaw_deg: float = 2.15
    search: str = "auto"
    basin_stride_m: float = 25.0
    basin_yaw_deg: float = 5.0
    basin_share: float = 0.05
    basin_reach_px: float = 64.0
    basin_steps: int = 5
    starts: int = 8
    steps: int = 10
    final_steps: int = 7
    spacing_px: float = 4.0
    reach_px: float = 24.0
    near_px: float = 3.0
    noise_px: float = 2.0
    correlation_px: float = 16.0
    outline_px: float = 40.0
    outlier_sigmas: float = 3.0
    hidden_sigmas: float = 1.8
    roof_m: float = 2.0
    pitched_lower_m: float = 1.0
    roof_part_px: float = 60.0
    lens_percent: float = 0.2
    lens_doubt: float = 0.3
    lens_doubt_percent: float = 2.0
    tilt_doubt: float = 0.05
    tilt_doubt_factor: float = 5.0
    heat: float = 2.5

    def __post_init__(self) -> None:
        set_sizes(self, ("coarse_size", "fine_size"), least_px=8)
        require_numbers(self, "method", (*_RANGES, "roof_m", "pitched_lower_m"), 0)
        require_numbers(self, "method", _POSITIVE, 0, ends="(]")
        require_numbers(self, "method", _PROBABILITIES, 0, 1, "()")
        require_choice("method.search", self.search, SEARCHES)
        require_within("method.basin_share", self.basin_share, 0, 1, "(]")
        require_within("method.starts", self.starts, 1)
        require_numbers(self, "method", ("steps", "final_steps", "basin_steps"), 0)

    def grid(self) -> PoseGrid:
        """Returns the grid: samples at most a stride apart, ends included."""
        return self._grid(self.stride_m, self.stride_yaw_deg)

    def basin_grid(self) -> PoseGrid:
        """Returns the wider grid of ``basins``."""
        return self._grid(self.basin_stride_m, self.basin_yaw_deg)

    def searches_basins(self) -> bool:
        """Returns whether the starts come from basins."""
        return self.search == "basins" or (self.search == "auto" and len(self.grid()) > _MOST_POSES)

    def _grid(self, stride_m: float, stride_yaw_deg: float) -> PoseGrid:
        x, y, z = (_axis(width, stride_m) for width in (self.range_x_m, self.range_y_m, self.range_z_m))
        return PoseGrid(x, y, z, _axis(self.range_yaw_deg, stride_yaw_deg))

    def prior_sigmas(self) -> tuple[float, ...]:
        """Returns the standard deviations of the prior's x, y, z, pitch, roll and yaw.

        The tilt has that of its uniform range. For what the grid has searched the alignment needs no
        more than a weak hold: the half width. A range of 0 is held to a millimetre or a ten-thousandth
        of a degree.
        """
        place = [max(0.5 * w, 1e-3) for w in (self.range_x_m, self.range_y_m, self.range_z_m)]
        tilt = max(0.5 * self.range_tilt_deg / math.sqrt(3.0), 1e-4)
        return (*place, tilt, tilt, max(0.5 * self.range_yaw_deg, 1e-4))

    def outline_model(self, measured: Measurements | None = None) -> OutlineModel:
        """Returns how outlines are compared, beside stated deviations, until tilt and lens are weighed."""
        reach_m, turn_deg = self.reach()
        sigmas = self.prior_sigmas() if measured is None else measured.over(np.array(self.prior_sigmas()))
        return OutlineModel(
            size=self.fine_size,
            sigmas=(*sigmas, _START_LENS_PERCENT),
            reach_m=reach_m,
            turn_deg=turn_deg,
            spacing_px=self.spacing_px,
            noise_px=self.noise_px,
            correlation_px=self.correlation_px,
            roof_m=self.roof_m,
            outline_px=self.outline_px,
            roof_part_px=self.roof_part_px,
        )

    def camera_sigmas(
        self, prior: Iterable[float], *, is_tilt_free: bool, is_lens_free: bool
    ) -> tuple[float, ...]:
        """Returns (6,) deviations of the prior, and the lens's, under a hypothesis of tilt and lens."""
        *place, pitch, roll, yaw = prior
        wider = self.tilt_doubt_factor if is_tilt_free else 1.0
        lens = self.lens_doubt_percent if is_lens_free else self.lens_percent
        return (*place, wider * pitch, wider * roll, yaw, lens)

    def camera_odds(self, is_tilt_free: bool, is_lens_free: bool) -> float:
        """Returns how likely such a hypothesis is before the photo."""
        tilt = self.tilt_doubt if is_tilt_free else 1.0 - self.tilt_doubt
        return tilt * (self.lens_doubt if is_lens_free else 1.0 - self.lens_doubt)

    def reaches_px(self) -> tuple[float, ...]:
        """Returns the kernel's scale in each alignment step: falling evenly in proportion."""
        return _falling(self.reach_px, self.near_px, self.steps)

    def basin_reaches_px(self) -> tuple[float, ...]:
        """Returns the same for the alignment from afar, which ends where the other begins."""
        return _falling(self.basin_reach_px, self.reach_px, self.basin_steps)

    def over(self, pixels_per_m: float) -> ContourAlignmentParams:
        """Returns these parameters for buildings of such a scale, pixels of the fine size per metre.

        Eq. (C16) of docs/methods/contour_alignment.md. Near buildings need closer starts. A degree is as many
        pixels over all: its stride grows instead.
        """
        share = max(_CLOSEST, _STRIDE_PX / max(_STRIDE_PX, pixels_per_m * self.stride_m))
        return replace(
            self,
            search="basins" if self.searches_basins() else "grid",
            stride_m=share * self.stride_m,
            stride_yaw_deg=self.stride_yaw_deg / share,
            basin_stride_m=share * self.basin_stride_m,
            starts=round(self.starts / share),
        )

    def with_lens(self, percent: float | None) -> ContourAlignmentParams:
        """Returns these parameters for a lens that is known no better than so, percent, where declared."""
        return self if percent is None else replace(self, lens_percent=max(self.lens_percent, percent))


def _falling(first: float, last: float, steps: int) -> tuple[float, ...]:
    if steps < 2:
        return (first,) * steps
    return tuple(first * (last / first) ** (k / (steps - 1)) for k in range(steps))


def _axis(width: float, stride: float) -> AxisRange:
    return AxisRange(width, math.ceil(width / stride - 1e-9) + 1)
