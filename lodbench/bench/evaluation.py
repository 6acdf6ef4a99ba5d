"""How long evaluating takes: as many queries as the largest published split has, times many methods."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from lodbench.bench.figures import Figure, Progress, Report, no_progress, plain_report
from lodbench.bench.options import SEED, option
from lodbench.datasets.priors import UniformPrior
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError
from lodbench.evaluation.predictions import Prediction, evaluate
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.harness.runs.artefacts import summary_of, write_artefacts
from lodbench.harness.runs.places import scene_of
from lodbench.harness.runs.report import run_report
from lodbench.harness.runs.result import Result, queries_digest
from lodbench.harness.runs.stored import read_run
from lodbench.harness.runs.verify import verify_run
from lodbench.reporting.table_formats import format_csv
from lodbench.reporting.tables import tables_of
from lodbench.storage import random_stream

_CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
_SPLIT = "all"


@dataclass(frozen=True, slots=True)
class EvaluationOptions:
    """What to measure."""

    num_queries: int = option(2192, "as the largest published split", flag="queries")
    num_methods: int = option(100, "scored on all of them", flag="methods")
    seed: int = option(0, SEED)

    def __post_init__(self) -> None:
        if min(self.num_queries, self.num_methods) < 1:
            raise ConfigError("There must be at least one query and one method.")


def measure_evaluation(options: EvaluationOptions | None = None, progress: Progress = no_progress) -> Report:
    """Returns how long evaluating seeded poses takes; needs no city.

    Scored are errors, recalls, medians and intervals of all methods, from their poses to one table; one run
    is read back and summarised, verified, and its page written.
    """
    options = options or EvaluationOptions()
    dataset = _dataset(options)
    with tempfile.TemporaryDirectory() as scratch:
        methods = [_estimates(dataset, options, number) for number in range(options.num_methods)]
        started = time.perf_counter()
        inputs = {"queries": queries_digest(dataset, dataset.entries)}
        results = []
        for number, poses in enumerate(methods):
            results.append(_scored(dataset, poses, number, Path(scratch), inputs))
            progress(number + 1, options.num_methods)
        (table,) = tables_of([summary_of(result) for result in results])
        format_csv(table)
        score_s = time.perf_counter() - started
        stored = results[0]
        stored.folder.mkdir()
        write_artefacts(stored, "")
        started = time.perf_counter()
        read_run(stored.folder)
        read_s = time.perf_counter() - started
        started = time.perf_counter()
        verdict = verify_run(stored.folder, stored.config, dataset)
        page = run_report(verdict, "prior", scene_of(verdict))
        page_s = time.perf_counter() - started
    figures = [
        Figure("evaluate all methods", score_s, "s"),
        Figure("read one run", read_s, "s"),
        Figure("verify and report one run", page_s, "s"),
        Figure("page", len(page.encode()) / 1e6, "MB"),
    ]
    return plain_report(f"{options.num_queries} queries, {options.num_methods} methods", figures)


def _dataset(options: EvaluationOptions) -> Dataset:
    entries, truth = [], {}
    for number in range(options.num_queries):
        generator = random_stream(options.seed, "bench", "evaluation", number)
        pitch, roll, yaw = generator.uniform((20.0, -1.0, -180.0), (60.0, 1.0, 180.0))
        pose = Pose.from_euler(EulerAngles(pitch, roll, yaw), generator.uniform(-1000, 1000, 3))
        entry = Entry(f"{number:05d}.jpg", _SPLIT, _CAMERA, UniformPrior().draw(pose, generator), None, None)
        entries.append(entry)
        truth[entry.key] = pose
    return Dataset("bench", "", Path(), None, None, (_SPLIT,), tuple(entries), truth)


def _estimates(dataset: Dataset, options: EvaluationOptions, number: int) -> list[Pose | None]:
    """Returns a method's answers: each method worse than the one before, one query in 50 failing."""
    generator = random_stream(options.seed, "bench", "evaluation", "method", number)
    half_width = 0.5 + 0.1 * number
    widths = UniformPrior(half_width, half_width, half_width, 0.5)
    is_answered = generator.random(len(dataset.entries)) > 0.02
    return [
        widths.draw(dataset.truth[entry.key], generator) if answered else None
        for entry, answered in zip(dataset.entries, is_answered, strict=True)
    ]


def _scored(
    dataset: Dataset, poses: list[Pose | None], number: int, scratch: Path, inputs: dict[str, str]
) -> Result:
    """Returns a method's rows, scored as `lodbench evaluate` scores them."""
    predictions = {
        entry.key: Prediction(pose, "" if pose is not None else "no pose in the pose file")
        for entry, pose in zip(dataset.entries, poses, strict=True)
    }
    priors = {entry.key: entry.prior for entry in dataset.entries}
    queries = evaluate(dataset.entries, predictions, dataset.truth, priors)
    config = {
        "method": {"name": f"method_{number:03d}"},
        "segmenter": {"name": "unstated"},
        "tilt": "prior",
        "seed": "unstated",
        "renderer": "unstated",
    }
    return Result(scratch / f"{number:03d}", config, dataset, (_SPLIT,), predictions, queries, inputs, None)
