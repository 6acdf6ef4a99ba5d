"""Sweeps of `lodbench run dataset=views`: what methods make of seeded views of a city, in one table."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lodbench.bench.report import Progress, no_progress
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError
from lodbench.evaluation.pose_errors import PROBABILITY_THRESHOLD, hits_of, pose_error
from lodbench.harness.runs.artefacts import Run
from lodbench.harness.runs.run import RunSettings, run_method
from lodbench.methods import Method
from lodbench.methods.protocol import SupportsPriorWidth
from lodbench.plugins import blaming
from lodbench.segmentation.masks import MaskFiles, MasksParams
from lodbench.synthesis.views import FINE_SIZE
from lodbench.synthesis.views_dataset import ViewsParams, drawing_facts, open_views

if TYPE_CHECKING:
    import pandas as pd

# The two blocks: pitch and roll of the prior true, or drawn with an error.
TILTS = ("truth", "prior")


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """One run of a sweep.

    Attributes:
        method: What finds poses.
        views: Of which city, drawn how.
        tilt: ``truth`` or ``prior``.
        labels: Columns of the sweep's table that tell this run from others.
        stated: How far off the method is given that priors may be; None for as far as they are.
    """

    method: Method
    views: ViewsParams
    tilt: str = "prior"
    labels: Mapping[str, Any] = field(default_factory=dict)
    stated: UniformPrior | None = None


def sweep(jobs: Sequence[Job], progress: Progress = no_progress, threads: int | None = None) -> pd.DataFrame:
    """Returns the queries of runs over views, one row each, as ``lodbench.evaluation.queries`` has them.

    Further columns are ``method``, ``seed``, ``seconds``, ``pose`` (the estimate in the city's frame, or
    None), ``is_any_kept_found`` (whether that or one of its alternatives lies within (2 m, 2 deg)),
    ``map_lod``, ``mask_lod``, ``rejections`` and the jobs' labels. A ``score`` below ``mask_iou``, what the
    true pose would score, is a failure of the search; a higher one says that the mask fits a wrong pose
    better. A method that can is given how far off the priors may be, tilt included (0 with the true one);
    never whether they are.

    Args:
        jobs: The runs.
        progress: Called after each.
        threads: Of the engine; None for one per core. Results do not depend on it.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    import pandas as pd

    tables = []
    for number, job in enumerate(jobs, start=1):
        tables.append(_queries_of(job, threads))
        progress(number, len(jobs))
    return pd.concat(tables)


def with_prior_range(method: Method, prior: UniformPrior) -> Method:
    """Returns a method that is given how far off priors may be, if it is one that can be."""
    if not isinstance(method, SupportsPriorWidth):
        return method
    with blaming("methods", method.name, "take the width of priors"):
        made: Method = type(method)(method.params_for_prior(prior))  # type: ignore[call-arg]
    return made


def of_seeds(views: ViewsParams, seeds: Sequence[int]) -> list[ViewsParams]:
    """Returns what is drawn for each seed.

    Raises:
        ConfigError: There is no seed, or one twice.
    """
    if not seeds or len(set(seeds)) < len(seeds):
        raise ConfigError(f"seeds are one or more different numbers, not {list(seeds)}.")
    return [replace(views, views_seed=seed) for seed in seeds]


def protocol_of(views: ViewsParams, seeds: Sequence[int]) -> str:
    """Returns in words what is drawn."""
    prior, (width, height) = views.prior(), FINE_SIZE
    return (
        f"masks of {width} x {height} degraded to IoU {views.mask_iou:g}, priors +-{prior.x_m:g}/"
        f"+-{prior.y_m:g}/+-{prior.z_m:g} m and +-{prior.yaw_deg:g} deg yaw, with tilt=prior "
        f"+-{views.tilt_deg:g} deg pitch and roll, seed{'s' if len(seeds) > 1 else ''} "
        + ", ".join(map(str, seeds))
        + ("" if views.rtk_m is None else f", RTK to {views.rtk_m:g} m along each axis")
        + ("" if views.laser_m is None else f", a laser's range to {views.laser_m:g} m")
        + (f", {views.area}ern half of the city" if views.area else "")
        + (f", a world of {views.world.describe()}" if views.world.describe() else "")
    )


def _queries_of(job: Job, threads: int | None) -> pd.DataFrame:
    dataset = open_views(job.views)
    method = with_prior_range(job.method, job.stated or job.views.prior(job.tilt))
    with tempfile.TemporaryDirectory() as scratch:
        settings = RunSettings(Path(scratch), threads=threads, tilt=job.tilt, seed=job.views.views_seed)
        settings = replace(settings, stream_names=_stream_names)
        run = run_method(method, dataset, MaskFiles(MasksParams()), settings)
    answers = [run.predictions[key] for key in run.queries.index]
    return run.queries.assign(
        method=method.name,
        seed=job.views.views_seed,
        seconds=[sum(answer.seconds.values()) for answer in answers],
        pose=np.array([answer.pose for answer in answers], dtype=object),
        is_any_kept_found=[_is_any_found(dataset, run, key) for key in run.queries.index],
        map_lod=run.lod or "",
        **drawing_facts(dataset),
        **job.labels,
    )


def _is_any_found(dataset: Dataset, run: Run, key: str) -> bool:
    answer = run.predictions[key]
    kept = [pose for pose in (answer.pose, *answer.alternatives) if pose is not None]
    errors = [pose_error(pose, dataset.truth[key]) for pose in kept]
    return bool(kept) and bool(hits_of(np.array(errors), PROBABILITY_THRESHOLD).any())


def _stream_names(entry: Entry) -> tuple[str, ...]:
    """Returns names that know neither the tilt nor the dataset's own: all blocks try the same moves."""
    return "accuracy", Path(entry.name).stem
