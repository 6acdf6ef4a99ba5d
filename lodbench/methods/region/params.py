"""Parameters of region-based localisation; docs/methods/region.md says where the defaults come from."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import ConfigError, require_numbers
from lodbench.geometry import AxisRange, PoseGrid
from lodbench.kernels.arguments import GUARD_PX
from lodbench.methods.fits import SearchRange

_CIRCLE_DEG = 360.0
_RANGES = ("range_x_m", "range_y_m", "range_z_m", "range_yaw_deg", "range_tilt_deg")
_AT_LEAST_0 = (
    *("beyond_m", "beyond_yaw_deg", "effective_pixels", "edge_weight", "coarse_edge_weight"),
    *("judging_edge_weight", "roofs_m", "pitched_lower_m", "own_roofs_m", "feet_m", "eaves_m"),
    *(
        "place_sigma_m",
        "lines_weight",
        "least_sharpness",
        "tilt_doubt_deg",
        "lens_doubt_percent",
        "doubt_nats",
    ),
)
_POSITIVE = (
    *("stride_m", "stride_z_m", "stride_yaw_deg", "coarse_spread_px", "fine_spread_px", "edge_blur_px"),
    "lens_percent",
)


@dataclass(frozen=True, slots=True)
class RegionParams(SearchRange):
    """The settings of ``method=region``; standard deviations of the map are of all buildings in common.

    Attributes:
        name: name to report.
        coarse_width: width of silhouettes in the search, pixels; their height follows from the photo's.
        fine_width: width of silhouettes where the best modes are refined, pixels.
        range_x_m: full width of the prior's range in x, metres; likewise y and z.
        range_y_m: see range_x_m.
        range_z_m: see range_x_m.
        range_yaw_deg: full width in yaw, degrees.
        range_tilt_deg: full width in pitch and in roll, degrees.
        beyond_m: how much farther than the range the grid extends to either side in x and in y, metres, but
            by half the range at most: ranges are often declared too narrow.
        beyond_yaw_deg: how much farther than the range the grid extends to either side in yaw, degrees.
        stride_m: largest distance between poses of the grid along x and y, metres.
        stride_z_m: largest distance between poses of the grid in height, metres.
        stride_yaw_deg: largest distance between poses of the grid in yaw, degrees.
        starts: number of poses of the grid to start from; more for ranges wider than the published priors'.
        modes: largest number of distinct modes that are refined.
        more_starts: by how much starts and modes are multiplied for the second search, which follows where
            the first answer's probability is below one half; 1 for no second search.
        coarse_generations: number of generations of each local search.
        fine_generations: number of generations of each refinement.
        population: number of poses in a generation, even.
        coarse_spread_px: how far apart the outlines of a local search's first generation lie, pixels of the
            coarse size.
        fine_spread_px: the same for a refinement, pixels of the fine size.
        effective_pixels: number of independent pixels that a photo is worth against the prior.
        edge_weight: weight of the photo's edges along the outline relative to its regions; 0 for none.
        coarse_edge_weight: the same weight in the search.
        judging_edge_weight: the same weight where modes are compared: a large silhouette splits a photo well
            in many wrong places, but no edges lie along it.
        edge_blur_px: standard deviation of the blur before edges are extracted, pixels of the fine size.
        roofs_m: standard deviation of the height of all roofs from the map's, metres; 0 for an exact map.
        pitched_lower_m: how much lower than in the map blocks are drawn whose source states a pitched roof,
            metres; not in the search for modes.
        own_roofs_m: standard deviation of each roof's height from that of all roofs, metres.
        feet_m: standard deviation of the height of all bases from the map's, metres: slopes, hedges and cars
            hide bases; 0 for a map whose bases are those that photos show.
        eaves_m: standard deviation of the overhang of all eaves beyond the map's, metres, if there is any,
            which has a probability of one half; 0 for a map of roof outlines.
        lens_percent: standard deviation of the focal length, percent.
        lens_doubt_percent: standard deviation of the focal length where the photo contradicts the declared
            one, percent; 0 never replaces that.
        tilt_doubt_deg: largest error of pitch and of roll where the photo contradicts the declared range,
            degrees; 0 never widens that, and neither does a range of 0.
        doubt_nats: by how many nats lines must be likelier under another tilt or lens than the declared one.
        mean_width: width of silhouettes for the posterior's mean without lines, pixels.
        place_sigma_m: least root of the summed posterior variances of x, y and z, metres, since errors of map
            and edges are correlated; 0 gives the best pose instead of the mean.
        lines_width: width of the photo to whose edges lines are compared, pixels.
        lines_weight: number of independent pixels that a pixel of line is worth; 0 leaves lines out.
        least_sharpness: least sharpness of edges on the lines, 0 to 1, for lines to be used: over a map that
            is not exact they would bias the pose.
        edges: whether roof edges refine the answer where they give the smaller variance of the position.
    """

    name: str = "region"
    coarse_width: int = 151
    fine_width: int = 301
    range_x_m: float = 20.0
    range_y_m: float = 20.0
    range_z_m: float = 60.0
    range_yaw_deg: float = 15.0
    range_tilt_deg: float = 2.0
    beyond_m: float = 10.0
    beyond_yaw_deg: float = 5.0
    stride_m: float = 5.0
    stride_z_m: float = 15.0
    stride_yaw_deg: float = 3.75
    starts: int = 10
    modes: int = 30
    more_starts: int = 12
    coarse_generations: int = 14
    fine_generations: int = 22
    population: int = 24
    coarse_spread_px: float = 4.0
    fine_spread_px: float = 2.5
    effective_pixels: float = 2000.0
    edge_weight: float = 8.0
    coarse_edge_weight: float = 4.0
    judging_edge_weight: float = 20.0
    edge_blur_px: float = 1.0
    roofs_m: float = 0.5
    pitched_lower_m: float = 1.0
    own_roofs_m: float = 0.7
    feet_m: float = 0.2
    eaves_m: float = 0.4
    lens_percent: float = 0.2
    lens_doubt_percent: float = 2.0
    tilt_doubt_deg: float = 5.0
    doubt_nats: float = 20.0
    mean_width: int = 640
    place_sigma_m: float = 0.8
    lines_width: int = 960
    lines_weight: float = 0.07
    least_sharpness: float = 0.3
    edges: bool = True

    def __post_init__(self) -> None:
        widths = ("coarse_width", "fine_width", "mean_width", "lines_width")
        require_numbers(self, "method", widths, 16, GUARD_PX)
        require_numbers(self, "method", (*_RANGES, *_AT_LEAST_0), 0)
        require_numbers(self, "method", _POSITIVE, 0, ends="(]")
        require_numbers(
            self, "method", ("starts", "modes", "more_starts", "coarse_generations", "fine_generations"), 1
        )
        if self.population < 8 or self.population % 2:
            raise ConfigError(f"method.population is even and at least 8, not {self.population}.")

    def grid(self) -> PoseGrid:
        """Returns the grid of the search: poses at most a stride apart, ends included.

        In height it ends where the prior's range does; for the rest see ``beyond_m``.
        """
        return PoseGrid(
            _axis(_widened(self.range_x_m, self.beyond_m), self.stride_m),
            _axis(_widened(self.range_y_m, self.beyond_m), self.stride_m),
            _axis(self.range_z_m, self.stride_z_m),
            self._yaw_axis(),
        )

    def num_starts(self) -> int:
        """Returns the number of poses of the grid that searches start from.

        It is ``starts``, times the cube root of the grid's size where that exceeds the published priors'.
        """
        usual = self.for_prior(UniformPrior())
        wider = max(1.0, len(self.grid()) / len(usual.grid()))
        return math.ceil(self.starts * math.cbrt(wider))

    def with_more_starts(self) -> RegionParams:
        """Returns the parameters of the second search."""
        return replace(self, starts=self.more_starts * self.starts, modes=self.more_starts * self.modes)

    def turns_around(self) -> bool:
        """Returns whether the grid covers all yaws."""
        return _widened(self.range_yaw_deg, self.beyond_yaw_deg) >= _CIRCLE_DEG

    def _yaw_axis(self) -> AxisRange:
        if not self.turns_around():
            return _axis(_widened(self.range_yaw_deg, self.beyond_yaw_deg), self.stride_yaw_deg)
        count = math.ceil(_CIRCLE_DEG / self.stride_yaw_deg)
        return AxisRange(_CIRCLE_DEG * (count - 1) / count, count)

    def prior_sigmas(self) -> tuple[float, ...]:
        """Returns the standard deviations of the prior's x, y, z, pitch, roll and yaw; see (R7).

        Those of the tilt are of its uniform range; of position and yaw, which the photo determines, they are
        the half widths, so that the prior is weak.
        """
        x, y, z, pitch, roll, yaw = self.half_widths()
        return x, y, z, pitch / math.sqrt(3.0), roll / math.sqrt(3.0), yaw

    def with_lens(self, percent: float | None) -> RegionParams:
        """Returns the parameters with a standard deviation of the focal length of at least this, percent."""
        return self if percent is None else replace(self, lens_percent=max(self.lens_percent, percent))


def _axis(width: float, stride: float) -> AxisRange:
    return AxisRange(width, math.ceil(width / stride - 1e-9) + 1)


def _widened(width: float, beyond: float) -> float:
    return width + min(2.0 * beyond, width)
