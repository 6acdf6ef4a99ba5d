"""How long evaluating takes: as many queries as the largest published split has, times many methods."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lodbench.bench.report import SEED, Figure, Progress, Report, load_in_words, no_progress, plain_report
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError, LodbenchError
from lodbench.evaluation.predictions import Prediction, evaluate
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.harness.runs.artefacts import Result, summary_of, write_artefacts
from lodbench.harness.runs.inputs import queries_digest
from lodbench.harness.runs.places import scene_of
from lodbench.harness.runs.report import run_report
from lodbench.harness.runs.stored import read_run
from lodbench.harness.runs.verify import verify_run
from lodbench.params import flag
from lodbench.reporting.aligned_text import format_columns
from lodbench.reporting.tables import format_csv, tables_of
from lodbench.storage import random_stream

_CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
_SPLIT = "all"


@dataclass(frozen=True, slots=True)
class EvaluationOptions:
    """What to measure."""

    num_queries: int = flag(2192, "as the largest published split (2192)", "--queries", metavar="QUERIES")
    num_methods: int = flag(100, "scored on all of them (100)", "--methods", metavar="METHODS")
    seed: int = flag(0, SEED)

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


_RUN = "import sys; from lodbench.cli import main; sys.exit(main(sys.argv[1:]))"
# Bytes that must be those of a serial run.
_SAME = ("poses.txt", "queries.csv", "summary.json")


@dataclass(frozen=True, slots=True)
class WorkerOptions:
    """What is run."""

    queries: int = flag(200, "of the demo (200)")
    workers: int = flag(2, "processes of one thread each, beside as many threads of a serial run (2)")
    method: str = flag("lodlocv2", "the method (lodlocv2)")
    repeats: int = flag(2, "rounds of all commands in turn, the fastest counts (2)")

    def __post_init__(self) -> None:
        if min(self.queries, self.repeats) < 1 or self.workers < 2:
            raise ConfigError("queries and repeats are at least 1, workers at least 2.")


@dataclass(frozen=True, slots=True)
class Timing:
    """What one way to run took."""

    whole_s: float
    queries_s: float


def measure_workers(options: WorkerOptions | None = None, progress: Progress = no_progress) -> Report:
    """Returns how much faster workers are than a serial run of one thread, and of as many threads.

    Raises:
        LodbenchError: A run fails, or its bytes are not those of the serial one.
    """
    options = options or WorkerOptions()
    count = options.workers
    ways = {
        "serial, 1 thread": ["executor.threads=1"],
        f"serial, {count} threads": [f"executor.threads={count}"],
        f"{count} workers of 1 thread": [
            "executor=process",
            f"executor.workers={count}",
            "executor.threads=1",
        ],
    }
    words = [f"method={options.method}", "dataset=demo", "segmenter=masks"]
    words.append(f"dataset.num_queries={options.queries}")
    found: dict[str, list[Timing]] = {name: [] for name in ways}
    with tempfile.TemporaryDirectory() as scratch:
        # Makes the town and compiles, once.
        _seconds(["run", *words, "limit=1", f"paths.runs={scratch}/first"])
        expected: list[bytes] = []
        for turn in range(options.repeats):
            for name, more in ways.items():
                runs = Path(scratch) / f"{turn}-{len(more)}-{more[0]}"
                command = ["run", *words, *more, f"paths.runs={runs}"]
                whole_s, rest_s = _seconds(command), _seconds(command)
                found[name].append(Timing(whole_s, max(whole_s - rest_s, 0.0)))
                made = [next(runs.rglob(file)).read_bytes() for file in _SAME]
                expected = expected or made
                if made != expected:
                    raise LodbenchError(f"{name} gives other bytes than a serial run.")
                progress(sum(map(len, found.values())), options.repeats * len(ways))
    best = {
        name: Timing(min(t.whole_s for t in times), min(t.queries_s for t in times))
        for name, times in found.items()
    }
    return Report(_text(best, options), _figures(best))


def _seconds(command: Sequence[str]) -> float:
    """Returns how long a command takes in a process of its own."""
    started = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", _RUN, *command], capture_output=True, text=True)  # noqa: S603
    if done.returncode:
        raise LodbenchError(f"lodbench {' '.join(command)}: {done.stderr.strip() or done.stdout.strip()}")
    return time.perf_counter() - started


def _figures(best: dict[str, Timing]) -> list[Figure]:
    *serial, (name, ours) = best.items()
    figures = []
    for peer, theirs in serial:
        for what, mine, other in (
            ("the whole command", ours.whole_s, theirs.whole_s),
            ("its queries", ours.queries_s, theirs.queries_s),
        ):
            title = f"{name}, {what}, beside {peer}"
            figures.append(Figure(title, mine, "s", peer, other, other / max(mine, 1e-9)))
    return figures


def _text(best: dict[str, Timing], options: WorkerOptions) -> str:
    first = next(iter(best.values()))
    rows = [["way to run", "command s", "queries s", "command", "queries"]]
    for name, mine in best.items():
        whole, queries = (
            f"{theirs / max(own, 1e-9):.2f}x"
            for theirs, own in ((first.whole_s, mine.whole_s), (first.queries_s, mine.queries_s))
        )
        rows.append([name, f"{mine.whole_s:.1f}", f"{mine.queries_s:.1f}", whole, queries])
    return format_columns(rows) + (
        f"\n{options.queries} queries of the demo with masks, {options.method}; fastest of "
        f"{options.repeats}, in turns; {load_in_words()}. {', '.join(_SAME)}: the same bytes in all.\n"
        "queries: the command less the same again with all answers there."
    )
