"""How long evaluating takes, and how fast training data are made."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from lodbench.bench import SEED, Figure, Progress, Report, load_in_words, no_progress, plain_report
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import ConfigError, LodbenchError, require_within
from lodbench.evaluation.predictions import Prediction, evaluate
from lodbench.execution.processes import fan_out
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.harness.runs import artefacts, places, report, verify
from lodbench.harness.runs.inputs import queries_digest
from lodbench.harness.runs.stored import read_run
from lodbench.params import flag
from lodbench.photos.pictures import encoded_mask
from lodbench.rendering import open_renderer
from lodbench.reporting.tables import format_csv, tables_of
from lodbench.storage import make_folder, random_stream
from lodbench.synthesis.camera_paths import GenerateParams
from lodbench.synthesis.generate import open_cities, world_parts
from lodbench.synthesis.plan_views import PictureParts, PlannedView, ViewWriter, files_of, plan_views

_CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
_SPLIT = "all"
_opened: list[tuple[ViewWriter, Path]] = []


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
        (table,) = tables_of([artefacts.summary_of(result) for result in results])
        format_csv(table)
        score_s = time.perf_counter() - started
        stored = results[0]
        stored.folder.mkdir()
        artefacts.write_artefacts(stored, "")
        started = time.perf_counter()
        read_run(stored.folder)
        read_s = time.perf_counter() - started
        started = time.perf_counter()
        verdict = verify.verify_run(stored.folder, stored.config, dataset)
        page = report.run_report(verdict, "prior", places.scene_of(verdict))
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
) -> artefacts.Result:
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
    return artefacts.Result(
        scratch / f"{number:03d}", config, dataset, (_SPLIT,), predictions, queries, inputs, None
    )


@dataclass(frozen=True, slots=True)
class TrainingDataOptions:
    """What to measure."""

    views: int = flag(24, "photos of each size; ten times as many masks (24)")
    workers: int | None = flag(None, "processes (one per core)")
    props: Path | None = flag(None, "scene props to picture; made up without")
    seed: int = flag(0, SEED)

    def __post_init__(self) -> None:
        if self.views < 2:
            raise ConfigError(f"views={self.views} is too few to measure.", "24 is usual.")
        require_within("workers", self.workers, 1, 1024)


def measure_training_data(
    city: Path, options: TrainingDataOptions | None = None, progress: Progress = no_progress
) -> Report:
    """Returns how many masks and photos are made per second, and in how much memory.

    Every figure is taken after one view per process, so that compiling and reading do not count.

    Raises:
        LodbenchError: The city cannot be read, or shows too few buildings.
    """
    options = options or TrainingDataOptions()
    load = load_in_words()
    workers = options.workers or os.cpu_count() or 1
    props = None if options.props is None else str(options.props)
    folder = Path(tempfile.mkdtemp(prefix="lodbench-bench-"))
    params = GenerateParams(
        str(city), str(folder), sampling="random", count=20 * options.views, val_share=0.0, test_share=0.0,
        limit=10 * options.views, seed=options.seed, props=props, workers=workers,
    )  # fmt: skip
    try:
        scene, picture = open_cities(params, ReadOptions())
        parts, land, _ = world_parts(params, scene, picture)
        views = plan_views(params, scene, land.ground).views
        rows: list[Figure] = []
        steps: list[Callable[[], list[Figure]]] = [
            lambda: _masks(params, parts, views, workers),
            lambda: _photos(params, parts, views[: options.views], workers),
            lambda: _photos(replace(params, size=(512, 512)), parts, views[: 2 * options.views], workers),
            lambda: [_memory(params, parts, views)],
        ]
        for number, step in enumerate(steps):
            rows += step()
            progress(number + 1, len(steps))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    triangles = len(picture.triangles) + (0 if parts.props is None else len(parts.props))
    note = (
        f"{city.name}, {triangles:,} triangles in pictures, {workers} processes on {os.cpu_count()} cores, "
        f"{load} before the start. Written to disk, file by file."
    )
    return plain_report(city.name, rows, note)


def _masks(
    params: GenerateParams, parts: PictureParts, views: tuple[PlannedView, ...], workers: int
) -> list[Figure]:
    """Returns masks per second, alone; beside them pyrender, one process, drawn and encoded alike."""
    rate, cpu = _rate(replace(params, images=False), parts, views, workers)
    title = f"masks alone, bilevel PNG, {_size(params)}"
    peer, peer_rate = _pyrender_rate(parts.scene, params.camera, views[:20])
    ratio = None if peer_rate is None else rate / peer_rate
    return [
        Figure(title, rate, "/s", peer, peer_rate, ratio),
        Figure(f"{title}, CPU time each", 1000 * cpu, "ms"),
    ]


def _photos(
    params: GenerateParams, parts: PictureParts, views: tuple[PlannedView, ...], workers: int
) -> list[Figure]:
    rate, cpu = _rate(params, parts, views, workers)
    title = f"photos with shadows, and masks, {_size(params)}"
    return [Figure(title, rate, "/s"), Figure(f"{title}, CPU time each", 1000 * cpu, "ms")]


def _rate(
    params: GenerateParams, parts: PictureParts, views: tuple[PlannedView, ...], workers: int
) -> tuple[float, float]:
    """Returns views written per second, and seconds of CPU time per view."""
    out = Path(tempfile.mkdtemp(dir=params.out))
    for path in files_of(params, views[0], out):
        make_folder(path.parent)
    workers = min(workers, len(views))
    cpu, started, count = 0.0, None, 0
    for seconds in fan_out(_timed, _warmed(views, workers), workers, _open, (params, parts, out)):
        if seconds is None:
            continue
        # The clock starts with the first view that is not a warm-up; it is done, so it does not count.
        if started is None:
            started = time.perf_counter()
            continue
        cpu += seconds
        count += 1
    elapsed = time.perf_counter() - (started or 0.0)
    shutil.rmtree(out)
    return count / elapsed, cpu / count


def _warmed(views: tuple[PlannedView, ...], workers: int) -> list[tuple[PlannedView, bool]]:
    """Returns the views with a few in front that only warm the processes up."""
    warm = [(replace(views[0], name=f"warm-{k}"), True) for k in range(4 * workers)]
    return [*warm, *((view, False) for view in views)]


def _open(params: GenerateParams, parts: PictureParts, out: Path) -> None:
    _opened[:] = [(ViewWriter(params, parts), out)]


def _timed(item: tuple[PlannedView, bool]) -> float | None:
    """Writes a view; returns its CPU time, or None for a warm-up."""
    view, is_warm_up = item
    world, out = _opened[0]
    started = time.process_time()
    world.write(view, out)
    return None if is_warm_up else time.process_time() - started


def _pyrender_rate(scene: Scene, camera: Camera, views: tuple[PlannedView, ...]) -> tuple[str, float | None]:
    try:
        renderer = open_renderer("pyrender", scene)
        encoded_mask(renderer.render(camera, views[0].pose), bilevel=True)
    except LodbenchError as error:
        return f"pyrender ({error.message})", None
    started = time.perf_counter()
    for view in views:
        encoded_mask(renderer.render(camera, view.pose), bilevel=True)
    return "pyrender, one process", len(views) / (time.perf_counter() - started)


def _memory(params: GenerateParams, parts: PictureParts, views: tuple[PlannedView, ...]) -> Figure:
    """Returns how much larger a process is after many views than after few, MB, masks and photos."""
    small = replace(params, size=(256, 256))
    out = Path(tempfile.mkdtemp(dir=params.out))
    for path in files_of(small, views[0], out):
        make_folder(path.parent)
    world = ViewWriter(small, parts)
    tenth = max(1, len(views) // 10)
    for view in views[:tenth]:
        world.write(view, out)
    before = resident_mb() or 0.0
    for view in views[tenth:]:
        world.write(view, out)
    grown = (resident_mb() or 0.0) - before
    return Figure(f"memory grown from view {tenth} to view {len(views)}, 256x256", grown, "MB")


def _size(params: GenerateParams) -> str:
    return f"{params.size[0]}x{params.size[1]}"


def resident_mb() -> float | None:
    """Returns the memory this process holds, megabytes, where the system states it."""
    status = Path("/proc/self/status")
    match = re.search(r"VmRSS:\s*(\d+) kB", status.read_text()) if status.is_file() else None
    return int(match[1]) * 1024 / 1e6 if match else None
