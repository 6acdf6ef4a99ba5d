"""Seeded views of a city: runs of `lodbench run dataset=views` in one table; hypotheses around each view."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lodbench.bench.report import Progress, no_progress
from lodbench.citymodel import Scene
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError
from lodbench.evaluation.pose_errors import PROBABILITY_THRESHOLD, hits_of, pose_error
from lodbench.geometry import Pose, rotations_at_yaws
from lodbench.harness.runs.artefacts import Run
from lodbench.harness.runs.run import RunSettings, run_method
from lodbench.methods import Method
from lodbench.methods.protocol import SupportsPriorWidth
from lodbench.plugins import blaming
from lodbench.rendering import Scorer
from lodbench.segmentation.masks import MaskFiles, MasksParams
from lodbench.storage import random_stream
from lodbench.synthesis.views import FINE_SIZE, RGB_CAMERA, ViewSampling, sample_views
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


# Kinds of views, named by their pitch from nadir.
STEEP = "pitch 20 to 60"


HORIZON = "pitch 60 to 75"


# Pitch of the views, degrees from nadir, by kind.
PITCHES = {STEEP: (20.0, 60.0), HORIZON: (60.0, 75.0)}


@dataclass(frozen=True, slots=True, eq=False)
class Swarm:
    """One view and the hypotheses around it."""

    pose: Pose  # the view
    rotations: NDArray[np.float64]  # (N, 3, 3) cam_from_world
    centers: NDArray[np.float64]  # (N, 3) metres


def make_swarms(
    scene: Scene, engine: Scorer, count: int, hypotheses: int, seed: int, kind: str = STEEP
) -> tuple[list[Swarm], int]:
    """Returns seeded views of a kind with their hypotheses, and how many draws of views were rejected."""
    camera = RGB_CAMERA.scaled(*FINE_SIZE)
    sampling = ViewSampling(seed=seed, pitch_deg=PITCHES[kind])
    names = ["silhouettes"] if kind == STEEP else ["silhouettes", kind]
    views = sample_views(scene, engine, camera, sampling, count, *names)
    return [make_swarm(pose, i, hypotheses, seed) for i, pose in enumerate(views.poses)], views.rejections


def make_swarm(pose: Pose, index: int, hypotheses: int, seed: int) -> Swarm:
    """Returns a view with hypotheses around it, which depend on the seed and the view's number only."""
    spread = UniformPrior()
    half = np.array([spread.x_m, spread.y_m, spread.z_m, spread.yaw_deg])
    stream = random_stream(seed, "silhouettes", index)
    offsets = stream.uniform(-half, half, size=(hypotheses, 4))
    pitch_deg, roll_deg, yaw_deg = pose.euler
    rotations = rotations_at_yaws(pitch_deg, roll_deg, yaw_deg + offsets[:, 3])
    return Swarm(pose, rotations, pose.center + offsets[:, :3])
