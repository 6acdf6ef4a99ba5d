"""What commands cost: whole processes, beside another build's, and over several workers.

A command that computes little is mostly start: Python, imports, plug-ins, settings. CPU seconds, user and
system, of the process and of those it starts, say what that is on a machine that is busy with other work.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from lodbench.bench import Figure, Progress, Report, load_in_words, no_progress, seconds_of_command
from lodbench.errors import ConfigError, LodbenchError
from lodbench.geometry.angles import dji_from_rotation
from lodbench.params import flag
from lodbench.reporting.aligned_text import format_columns

# Buildings of the tile that is cut from the demo town.
_TILE_BUILDINGS = 20
# Exit codes of commands that did their work: of localize one more, for a pose that is not to be trusted.
_DONE = {"localize": (0, 3)}
COLD = "localize, cold"
# Starts a command from a small process: a peak of memory begins with that of the process that starts it.
_MEASURE = """
import json, os, subprocess, sys, time
started = time.perf_counter()
child = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL, stdout=sys.stderr)
_, status, used = os.wait4(child.pid, 0)
wall_s = time.perf_counter() - started
code = child.returncode = os.waitstatus_to_exitcode(status)
print(json.dumps([code, used.ru_utime + used.ru_stime, wall_s, used.ru_maxrss]))
"""
# Bytes that must be those of a serial run.
_SAME = ("poses.txt", "queries.csv", "summary.json")


@dataclass(frozen=True, slots=True)
class StartupOptions:
    """What is run."""

    repeats: int = flag(5, "rounds of all commands in turn; the least of each counts (5)")
    beside: str | None = flag(None, "Python whose lodbench is run in turns with this one")
    beside_path: str | None = flag(None, "folder that holds the package lodbench to run in turns")
    tile: str | None = flag(None, "city model for city info (20 buildings of the demo town)")
    photo: str | None = flag(None, "photo to localise, with --city (one of the demo)")
    city: str | None = flag(None, "city model of the photo (the demo town)")
    # Whether localize is run over an empty kernel cache as well, once.
    is_cold: bool = flag(False, "localize over an empty kernel cache as well, which compiles", "--cold")

    def __post_init__(self) -> None:
        if self.repeats < 1:
            raise ConfigError("repeats is at least 1.")
        if (self.photo is None) != (self.city is None):
            raise ConfigError("A photo is localised in a city.", "Give both, --photo and --city, or neither.")
        for path in (self.beside, self.beside_path, self.tile, self.photo, self.city):
            if path is not None and not Path(path).exists():
                raise ConfigError(f"{path} does not exist.", "Check the path.")
        if self.beside_path is not None and not (Path(self.beside_path) / "lodbench").is_dir():
            raise ConfigError(f"There is no lodbench in {self.beside_path}.", "Name the folder above it.")


class Cost(NamedTuple):
    """What a process took, with those it started: seconds of CPU and by the clock, the largest's peak MiB."""

    cpu_s: float
    wall_s: float
    peak_mib: float


@dataclass(frozen=True, slots=True)
class Build:
    """An installed lodbench."""

    name: str  # what it is called in the table
    python: Path  # its interpreter
    path: str  # what stands in ``PYTHONPATH``; "" for nothing
    place: Path  # folder that its commands are run in; their results go there

    def run(self, words: Sequence[str], environment: dict[str, str] | None = None) -> Cost:
        """Returns what a command costs.

        Raises:
            LodbenchError: It fails.
        """
        known = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        known |= {"PYTHONPATH": self.path} if self.path else {}
        known |= environment or {}
        command = [sys.executable, "-I", "-S", "-c", _MEASURE, str(self.python), "-m", "lodbench", *words]
        done = subprocess.run(command, cwd=self.place, env=known, capture_output=True, text=True)  # noqa: S603
        code, cpu_s, wall_s, peak = json.loads(done.stdout)
        if code not in _DONE.get(words[0], (0,)):
            lines = done.stderr.strip().splitlines() or ["no message"]
            message = next((line for line in lines if line.startswith("lodbench: ")), lines[-1])
            raise LodbenchError(f"{self.name}: lodbench {words[0]}: {message.removeprefix('lodbench: ')}")
        return Cost(cpu_s, wall_s, peak / (2**20 if sys.platform == "darwin" else 2**10))


@dataclass(slots=True)
class Row:
    """What one command costs each build, and why one has no figure: by the builds' names."""

    name: str
    words: list[str]
    costs: dict[str, Cost] = field(default_factory=dict)
    faults: dict[str, str] = field(default_factory=dict)

    def measure(self, build: Build, environment: dict[str, str] | None = None) -> None:
        """Runs the command once more and keeps the least of each figure; of one that fails, the reason."""
        if build.name in self.faults:
            return
        try:
            cost = build.run(self.words, environment)
        except LodbenchError as fault:
            self.faults[build.name] = fault.message
            return
        self.costs[build.name] = Cost(*map(min, cost, self.costs.get(build.name, cost)))


def measure_startup(options: StartupOptions | None = None, progress: Progress = no_progress) -> Report:
    """Returns what commands of this build cost, and of another one beside it, runs in turns.

    Raises:
        LodbenchError: A command of this build fails.
    """
    options = options or StartupOptions()
    with tempfile.TemporaryDirectory() as scratch:
        builds = list(_builds(options, Path(scratch)))
        rows = [Row(name, words) for name, words in _commands(options, Path(scratch))]
        total = (options.repeats + 1) * len(rows) * len(builds)
        for turn in range(options.repeats + 1):
            for n, row in enumerate(rows):
                for k, build in enumerate(builds):
                    row.measure(build)
                    progress((turn * len(rows) + n) * len(builds) + k + 1, total)
            if turn == 0:  # compiled kernels, the scene and the run's answers are there from now on
                for row in rows:
                    row.costs.clear()
        if options.is_cold:
            rows.append(Row(COLD, next(row.words for row in rows if row.name.startswith("localize"))))
            for build in builds:
                with tempfile.TemporaryDirectory(dir=scratch) as empty:
                    rows[-1].measure(build, {"NUMBA_CACHE_DIR": empty})
    faults = [row.faults[builds[0].name] for row in rows if builds[0].name in row.faults]
    if faults:
        raise LodbenchError(faults[0])
    return Report(_text(rows, builds, options), list(_figures(rows, builds)))


def _builds(options: StartupOptions, scratch: Path) -> Iterator[Build]:
    """Yields this build, and the one beside it, each with a folder of its own."""
    own = str(Path(__file__).parents[2])
    beside = [options.beside, options.beside_path]
    for name in ["this build", "beside"] if any(beside) else ["this build"]:
        (scratch / name).mkdir()
        python, path = Path(sys.executable), own
        if name == "beside":
            # Absolute, not resolved: an environment's Python is a link, and known by its place.
            python = python if options.beside is None else Path(options.beside).absolute()
            path = "" if options.beside_path is None else str(Path(options.beside_path).resolve())
        yield Build(name, python, path, scratch / name)


def _commands(options: StartupOptions, scratch: Path) -> Iterator[tuple[str, list[str]]]:
    """Yields names and words of the commands; photo and tile are made where none are named."""
    from lodbench.synthesis.demo import DemoParams, open_demo

    demo = open_demo(DemoParams())
    assert demo.city_model is not None  # noqa: S101 - the demo has one
    tile = _tile(demo.city_model, scratch) if options.tile is None else Path(options.tile).resolve()
    yield "--help", ["--help"]
    yield "run --help", ["run", "--help"]
    yield "dataset list", ["dataset", "list"]
    yield f"city info ({tile.stat().st_size / 1e6:.2g} MB)", ["city", "info", str(tile)]
    yield "doctor", ["doctor"]
    if options.photo is None or options.city is None:
        entry = demo.entries[0]
        assert entry.camera is not None  # noqa: S101 - those of the demo have all three
        assert entry.prior is not None  # noqa: S101
        heading_deg, pitch_deg, _ = dji_from_rotation(entry.prior.rotation)
        camera = entry.camera
        lens = map(str, (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy))
        localized = [
            str(entry.image),
            "--city",
            str(demo.city_model),
            "--camera",
            f"PINHOLE {' '.join(lens)}",
        ]
        localized += ["--center", *map(str, entry.prior.center.tolist())]
        localized += ["--heading", str(heading_deg), "--pitch", str(pitch_deg)]
    else:
        localized = [str(Path(options.photo).resolve()), "--city", str(Path(options.city).resolve())]
    yield "localize PHOTO --city", ["localize", *localized]
    place = [f"dataset.root={demo.root}", f"city={demo.city_model}"]
    yield "finished run again", ["run", "dataset=folder", *place, "method=region", "limit=1"]


def _tile(city: Path, scratch: Path) -> Path:
    """Returns a tile of the first buildings of a city."""
    from lodbench.citymodel import read_city_model
    from lodbench.citymodel.convert import convert_city
    from lodbench.citymodel.derive import choose_buildings

    model = read_city_model(city)
    part = choose_buildings(model, ids=model.building_ids[:_TILE_BUILDINGS])
    convert_city(part, scratch / "tile.gml")
    return scratch / "tile.gml"


def _figures(rows: Sequence[Row], builds: Sequence[Build]) -> Iterator[Figure]:
    own, *others = (build.name for build in builds)
    for row in rows:
        other = next((row.costs.get(name) for name in others), None)
        reason = next((f": {row.faults[name]}" for name in others if name in row.faults), "")
        peer = f"{others[0]}{reason}" if others else ""
        mine = row.costs[own]
        for what, unit, value, theirs in (
            ("CPU", "s", mine.cpu_s, None if other is None else other.cpu_s),
            ("by the clock", "s", mine.wall_s, None if other is None else other.wall_s),
            ("peak memory", "MiB", mine.peak_mib, None if other is None else other.peak_mib),
        ):
            ratio = None if theirs is None else theirs / max(value, 1e-9)
            yield Figure(f"{row.name}: {what}", value, unit, peer, theirs, ratio)


def _text(rows: Sequence[Row], builds: Sequence[Build], options: StartupOptions) -> str:
    own, *others = (build.name for build in builds)
    head = ["command", "CPU s", "clock s", "MiB"]
    table = [[*head, f"{others[0]}: CPU s", "clock s", "MiB", "CPU"] if others else head]
    for row in rows:
        line = [row.name, *_in_words(row.costs[own])]
        for name in others:
            cost = row.costs.get(name)
            ratio = None if cost is None else cost.cpu_s / max(row.costs[own].cpu_s, 1e-9)
            line += ["fails", "", "", ""] if cost is None else [*_in_words(cost), f"{ratio:.1f}x"]
        table.append(line)
    notes = [
        f"Whole processes, least of {options.repeats} runs each"
        + (", of both builds in turns" if others else "")
        + ", after one that is not counted"
        + (", the cold one once" if options.is_cold else "")
        + f"; {load_in_words()}."
    ]
    notes += [fault for row in rows for fault in row.faults.values()]
    return "\n".join([format_columns(table), *notes])


def _in_words(cost: Cost) -> list[str]:
    return [f"{cost.cpu_s:.2f}", f"{cost.wall_s:.2f}", f"{cost.peak_mib:.0f}"]


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
    timings: dict[str, list[Timing]] = {name: [] for name in ways}
    with tempfile.TemporaryDirectory() as scratch:
        # Makes the town and compiles, once.
        seconds_of_command("run", *words, "limit=1", f"paths.runs={scratch}/first")
        expected: list[bytes] = []
        for turn in range(options.repeats):
            for name, more in ways.items():
                runs = Path(scratch) / f"{turn}-{len(more)}-{more[0]}"
                command = ["run", *words, *more, f"paths.runs={runs}"]
                whole_s, rest_s = seconds_of_command(*command), seconds_of_command(*command)
                timings[name].append(Timing(whole_s, max(whole_s - rest_s, 0.0)))
                made = [next(runs.rglob(file)).read_bytes() for file in _SAME]
                expected = expected or made
                if made != expected:
                    raise LodbenchError(f"{name} gives other bytes than a serial run.")
                progress(sum(map(len, timings.values())), options.repeats * len(ways))
    best = {
        name: Timing(min(t.whole_s for t in times), min(t.queries_s for t in times))
        for name, times in timings.items()
    }
    return Report(_worker_text(best, options), _worker_figures(best))


def _worker_figures(best: dict[str, Timing]) -> list[Figure]:
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


def _worker_text(best: dict[str, Timing], options: WorkerOptions) -> str:
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
