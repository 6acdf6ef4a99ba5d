"""`lodbench bench real`: posed photos, priors drawn anew around their truth, and where methods end."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from lodbench.bench.figures import Progress, Report, no_progress
from lodbench.bench.real_report import report_real
from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.datasets.priors import UniformPrior
from lodbench.datasets.query import Dataset, Query
from lodbench.errors import ConfigError, DatasetError, QueryFault
from lodbench.evaluation import pose_error
from lodbench.evaluation.errors import FAILED
from lodbench.evaluation.queries import ERROR, PRIOR_ERROR
from lodbench.geometry import Pose
from lodbench.harness.runs.prepare import Preparation
from lodbench.harness.runs.requirements import segmented_inputs
from lodbench.methods import Method
from lodbench.methods.measured_calls import localize_query
from lodbench.methods.protocol import Streams
from lodbench.rendering.silhouette import SilhouetteRenderer
from lodbench.reporting.overlays import OverlayInput, draw_overlay, png_bytes
from lodbench.segmentation import Segmenter
from lodbench.storage import random_stream


@dataclass(frozen=True, slots=True)
class RealOptions:
    """What to measure."""

    priors: int = 20
    prior: UniformPrior = UniformPrior()  # noqa: RUF009 - frozen
    is_published_too: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if self.priors < 1:
            raise ConfigError(f"--priors {self.priors} is not a number of priors.")


def measure_real(
    dataset: Dataset,
    scene: Scene,
    segmenter: Segmenter,
    methods: Sequence[Method],
    options: RealOptions,
    progress: Progress = no_progress,
) -> Report:
    """Returns where methods end from redrawn priors of photos whose pose is known.

    All methods start from the same priors. The truth draws them and scores the answers; no method sees it.
    ``data`` has the columns of ``report_real``; pictures are of basins, and of the median answer of each
    method to each photo.

    Args:
        dataset: Photos with poses.
        scene: Their city.
        segmenter: Makes masks for methods that want one, once per photo.
        methods: What to measure, told the width of the prior.
        options: Which priors.
        progress: Called after each answer.

    Raises:
        DatasetError: No photo has a pose.
    """
    import pandas as pd

    city_map = CityMap(scene)
    known = [entry for entry in dataset.entries if entry.key in dataset.truth]
    if not known:
        raise DatasetError(f"None of the {len(dataset.entries)} photos of {dataset.name} has a true pose.")
    rows: list[dict[str, Any]] = []
    answers: dict[str, list[OverlayInput]] = {}
    total = len(methods) * len(known) * (options.priors + options.is_published_too)
    for method in methods:
        preparation = Preparation(dataset, scene, segmenter, "prior", segmented_inputs(method), city_map)
        for entry in known:
            query = preparation.query(entry)
            truth = preparation.local(dataset.truth[entry.key])
            for number, prior in enumerate(_priors(query, truth, options)):
                asked = replace(query, prior=prior, hypotheses=(prior,))
                streams = partial(random_stream, options.seed, "bench real", query.name, number, "search")
                found = {"method": method.name, "photo": entry.key}
                found["prior"] = str(number) if number < options.priors else "published"
                row, pose = _tried(method, asked, truth, city_map, streams)
                rows.append(found | row)
                if pose is not None:
                    picture = f"{method.name}/{re.sub(r'[^A-Za-z0-9._-]', '_', entry.key)}"
                    answers.setdefault(picture, []).append(_overlay(asked, truth, pose, row))
                progress(len(rows), total)
    report = report_real(pd.DataFrame(rows), f"{dataset.name}: priors {options.prior.describe()}")
    return replace(report, draw=lambda: report.draw() | _overlays(answers, scene))


def _overlay(query: Query, truth: Pose, pose: Pose, row: dict[str, Any]) -> OverlayInput:
    moved, turned = (f"{row[name]:.1f}" for name in ERROR)
    caption = f"{query.name}: off by {row[PRIOR_ERROR[0]]:.1f} m before, {moved} m and {turned} deg after"
    return OverlayInput(query.camera, None, query.image, query.prior, pose, truth, caption)


def _overlays(answers: dict[str, list[OverlayInput]], scene: Scene) -> dict[str, bytes]:
    """Returns for each method and photo the picture of the answer of median error."""
    renderer, drawn = SilhouetteRenderer(scene, threads=1), {}
    for name, shown in answers.items():
        errors = [np.linalg.norm(each.estimate.center - each.truth.center) for each in shown]  # type: ignore[union-attr]
        median = shown[int(np.argsort(errors, kind="stable")[len(errors) // 2])]
        drawn[f"{name}.png"] = png_bytes(draw_overlay(median, renderer))
    return drawn


def _priors(query: Query, truth: Pose, options: RealOptions) -> list[Pose]:
    drawn = [
        options.prior.draw(truth, random_stream(options.seed, "bench real", query.name, number))
        for number in range(options.priors)
    ]
    return [*drawn, query.prior] if options.is_published_too else drawn


def _tried(
    method: Method, query: Query, truth: Pose, city_map: CityMap, streams: Streams
) -> tuple[dict[str, Any], Pose | None]:
    """Returns a row of measurements, and the answer if there is one."""
    wall, cpu = time.perf_counter(), time.process_time()
    pose: Pose | None = None
    # No answer is an answer that nobody will trust.
    answer: dict[str, Any] = {"score": 0.0, "probability": 0.0, "surprise": math.nan, "failure": ""}
    try:
        estimate = localize_query(method, query, city_map, streams)
    except QueryFault as fault:
        answer["failure"] = fault.message
    else:
        pose = estimate.pose
        probability = math.nan if estimate.probability is None else estimate.probability
        answer |= {"score": float(estimate.score), "probability": probability}
        if estimate.covariance is not None:
            missed = pose.center - truth.center
            with suppress(np.linalg.LinAlgError):  # a plug-in may say that it is sure of one direction
                answer["surprise"] = float(missed @ np.linalg.solve(estimate.covariance[:3, :3], missed))
    seconds = {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
    errors = (*pose_error(query.prior, truth), *(FAILED if pose is None else pose_error(pose, truth)))
    starts, ends = query.prior.center, np.full(3, np.nan) if pose is None else pose.center
    row = {
        **dict(zip((*PRIOR_ERROR, *ERROR), errors, strict=True)),
        **dict(zip(("prior_east_m", "prior_north_m"), starts - truth.center, strict=False)),
        **dict(zip(("east_m", "north_m"), ends - truth.center, strict=False)),
        **answer,
        **seconds,
    }
    return row, pose
