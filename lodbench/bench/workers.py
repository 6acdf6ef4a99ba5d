"""What worker processes gain: whole `lodbench run` commands on the demo with masks, by the clock.

A command given again, when all answers are there, does everything but answer queries: what it takes is
subtracted from the first to tell the queries apart from imports, opening, evaluation and pictures.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lodbench.bench.figures import Figure, Progress, Report, load_in_words, no_progress
from lodbench.bench.options import option
from lodbench.errors import ConfigError, LodbenchError
from lodbench.reporting.aligned_text import format_columns

_RUN = "import sys; from lodbench.cli import main; sys.exit(main(sys.argv[1:]))"
# Bytes that must be those of a serial run.
_SAME = ("poses.txt", "queries.csv", "summary.json")


@dataclass(frozen=True, slots=True)
class WorkerOptions:
    """What is run."""

    queries: int = option(200, "of the demo")
    workers: int = option(2, "processes of one thread each, beside as many threads of a serial run")
    method: str = option("lodlocv2", "the method")
    repeats: int = option(2, "rounds of all commands in turn, the fastest counts")

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
