"""How well a method finds poses over a real model: synthetic views, masks as wrong as a network's.

Seeded drone views are drawn over a city. The mask of each is rendered at the true pose at the
working size (602 x 448) and roughened to a target IoU; its prior is drawn uniformly around the
truth. Every method runs every view twice: with the true tilt in the prior, and with a tilt in error.
Masks may come from another level of detail than the map that is searched.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.bench.accuracy_report import TILTS, AccuracyReport, Outcome
from lodbench.bench.figures import Progress, no_progress
from lodbench.citymodel import Scene, open_scene
from lodbench.citymodel.lods import lod_in_words
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
from lodbench.localization.method import Reaching
from lodbench.rendering import Scorer, make_renderer
from lodbench.storage import random_stream

# The halves of a city's bounding box: tune on one, report on the other.
AREAS = ("west", "east", "south", "north")


@dataclass(frozen=True, slots=True)
class AccuracyOptions:
    """What to measure.

    Attributes:
        num_views: Views over the city.
        mask_iou: IoU of each query mask with the silhouette at the truth.
        tilt_deg: Half width of the prior's error in pitch and in roll, degrees, where tilt=prior.
        range_m: Half width of the prior's error along x, y and z, metres; None for the published ones.
        height_m: The same along z alone; None for ``range_m``.
        seeds: Seeds of views, masks, priors and methods; each draws ``num_views`` views of its own.
        mask_lod: Level of detail that views and masks are drawn from; None for ``map_lod``.
        map_lod: Level of detail that is searched; None for the lowest there is.
        area: The half of the city that views look at the middle of, one of ``AREAS``; None for all of it.
        threads: Threads of the engine; None for one per core. Results do not depend on it.
    """

    num_views: int = 200
    mask_iou: float = 0.88
    tilt_deg: float = 1.0
    range_m: float | None = None
    height_m: float | None = None
    seeds: tuple[int, ...] = (0,)
    mask_lod: str | None = None
    map_lod: str | None = None
    area: str | None = None
    threads: int | None = None

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ConfigError(f"seeds are one or more different numbers, not {list(self.seeds)}.")
        if self.num_views < 1:
            raise ConfigError(f"num_views is at least 1, not {self.num_views}.")
        if not 0 < self.mask_iou <= 1:
            raise ConfigError(f"mask_iou lies in (0, 1], not {self.mask_iou}.")
        if not 0 <= self.tilt_deg <= 30:
            raise ConfigError(f"tilt_deg lies within 0 and 30, not {self.tilt_deg}.")
        if self.area is not None and self.area not in AREAS:
            raise ConfigError(f"area is one of {', '.join(AREAS)}, not {self.area}.")

    def prior(self, tilt: str = "prior") -> UniformPrior:
        """Returns the errors of the priors: the published ones, with this tilt and range.

        Args:
            tilt: ``truth`` for priors whose tilt has no error.
        """
        tilt_deg = self.tilt_deg if tilt == "prior" else 0.0
        prior = UniformPrior(pitch_deg=tilt_deg, roll_deg=tilt_deg)
        if self.range_m is not None:
            prior = replace(prior, x_m=self.range_m, y_m=self.range_m, z_m=self.range_m)
        return prior if self.height_m is None else replace(prior, z_m=self.height_m)

    def area_m(self, scene: Scene) -> tuple[float, float, float, float] | None:
        """Returns the bounds (west, south, east, north) of the area in a scene, metres; None for all."""
        if self.area is None:
            return None
        (west, south), (east, north) = scene.vertices[:, :2].min(axis=0), scene.vertices[:, :2].max(axis=0)
        x, y = 0.5 * (float(west) + float(east)), 0.5 * (float(south) + float(north))
        halves = {
            "west": (west, south, x, north),
            "east": (x, south, east, north),
            "south": (west, south, east, y),
            "north": (west, y, east, north),
        }
        w, s, e, n = halves[self.area]
        return float(w), float(s), float(e), float(n)

    def protocol(self) -> str:
        """Returns in words what is drawn."""
        prior, (width, height) = self.prior(), FINE_SIZE
        return (
            f"masks of {width} x {height} roughened to IoU {self.mask_iou:g}, priors +-{prior.x_m:g}/"
            f"+-{prior.y_m:g}/+-{prior.z_m:g} m and +-{prior.yaw_deg:g} deg yaw, with tilt=prior "
            f"+-{self.tilt_deg:g} deg pitch and roll, {_seeds_in_words(self.seeds)}"
            + (f", {self.area}ern half of the city" if self.area else "")
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

    def shifted(self, offset_m: NDArray[np.float64]) -> Case:
        """Returns the case in a frame whose origin lies elsewhere, (3,) metres."""
        q = self.query
        query = Query(q.name, q.split, q.camera, q.prior.shifted(offset_m), q.building_probability)
        return Case(query, self.truth.shifted(offset_m), self.achieved_iou)


def measure_accuracy(
    city: Path,
    options: AccuracyOptions | None = None,
    progress: Progress = no_progress,
    methods: Sequence[Method] = (),
) -> AccuracyReport:
    """Returns how well methods find seeded views over a city.

    A method that can is told how far off the priors may be, tilt included (0 with the true one); never
    whether they are.

    Args:
        city: City model file.
        options: What to measure.
        progress: Called after each view, tilt and method.
        methods: Which methods; LoD-Loc v2 if empty.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    options = options or AccuracyOptions()
    scorer, seen = open_scenes(city, options)
    scene = scorer.scene
    told = {
        tilt: [reaching(method, options.prior(tilt)) for method in methods or (LodLocV2(),)] for tilt in TILTS
    }
    outcomes: list[Outcome] = []
    rejections = 0
    for seed in options.seeds:
        cases, rejected = make_cases(seen.scene, seen, options, seed)
        cases = [case.shifted(seen.scene.origin - scene.origin) for case in cases]
        rejections += rejected
        for number, tilt, case in product(range(len(told["prior"])), TILTS, cases):
            outcomes.append(run_case(case, tilt, told[tilt][number], scorer, seed))
            progress(len(outcomes), len(options.seeds) * len(told["prior"]) * len(TILTS) * len(cases))
    name = Path(city).name
    if options.mask_lod is not None or options.map_lod is not None:
        name += f" (masks {lod_in_words(seen.scene.lod)}, map {lod_in_words(scene.lod)})"
    names = tuple(method.name for method in told["prior"])
    return AccuracyReport(name, names, options.protocol(), rejections, tuple(outcomes))


def open_scenes(city: Path, options: AccuracyOptions) -> tuple[Scorer, Scorer]:
    """Returns the renderer of the map that is searched, and that of the city that masks are drawn from."""
    scorer = make_renderer("silhouette", open_scene(city, lod=options.map_lod), options.threads)
    if options.mask_lod is None or options.mask_lod == options.map_lod:
        return scorer, scorer
    return scorer, make_renderer("silhouette", open_scene(city, lod=options.mask_lod), options.threads)


def reaching(method: Method, prior: UniformPrior) -> Method:
    """Returns a method told how far off priors may be, if it is one that can be."""
    if not isinstance(method, Reaching):
        return method
    made: Method = type(method)(method.reaching(prior))  # type: ignore[call-arg]
    return made


def make_cases(
    scene: Scene, scorer: Scorer, options: AccuracyOptions, seed: int | None = None
) -> tuple[list[Case], int]:
    """Returns the cases of a city and how many draws of views were rejected.

    Case i depends on the seed and i only: asking for more views keeps the first ones.

    Args:
        scene: What masks are drawn from.
        scorer: Renders it.
        options: What to draw.
        seed: Which; the first of the options' if None.
    """
    seed = options.seeds[0] if seed is None else seed
    drawn, rejections = draw_queries(
        scene, scorer, options.num_views, options.mask_iou, options.prior(), seed, options.area_m(scene)
    )
    return [_case(query) for query in drawn], rejections


def seeded_cases(scorer: Scorer, seen: Scorer, options: AccuracyOptions) -> list[tuple[int, Case]]:
    """Returns the cases of all seeds, each with its seed, in the frame of the map that is searched."""
    return [
        (seed, case.shifted(seen.scene.origin - scorer.scene.origin))
        for seed in options.seeds
        for case in make_cases(seen.scene, seen, options, seed)[0]
    ]


def run_case(case: Case, tilt: str, method: Method, scorer: Scorer, seed: int) -> Outcome:
    """Returns what a method makes of a case; a fault of the query is a failure, not an error."""
    query = case.query_with_tilt(tilt)
    started = time.perf_counter()
    error, score, hypotheses, probability = FAILED, 0.0, 0, None
    try:
        # The streams know nothing of the tilt: both blocks try the same moves.
        estimate = method.localize(query, scorer, streams_of(seed, query.name))
        error = pose_error(estimate.pose, case.truth)
        score, hypotheses, probability = estimate.score, estimate.hypotheses, estimate.probability
    except QueryFault:
        pass
    return Outcome(
        name=query.name,
        tilt=tilt,
        error=error,
        prior_error=pose_error(query.prior, case.truth),
        score=score,
        truth_score=case.achieved_iou,
        hypotheses=hypotheses,
        seconds=time.perf_counter() - started,
        method=method.name,
        seed=seed,
        probability=probability,
    )


def streams_of(seed: int, name: str) -> Callable[[str, int], np.random.Generator]:
    """Returns the random numbers of a view's search."""
    return partial(random_stream, seed, "accuracy", name)


def _case(drawn: SyntheticQuery) -> Case:
    probability = drawn.mask.astype(np.float32)
    query = Query(drawn.name, "all", RGB_CAMERA, drawn.prior, probability)
    return Case(query, drawn.truth, drawn.achieved_iou)


def _seeds_in_words(seeds: tuple[int, ...]) -> str:
    return f"seed {seeds[0]}" if len(seeds) == 1 else "seeds " + ", ".join(str(seed) for seed in seeds)
