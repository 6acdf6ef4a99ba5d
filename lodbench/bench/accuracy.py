"""How well a method finds poses over a real model: synthetic views, masks as wrong as a network's.

Seeded drone views are drawn over a city. The mask of each is rendered at the true pose at the
working size (602 x 448) and roughened to a target IoU; its prior is drawn uniformly around the
truth. Every view is run twice: with the true tilt in the prior, and with a tilt in error.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lodbench.bench.accuracy_report import TILTS, AccuracyReport, Outcome
from lodbench.bench.figures import Progress, no_progress
from lodbench.citymodel import Scene, open_scene
from lodbench.datasets.priors import UniformPrior
from lodbench.datasets.query import Query
from lodbench.datasets.synthetic import SyntheticQuery, draw_queries
from lodbench.datasets.views import FINE_SIZE, RGB_CAMERA
from lodbench.errors import ConfigError, QueryFault
from lodbench.evaluation import pose_error
from lodbench.evaluation.errors import FAILED
from lodbench.geometry import Pose
from lodbench.localization import Method
from lodbench.localization.lodlocv2 import LodLocV2
from lodbench.rendering import Scorer, make_renderer
from lodbench.storage import random_stream


@dataclass(frozen=True, slots=True)
class AccuracyOptions:
    """What to measure.

    Attributes:
        num_views: Views over the city.
        mask_iou: IoU of each query mask with the silhouette at the truth.
        tilt_deg: Half width of the prior's error in pitch and in roll, degrees, where tilt=prior.
        seed: Seed of views, masks, priors and methods.
        threads: Threads of the engine; None for one per core. Results do not depend on it.
    """

    num_views: int = 200
    mask_iou: float = 0.88
    tilt_deg: float = 1.0
    seed: int = 0
    threads: int | None = None

    def __post_init__(self) -> None:
        if self.num_views < 1:
            raise ConfigError(f"num_views is at least 1, not {self.num_views}.")
        if not 0 < self.mask_iou <= 1:
            raise ConfigError(f"mask_iou lies in (0, 1], not {self.mask_iou}.")
        if not 0 <= self.tilt_deg <= 30:
            raise ConfigError(f"tilt_deg lies within 0 and 30, not {self.tilt_deg}.")

    def prior(self) -> UniformPrior:
        """Returns the errors of the priors: the paper's, with this tilt."""
        return UniformPrior(pitch_deg=self.tilt_deg, roll_deg=self.tilt_deg)

    def protocol(self) -> str:
        """Returns in words what is drawn."""
        prior, (width, height) = self.prior(), FINE_SIZE
        return (
            f"masks of {width} x {height} roughened to IoU {self.mask_iou:g}, priors +-{prior.x_m:g}/"
            f"+-{prior.y_m:g}/+-{prior.z_m:g} m and +-{prior.yaw_deg:g} deg yaw, with tilt=prior "
            f"+-{self.tilt_deg:g} deg pitch and roll, seed {self.seed}"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One view to be found: what the method sees, and what only the evaluator may see.

    Attributes:
        query: The query; its prior has a tilt in error.
        truth: The true pose.
        achieved_iou: IoU of the mask with the silhouette at the truth.
    """

    query: Query
    truth: Pose
    achieved_iou: float

    def query_with_tilt(self, tilt: str) -> Query:
        """Returns the query with the tilt of its prior as drawn (``prior``) or true (``truth``)."""
        q = self.query
        prior = q.prior.with_tilt_of(self.truth) if tilt == "truth" else q.prior
        return Query(q.name, q.split, q.camera, prior, q.building_probability)


def measure_accuracy(
    city: Path, options: AccuracyOptions | None = None, progress: Progress = no_progress
) -> AccuracyReport:
    """Returns how well LoD-Loc v2 finds seeded views over a city.

    Args:
        city: City model file.
        options: What to measure.
        progress: Called after each view and tilt.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    options = options or AccuracyOptions()
    scene = open_scene(city)
    scorer = make_renderer("silhouette", scene, options.threads)
    method = LodLocV2()
    cases, rejections = make_cases(scene, scorer, options)
    outcomes = []
    for tilt in TILTS:
        for case in cases:
            outcomes.append(run_case(case, tilt, method, scorer, options.seed))
            progress(len(outcomes), len(cases) * len(TILTS))
    return AccuracyReport(Path(city).name, method.name, options.protocol(), rejections, tuple(outcomes))


def make_cases(scene: Scene, scorer: Scorer, options: AccuracyOptions) -> tuple[list[Case], int]:
    """Returns the cases of a city and how many draws of views were rejected.

    Case i depends on the seed and i only: asking for more views keeps the first ones.
    """
    drawn, rejections = draw_queries(
        scene, scorer, options.num_views, options.mask_iou, options.prior(), options.seed
    )
    return [_case(query) for query in drawn], rejections


def run_case(case: Case, tilt: str, method: Method, scorer: Scorer, seed: int) -> Outcome:
    """Returns what a method makes of a case; a fault of the query is a failure, not an error."""
    query = case.query_with_tilt(tilt)
    started = time.perf_counter()
    error, score, hypotheses = FAILED, 0.0, 0
    try:
        # The streams know nothing of the tilt: both blocks try the same moves.
        estimate = method.localize(query, scorer, _streams(seed, query.name))
        error = pose_error(estimate.pose, case.truth)
        score, hypotheses = estimate.score, estimate.hypotheses
    except QueryFault:
        pass
    seconds = time.perf_counter() - started
    prior_error = pose_error(query.prior, case.truth)
    return Outcome(query.name, tilt, error, prior_error, score, case.achieved_iou, hypotheses, seconds)


def _case(drawn: SyntheticQuery) -> Case:
    probability = drawn.mask.astype(np.float32)
    query = Query(drawn.name, "all", RGB_CAMERA, drawn.prior, probability)
    return Case(query, drawn.truth, drawn.achieved_iou)


def _streams(seed: int, name: str) -> Callable[[str, int], np.random.Generator]:
    return partial(random_stream, seed, "accuracy", name)
