"""LoD-Loc v2: pose selection on a grid, then refinement by a particle filter (paper section 3).

Defaults are the paper's where it gives them (docs/methods/lodlocv2.md).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.inputs import Input
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import ConfigError, require_choice, require_numbers, require_within
from lodbench.geometry import AxisRange, Pose, PoseGrid, rotations_at_yaws
from lodbench.methods.fits import Particles, PoseScorer, Scoring, fit_input, nothing_fits, set_sizes
from lodbench.methods.protocol import Estimate, Streams
from lodbench.plugins import load_plugin

if TYPE_CHECKING:
    from lodbench.citymap import CityMap

VARIANTS = ("full", "no_refine", "no_select")


@dataclass(frozen=True, slots=True)
class LodLocV2Params:
    """The settings of ``method=lodlocv2``.

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

        Eq. (L2) of docs/methods/lodlocv2.md. An axis of one sample has no stride and stays as it is.
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


Floats = NDArray[np.float64]


class LodLocV2:
    """The paper's method. Pitch and roll stay the prior's throughout."""

    params_type = LodLocV2Params
    name = "lodlocv2"
    requires = frozenset({Input.MASK})

    def __init__(self, params: LodLocV2Params | None = None) -> None:
        self.params = params or LodLocV2Params()
        self.requires = frozenset({fit_input(self.params.fit)})

    def params_for_prior(self, prior: UniformPrior) -> LodLocV2Params:
        """Returns the parameters whose grid covers such a prior's error."""
        return self.params.for_prior(prior)

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the pose whose silhouette fits the query mask best.

        Raises:
            QueryFault: The mask is empty, the photo cannot be read, or no hypothesis fits.
        """

        def scorer_at(size: tuple[int, int]) -> Scoring:
            return PoseScorer(query, city_map, size, self.params.fit)

        estimate = search(scorer_at, query.prior, self.params, streams)
        if estimate.score <= 0:
            raise nothing_fits("no hypothesis fits the query")
        return estimate


def search(
    scorer_at: Callable[[tuple[int, int]], Scoring], prior: Pose, params: LodLocV2Params, streams: Streams
) -> Estimate:
    """Returns the best pose by grid and filter, whatever poses are scored by at a working size.

    All have the tilt of the prior.
    """
    started = time.perf_counter()
    best = Particles(prior.center[None], np.array([prior.euler.yaw_deg]), np.zeros(1))
    seconds: dict[str, float] = {}
    trace: dict[str, tuple[float, ...]] = {}
    if params.variant != "no_select":
        best = select(scorer_at(params.coarse_size), *params.grid().around(prior))
        trace["coarse"] = (float(best.scores[0]),)
        seconds["coarse"] = time.perf_counter() - started
    if params.variant != "no_refine":
        best, traces = refine(scorer_at(params.fine_size), best, params, streams)
        trace |= traces
        seconds["fine"] = time.perf_counter() - started - seconds.get("coarse", 0.0)
    rotation = rotations_at_yaws(*prior.euler[:2], best.yaws_deg)[0]
    pose = Pose.from_center(rotation, best.centers[0])
    return Estimate(pose, float(best.scores[0]), seconds=seconds, trace=trace)


def select(score: Scoring, centers: Floats, yaws_deg: Floats) -> Particles:
    """Returns the one best pose of a grid; ties go to the first (paper section 3.2).

    Eq. (L4) of docs/methods/lodlocv2.md.
    """
    scored = score(centers, yaws_deg)
    return _take(scored, np.array([int(np.argmax(scored.scores))]))


def refine(
    score: Scoring, start: Particles, params: LodLocV2Params, streams: Streams
) -> tuple[Particles, dict[str, tuple[float, ...]]]:
    """Returns the best pose after the filter's last step, and the best score after each step.

    Eq. (L7) of docs/methods/lodlocv2.md. The scores are those of all beams (``fine``) and of each (``fine
    beam 1`` and so on).

    Every beam starts from the same pose. In each step it keeps its best poses unchanged, so that its score
    never falls, and adds moved copies of each; beams never mix (paper section 3.3).
    """
    first = score(start.centers, start.yaws_deg)
    beams = [_take(first, np.zeros(params.kept, dtype=np.int64)) for _ in range(params.beams)]
    traces: list[list[float]] = [[] for _ in beams]
    for step in range(params.steps):
        children = score(*_moved(beams, params, params.scale(step), streams("fine", step)))
        per_beam = len(children.scores) // params.beams
        for b, kept in enumerate(beams):
            mine = _take(children, np.arange(b * per_beam, (b + 1) * per_beam))
            beams[b] = _best(kept, mine, params.kept)
            traces[b].append(float(beams[b].scores[0]))
    winner = int(np.argmax([beam.scores[0] for beam in beams]))
    named = {f"fine beam {b}": tuple(scores) for b, scores in enumerate(traces, start=1)}
    best_of_all = tuple(max(scores) for scores in zip(*traces, strict=True))
    return _take(beams[winner], np.zeros(1, dtype=np.int64)), {"fine": best_of_all, **named}


def _moved(
    beams: list[Particles], params: LodLocV2Params, scale: float, generator: np.random.Generator
) -> tuple[Floats, Floats]:
    """Returns moved copies of every beam's kept poses: centres (N, 3) and yaws (N,), beam by beam.

    Eq. (L5) of docs/methods/lodlocv2.md.
    """
    copies = params.children_per_parent
    centers = np.concatenate([np.repeat(beam.centers, copies, axis=0) for beam in beams])
    yaws = np.concatenate([np.repeat(beam.yaws_deg, copies) for beam in beams])
    turns = generator.uniform(-1.0, 1.0, len(yaws)) * (params.spread_yaw_deg * scale)
    moves = generator.standard_normal((len(yaws), 3)) * (params.sigma_m * scale)
    return centers + moves, yaws + turns


def _take(particles: Particles, indices: NDArray[np.int64]) -> Particles:
    return Particles(*(values[indices] for values in particles))


def _best(kept: Particles, moved: Particles, count: int) -> Particles:
    particles = Particles(*(np.concatenate(pair) for pair in zip(kept, moved, strict=True)))
    # A stable sort: of equal scores the earlier pose stays ahead, kept ones before their copies.
    return _take(particles, np.argsort(-particles.scores, kind="stable")[:count])
