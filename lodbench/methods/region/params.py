"""Parameters of region-based localisation; docs/methods/region.md says where the defaults come from."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import ConfigError, require_numbers
from lodbench.geometry import AxisRange, PoseGrid
from lodbench.kernels.raster_rule import GUARD_PX
from lodbench.methods.search import SearchRange

_CIRCLE_DEG = 360.0
_RANGES = ("range_x_m", "range_y_m", "range_z_m", "range_yaw_deg", "range_tilt_deg")
_AT_LEAST_0 = (
    *("beyond_m", "beyond_yaw_deg", "effective_pixels", "edge_weight", "coarse_edge_weight"),
    *(
        "judging_edge_weight",
        "roofs_m",
        "pitched_lower_m",
        "own_roofs_m",
        "feet_m",
        "eaves_m",
        "place_sigma_m",
        "lines_weight",
    ),
    *("least_sharpness", "tilt_doubt_deg", "lens_doubt_percent", "doubt_nats"),
)
_POSITIVE = (
    *("stride_m", "stride_z_m", "stride_yaw_deg", "coarse_spread_px", "fine_spread_px", "edge_blur_px"),
    "lens_percent",
)


@dataclass(frozen=True, slots=True)
class RegionParams(SearchRange):
    """The settings of ``method=region``.

    Attributes:
        name: Name to report.
        coarse_width: Width of silhouettes in the search, pixels; their height follows from the photo's.
        fine_width: Width of silhouettes where the best modes are refined, pixels.
        range_x_m: Full width of the prior's error in x, metres; likewise y and z.
        range_y_m: See range_x_m.
        range_z_m: See range_x_m.
        range_yaw_deg: Full width in yaw, degrees.
        range_tilt_deg: Full width in pitch and in roll, degrees.
        beyond_m: How much farther than the prior's error the search looks to either side in x and in y,
            metres, but never more than half the range: priors are often declared narrower than they are.
        beyond_yaw_deg: How much farther than the prior's error the search looks in yaw, degrees.
        stride_m: Largest distance between samples of the grid along x and y, metres.
        stride_z_m: Largest distance between samples of the grid in height, metres.
        stride_yaw_deg: Largest distance between samples of the grid in yaw, degrees.
        starts: Distinct samples of the grid to start from, for a grid of the published priors' range;
            more for wider ones.
        modes: Distinct modes of those that are refined.
        more_starts: How many times as many a second search begins from, where the first one's answer is not
            to be trusted; 1 for no second one.
        coarse_generations: Generations of each search.
        fine_generations: Generations of each refinement.
        population: Poses in a generation, even.
        coarse_spread_px: How far outlines lie apart in the first generation, pixels of the coarse size.
        fine_spread_px: How far outlines lie apart in the first generation of a refinement, pixels of the fine
            size.
        effective_pixels: How many independent pixels a photo is worth against the prior.
        edge_weight: Weight of the photo's edges along the outline beside its regions; 0 leaves them out.
        coarse_edge_weight: Weight of the photo's edges in the search.
        judging_edge_weight: Weight of the photo's edges where one mode is chosen: one large silhouette
            parts a photo well in many wrong places, but no edges lie along it.
        edge_blur_px: Blur of the photo before edges are looked for, pixels of the fine size.
        roofs_m: How far all roofs may be higher or lower than in the map, all alike: a standard deviation,
            metres; 0 for a map whose roofs do not err.
        pitched_lower_m: How much lower than in the map the roofs of blocks are beforehand where its source
            states that they are pitched, metres. The search for the best poses takes the map as it is.
        own_roofs_m: How far each roof may be higher or lower by itself, as of ``roofs_m``.
        feet_m: How much higher or lower than in the map all walls may end, all alike, at slopes, hedges or
            cars: a standard deviation, metres; 0 for a map whose walls end where photos show them to.
        eaves_m: How much farther or less far than in the map all eaves may stand out, all alike, if they do
            at all, which is as likely as not: a standard deviation, metres; 0 for a map of roof outlines.
        lens_percent: Standard deviation of the focal length, percent.
        lens_doubt_percent: Standard deviation of the focal length where the photo speaks against the one that
            is declared, percent; 0 believes that anyway.
        tilt_doubt_deg: How far pitch and roll may be off where the photo speaks against the range that is
            declared, degrees; 0 believes that anyway, and so does a range of 0.
        doubt_nats: By how many nats lines must be likelier with another tilt or lens for it to be believed.
        mean_width: Width of silhouettes where the answer becomes the mean of the posterior, pixels.
        place_sigma_m: How wide the posterior leaves the place there at least, a standard deviation, metres:
            so far maps and edges err together; 0 leaves the answer at the best pose.
        lines_width: Width of the photo where the model's lines are laid over its edges, pixels.
        lines_weight: What a pixel of line is worth, independent pixels; 0 leaves lines out.
        least_sharpness: How sharply edges must fall off beside the lines for lines to count, 0 to 1: where a
            map is far from what the photo shows they lead astray.
        edges: Whether the edges of roofs refine the answer where they are surer of the place.
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
        """Returns the grid of the search: samples at most a stride apart, ends included.

        In height it ends where the prior does; see ``beyond_m`` for the rest.
        """
        return PoseGrid(
            _axis(_widened(self.range_x_m, self.beyond_m), self.stride_m),
            _axis(_widened(self.range_y_m, self.beyond_m), self.stride_m),
            _axis(self.range_z_m, self.stride_z_m),
            self._yaw_axis(),
        )

    def num_starts(self) -> int:
        """Returns how many samples of the grid searches start from: more modes lie in a wider one.

        As many as set for the published priors' range and less, and by the cube root of its size more for
        a wider grid.
        """
        usual = self.for_prior(UniformPrior())
        wider = max(1.0, len(self.grid()) / len(usual.grid()))
        return math.ceil(self.starts * math.cbrt(wider))

    def with_more_starts(self) -> RegionParams:
        """Returns the parameters of the second search."""
        return replace(self, starts=self.more_starts * self.starts, modes=self.more_starts * self.modes)

    def turns_around(self) -> bool:
        """Returns whether the search looks in all directions."""
        return _widened(self.range_yaw_deg, self.beyond_yaw_deg) >= _CIRCLE_DEG

    def _yaw_axis(self) -> AxisRange:
        if not self.turns_around():
            return _axis(_widened(self.range_yaw_deg, self.beyond_yaw_deg), self.stride_yaw_deg)
        count = math.ceil(_CIRCLE_DEG / self.stride_yaw_deg)
        return AxisRange(_CIRCLE_DEG * (count - 1) / count, count)

    def prior_sigmas(self) -> tuple[float, ...]:
        """Returns the standard deviations of the prior's x, y, z, pitch, roll and yaw.

        The tilt has that of its uniform range; for place and yaw, which the photo says, a weak hold will do:
        the half width.
        """
        x, y, z, pitch, roll, yaw = self.half_widths()
        return x, y, z, pitch / math.sqrt(3.0), roll / math.sqrt(3.0), yaw

    def with_lens(self, percent: float | None) -> RegionParams:
        """Returns these parameters for a lens that is known no better than so, percent, where declared."""
        return self if percent is None else replace(self, lens_percent=max(self.lens_percent, percent))


def _axis(width: float, stride: float) -> AxisRange:
    return AxisRange(width, math.ceil(width / stride - 1e-9) + 1)


def _widened(width: float, beyond: float) -> float:
    return width + min(2.0 * beyond, width)
