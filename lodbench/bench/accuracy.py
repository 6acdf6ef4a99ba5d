"""How well a method finds poses over a real model: synthetic views, masks as wrong as a network's.

Seeded drone views are drawn over a city. The mask of each is rendered at the true pose at the
working size (602 x 448) and degraded to a target IoU; its prior is drawn uniformly around the
truth. Every method runs every view twice: with the true tilt in the prior, and with a tilt in error.
Masks may come from another level of detail than the map that is searched.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.bench.accuracy_options import AccuracyOptions
from lodbench.bench.accuracy_report import TILTS, AccuracyReport, Outcome
from lodbench.bench.figures import Progress, no_progress
from lodbench.citymap import CityMap
from lodbench.citymodel import Scene, open_scene
from lodbench.citymodel.lods import lod_in_words
from lodbench.datasets.priors import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.evaluation import pose_error
from lodbench.evaluation.errors import FAILED
from lodbench.geometry import Pose
from lodbench.methods import Method
from lodbench.methods.asking import localize_query
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.methods.protocol import SupportsPriorWidth
from lodbench.rendering import Scorer
from lodbench.storage import random_stream
from lodbench.synthesis.queries import SyntheticQuery
from lodbench.synthesis.view_sampling import RGB_CAMERA
from lodbench.synthesis.views_dataset import draw_queries


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


def open_scenes(city: Path, options: AccuracyOptions) -> tuple[CityMap, CityMap]:
    """Returns the renderer of the map that is searched, and that of the city that masks are drawn from."""
    scorer = CityMap(open_scene(city, lod=options.map_lod), threads=options.threads)
    if options.mask_lod is None or options.mask_lod == options.map_lod:
        return scorer, scorer
    return scorer, CityMap(open_scene(city, lod=options.mask_lod), threads=options.threads)


def reaching(method: Method, prior: UniformPrior) -> Method:
    """Returns a method told how far off priors may be, if it is one that can be."""
    if not isinstance(method, SupportsPriorWidth):
        return method
    made: Method = type(method)(method.params_for_prior(prior))  # type: ignore[call-arg]
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


def run_case(case: Case, tilt: str, method: Method, city_map: CityMap, seed: int) -> Outcome:
    """Returns what a method makes of a case; a fault of the query is a failure, not an error."""
    query = case.query_with_tilt(tilt)
    started = time.perf_counter()
    error, score, hypotheses, probability = FAILED, 0.0, 0, None
    try:
        # The streams know nothing of the tilt: both blocks try the same moves.
        estimate = localize_query(method, query, city_map, streams_of(seed, query.name))
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
