"""`lodbench basin`: recall over the error of the prior, and the cost around the truth."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from lodbench.cli.hydra_app import plain, run_hydra, section
from lodbench.cli.run import run_config
from lodbench.errors import ConfigError
from lodbench.evaluation.basin import BasinStep, basin_steps, protocol_lines
from lodbench.harness.runs.basin import Basin, write_basin
from lodbench.harness.runs.cost_maps import CostGrid
from lodbench.methods.protocol import SupportsPriorWidth
from lodbench.methods.registry import configure_method
from lodbench.params import to_params
from lodbench.reporting.table_formats import format_text


@dataclass(frozen=True, slots=True)
class BasinOptions:
    """The settings of the command that are not a run's.

    Attributes:
        ranges: Half widths in x, y and z, metres.
        yaw_ranges: Half widths in yaw, degrees.
        limits: Queries per split by range; None for ``limit`` in all.
        maps: Whether to measure the cost around the truth.
    """

    ranges: list[float] = field(default_factory=list)
    yaw_ranges: list[float] = field(default_factory=list)
    limits: list[int | None] | None = None
    maps: bool = True


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    return run_hydra("basin", "basin", task, argv)


def task(config: DictConfig) -> None:
    """Runs one basin and leaves its folder, and those of its runs."""
    values = plain(config)
    options = to_params(
        {key: values.pop(key) for key in ("ranges", "yaw_ranges", "limits", "maps")}, BasinOptions, ""
    )
    steps = basin_steps(options.ranges, options.yaw_ranges, options.limits or [values["limit"]])
    # Apart from other runs, of which a pattern such as runs/demo/*/* is.
    values["paths"] = {**values["paths"], "runs": str(Path(values["paths"]["runs"]) / "basin")}
    # Every step's configuration is made before the first one runs: a fault stops before any work.
    jobs = [(step, _configuration(values, step)) for step in steps]
    is_told = isinstance(configure_method(section(values, "method")).make(), SupportsPriorWidth)
    basin = Basin(tuple(protocol_lines(values["tilt"], values["seed"], is_told)), [])
    for step, job in jobs:
        run = run_config(job)
        basin.add(step, run)
        sys.stderr.write(f"{step.label}: {_cost(basin, step)}\n")
    folder = write_basin(basin, CostGrid() if options.maps else None)
    sys.stdout.write(report(basin, folder))


def report(basin: Basin, folder: Path) -> str:
    """Returns the tables, the protocol and what they cost."""
    parts = [format_text(table) for table in basin.tables()]
    lines = ["protocol:", *(f"  {line}" for line in basin.protocol)]
    lines += [f"{step.label}: {_cost(basin, step)}" for step, _ in basin.steps]
    return "\n".join([*parts, *lines, f"  results: {folder}", ""])


def _cost(basin: Basin, step: BasinStep) -> str:
    run = basin.run_of(step)
    words = []
    for split in run.splits:
        hypotheses = basin.summary(step, split).hypotheses_per_query
        seconds = run.seconds_per_query(split)
        words.append(f"{split}: {hypotheses:.0f} hypotheses and {seconds:.2f} s per query")
    return "; ".join(words)


def _configuration(values: dict[str, Any], step: BasinStep) -> dict[str, Any]:
    """Returns the configuration of a step's run: that of `lodbench run` with prior=uniform."""
    prior = step.prior()
    method = configure_method(section(values, "method")).for_prior(prior)
    limit = step.limit if step.limit is not None else values["limit"]
    if limit is not None and limit < 1:
        raise ConfigError(f"limit={limit} is not a number of queries.")
    return {
        **values,
        "method": asdict(method.params),
        "prior": {"name": "uniform", **asdict(prior)},
        "limit": limit,
    }
