"""How well a method finds poses over a real model: synthetic views, masks as wrong as a network's.

Seeded drone views are drawn over a city, as ``dataset=views`` draws them: the mask of each is rendered at
the true pose at the working size (602 x 448) and degraded to a target IoU, its prior is uniform around the
truth. Every method runs every view twice, with the true tilt in the prior and with a tilt in error, through
the same prediction and evaluation as `lodbench run`. Masks may come from another level of detail than the
map that is searched.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lodbench.bench.accuracy_options import AccuracyOptions
from lodbench.bench.accuracy_report import SPLIT, TILTS, AccuracyReport
from lodbench.bench.figures import Progress, no_progress
from lodbench.citymap import CityMap
from lodbench.citymodel import open_scene
from lodbench.citymodel.lods import lod_in_words
from lodbench.datasets.priors import UniformPrior
from lodbench.datasets.query import Dataset, Entry
from lodbench.evaluation.evaluate import evaluate
from lodbench.evaluation.predictions import Prediction
from lodbench.execution.executor import ExecutorParams
from lodbench.harness.runs.predict import Work, predict
from lodbench.harness.runs.prepare import Preparation
from lodbench.harness.runs.requirements import segmented_inputs
from lodbench.methods import Method
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.methods.protocol import Streams, SupportsPriorWidth
from lodbench.storage import random_stream
from lodbench.synthesis.queries import SyntheticQuery
from lodbench.synthesis.view_sampling import RGB_CAMERA
from lodbench.synthesis.views_dataset import draw_queries

if TYPE_CHECKING:
    import pandas as pd


@dataclass(slots=True, eq=False)
class DrawnMasks:
    """Segmenter of views: the masks that were drawn with them, by ``Entry.key``."""

    masks: dict[str, NDArray[np.bool_]]
    name: str = "views"
    requires: tuple[str, ...] = ()
    provides: tuple[str, ...] = ("mask",)

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Returns the (448, 602) mask of a view."""
        return self.masks[entry.key].astype(np.float32)

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns "": nothing of a bench is stored."""
        return ""


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Seeded views of a city.

    Attributes:
        seed: Which draw.
        dataset: The views, in the local frame of the map that is searched.
        segmenter: Their masks.
        rejections: Draws thrown away.
    """

    seed: int
    dataset: Dataset
    segmenter: DrawnMasks
    rejections: int

    def find(
        self, method: Method, tilt: str, city_map: CityMap, progress: Progress = no_progress
    ) -> tuple[pd.DataFrame, dict[str, Prediction]]:
        """Returns what a method makes of the views: the evaluated queries, and the predictions."""
        entries = self.dataset.entries
        needs = segmented_inputs(method)
        preparation = Preparation(self.dataset, city_map.scene, self.segmenter, tilt, needs, city_map)
        with tempfile.TemporaryDirectory() as scratch:
            work = _ViewsWork(
                method=method,
                dataset=self.dataset,
                segmenter=self.segmenter,
                renderer="silhouette",
                threads=None,
                tilt=tilt,
                needs=needs,
                seed=self.seed,
                params=None,
                inputs={},
                folder=Path(scratch),
                progress=progress,
            )
            predictions = predict(work, preparation, city_map, entries, ExecutorParams())
        priors = {entry.key: preparation.prior(entry) for entry in entries}
        queries = evaluate(entries, predictions, self.dataset.truth, priors, city_map, tilt)
        seconds = [sum(predictions[key].seconds.values()) for key in queries.index]
        return queries.assign(method=method.name, seed=self.seed, seconds=seconds), predictions


@dataclass(frozen=True, slots=True, eq=False)
class _ViewsWork(Work):
    """As in a run, but for the streams, which know nothing of the tilt: both blocks try the same moves."""

    progress: Progress = no_progress
    done: list[Entry] = field(default_factory=list)

    def streams_of(self, entry: Entry) -> Streams:
        return partial(random_stream, self.seed, "accuracy", entry.name)

    def answers(
        self, preparation: Preparation, city_map: CityMap, entries: Sequence[Entry]
    ) -> list[tuple[str, dict[str, Any]]]:
        # Not super(): a dataclass with slots is another class than the one named here.
        found = Work.answers(self, preparation, city_map, entries)
        for entry in entries:
            self.done.append(entry)
            self.progress(len(self.done), len(self.dataset.entries))
        return found


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
    import pandas as pd

    options = options or AccuracyOptions()
    scorer, seen = open_scenes(city, options)
    drawn = [draw_views(scorer, seen, options, seed) for seed in options.seeds]
    methods = methods or (LodLocV2(),)
    jobs = list(product(drawn, methods, TILTS))
    tables = []
    for number, (views, method, tilt) in enumerate(jobs):
        told = told_width(method, options.prior(tilt))
        tables.append(views.find(told, tilt, scorer, part_of(progress, number, len(jobs)))[0])
    name = Path(city).name
    if options.mask_lod is not None or options.map_lod is not None:
        name += f" (masks {lod_in_words(seen.scene.lod)}, map {lod_in_words(scorer.scene.lod)})"
    names = tuple(method.name for method in methods)
    return AccuracyReport(
        name, names, options.protocol(), sum(views.rejections for views in drawn), pd.concat(tables)
    )


def open_scenes(city: Path, options: AccuracyOptions) -> tuple[CityMap, CityMap]:
    """Returns the renderer of the map that is searched, and that of the city that masks are drawn from.

    Their origins count from the map's: coordinates of a whole country would cost digits.
    """
    searched = open_scene(city, lod=options.map_lod)
    scorer = CityMap(replace(searched, origin=np.zeros(3)), threads=options.threads)
    if options.mask_lod is None or options.mask_lod == options.map_lod:
        return scorer, scorer
    seen = open_scene(city, lod=options.mask_lod)
    moved = replace(seen, origin=seen.origin - searched.origin)
    return scorer, CityMap(moved, threads=options.threads)


def told_width(method: Method, prior: UniformPrior) -> Method:
    """Returns a method told how far off priors may be, if it is one that can be."""
    if not isinstance(method, SupportsPriorWidth):
        return method
    made: Method = type(method)(method.params_for_prior(prior))  # type: ignore[call-arg]
    return made


def draw_views(city_map: CityMap, seen: CityMap, options: AccuracyOptions, seed: int) -> Views:
    """Returns the views of a city; view i depends on the seed and i only.

    Args:
        city_map: The map that is searched.
        seen: Renders what masks are drawn from.
        options: What to draw.
        seed: Which draw.
    """
    drawn, rejections = draw_queries(
        seen.scene,
        seen,
        options.num_views,
        options.mask_iou,
        options.prior(),
        seed,
        options.area_m(seen.scene),
    )
    entries = tuple(_entry(query, seen.scene.origin) for query in drawn)
    truth = {entry.key: q.truth.shifted(seen.scene.origin) for entry, q in zip(entries, drawn, strict=True)}
    masks = {entry.key: query.mask for entry, query in zip(entries, drawn, strict=True)}
    dataset = Dataset("views", "", Path(), None, None, (SPLIT,), entries, truth)
    return Views(seed, dataset, DrawnMasks(masks), rejections)


def part_of(progress: Progress, number: int, parts: int) -> Progress:
    """Returns the progress of one of several parts of equal length."""
    return lambda done, total: progress(number * total + done, parts * total)


def _entry(drawn: SyntheticQuery, origin: NDArray[np.float64]) -> Entry:
    return Entry(drawn.name, SPLIT, RGB_CAMERA, drawn.prior.shifted(origin), None, None)
