"""What processes gain where several photos are localised, beside what the photos take one by one."""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from experiments.command import run
from lodbench.bench import SEED, Figure, Progress, Report, no_progress
from lodbench.bench.commands import Build
from lodbench.errors import LodbenchError, require_numbers
from lodbench.params import flag
from lodbench.reporting.aligned_text import format_columns


@dataclass(frozen=True, slots=True)
class FlightWorkersOptions:
    """How many photos of the demo town, and by how many."""

    photos: int = flag(100, "photos of the demo town (100)")
    workers: int = flag(2, "processes, beside one (2)")
    seed: int = flag(0, SEED)

    def __post_init__(self) -> None:
        require_numbers(self, "", ("photos", "workers"), 1, 10_000)


def measure_workers(options: FlightWorkersOptions | None = None, progress: Progress = no_progress) -> Report:
    """Returns what `localize` takes with one process and with several, by the clock.

    CPU time is that of one process: what workers take is no part of the command's own.

    Raises:
        LodbenchError: The command fails, or answers are others with more processes.
    """
    options = options or FlightWorkersOptions()
    with tempfile.TemporaryDirectory() as place:
        build = Build("this build", Path(sys.executable), str(Path(__file__).parents[2]), Path(place))
        photos = _write_photos(build, options)
        costs, answers = [], []
        for number, workers in enumerate((1, options.workers)):
            words = ["--workers", str(workers), "--out", str(number)]
            costs.append(build.run([*photos, *words]))
            answers.append((build.place / words[-1] / "localized.csv").read_text("utf-8"))
            progress(number + 1, 2)
    if answers[0] != answers[1]:
        raise LodbenchError("Answers depend on the number of processes.")
    one, several = costs
    ratio = several.wall_s / (one.cpu_s / options.workers)
    head = ["photos", "one process: CPU s", "clock s", f"{options.workers} processes: clock s", "even shares"]
    row = [
        str(options.photos),
        *(f"{v:.1f}" for v in (one.cpu_s, one.wall_s, several.wall_s)),
        f"{ratio:.2f}",
    ]
    figures = [
        Figure("clock over CPU of one process in even shares", ratio, "", f"{options.workers} processes"),
        Figure("photos a minute", 60.0 * options.photos / several.wall_s, ""),
    ]
    return Report(format_columns([head, row]), figures)


def _write_photos(build: Build, options: FlightWorkersOptions) -> list[str]:
    """Writes the demo's photos with rough poses; returns the words of the command that names them."""
    counts = ["--num-queries", str(2 * options.photos), "--seed", str(options.seed)]
    build.run(["dataset", "make-demo", "demo", *counts])
    camera = (build.place / "demo/in_place/intrinsic.txt").read_text().splitlines()[0].split(maxsplit=1)[1]
    city = ["--city", "demo/town.gml", "--start", "demo/in_place/GPS_pose.txt", "--camera", camera]
    return ["localize", "demo/in_place/Query_image", *city, "--each-alone", "--method", "region"]


sys.exit(run("flight_workers", FlightWorkersOptions, measure_workers))
