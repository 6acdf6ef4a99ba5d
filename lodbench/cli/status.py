"""`lodbench status RUN ...`: how far runs are."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from lodbench.cli.parser import Parser, report_fault
from lodbench.errors import DatasetError
from lodbench.execution.progress import format_seconds
from lodbench.harness.runs.stored import RunStatus, find_runs, read_status
from lodbench.reporting.aligned_text import count_of, plain_text


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code: 2 if a folder holds no run that can be read."""
    parser = Parser("lodbench status", description="Show the progress of runs, finished or not.")
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUN", help="run folders, or one that holds them"
    )
    code = 0
    for folder in parser.parse_args(argv).runs:
        for run in find_runs(folder):
            try:
                sys.stdout.write(describe(read_status(run)))
            except DatasetError as fault:
                if run == folder:
                    raise
                # One that is damaged is no reason to hide those beside it.
                report_fault(fault)
                code = 2
    return code


def describe(status: RunStatus) -> str:
    """Returns a line per run, and one per reason of failure."""
    done = f"{status.num_done} of {count_of(status.num_queries, 'queries')}"
    if status.is_finished:
        state = "finished"
    elif status.num_done == status.num_queries:
        state = "all queries done, tables not written yet"
    elif status.seconds_per_query:
        state = f"unfinished, about {format_seconds(status.seconds_left)} of work left"
    else:
        state = "unfinished"
    lines = [f"{status.folder}: {done}, {state}"]
    lines += [f"  {count} x {plain_text(reason)}" for reason, count in sorted(status.failures.items())]
    return "\n".join(lines) + "\n"
