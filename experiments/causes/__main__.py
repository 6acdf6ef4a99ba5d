"""Why poses are not found: the same views with one cause of errors taken away at a time, city by city.

What is found once the map is exact or the masks are perfect bounds what a better model of either can bring;
what is found from a known place bounds what a better search can, and what is found among all the poses that
a method kept, a better choice among them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from experiments.causes.outline_limit import share_within_reach
from experiments.command import run
from lodbench.bench import Figure, Progress, Report, no_progress
from lodbench.bench.accuracy import Job, drawable, names_of, percent_within, protocol_of, sweep
from lodbench.cli.bench_views import ViewedOptions
from lodbench.errors import ConfigError
from lodbench.methods import Method
from lodbench.params import flag, part
from lodbench.reporting.aligned_text import format_columns
from lodbench.reporting.table_heads import finite_text
from lodbench.synthesis.views_dataset import ViewsParams

if TYPE_CHECKING:
    import pandas as pd

_AS_DRAWN = "as drawn"
_CAUSES = (
    _AS_DRAWN,
    "place known",
    "true tilt",
    "exact map",
    "perfect masks",
    "exact map and perfect masks",
)
_GLOSSARY = (
    "Percent within (2 m, 2 deg). any kept: the answer or one of its alternatives; said: mean of the "
    "probability given; place known: priors at the true place, while methods are told the same range; "
    "exact map: the level that masks are drawn from."
)
_LIMIT = "best linear"
# Fewer masks say nothing about how masks err.
_FEWEST_MASKS = 20
_LIMIT_GLOSSARY = (
    f"{_LIMIT}: what least squares find that start at the truth, over the exact map, and know "
    "how such masks err: hardly any method will find more from them."
)


def measure_causes(
    cities: Sequence[ViewsParams],
    seeds: Sequence[int],
    methods: Sequence[Method],
    progress: Progress = no_progress,
    threads: int | None = None,
    limit_draws: int = 0,
) -> Report:
    """Returns what methods find of the same views with causes of errors taken away, at the sensor's tilt.

    Args:
        cities: What is drawn.
        seeds: Of the views.
        methods: What finds them.
        progress: Called after each run, and after each city's limit.
        threads: Of the engine; None for one per core.
        limit_draws: Masks of each view by which ``share_within_reach`` is found; 0 leaves it out.

    Raises:
        DatasetError: No city is left.
    """
    drawn, left_out = drawable(cities, seeds)
    names = names_of(cities)
    jobs = [
        _job(method, views, cause, names[views.city_model])
        for method, views, cause in product(methods, drawn, _CAUSES)
    ]
    total = len(jobs) + (len(drawn) if limit_draws else 0)
    queries = sweep(jobs, lambda done, _: progress(done, total), threads)
    table = {
        method.name: {
            str(city): _row(of_city)
            for city, of_city in queries[queries["method"] == method.name].groupby("city", sort=False)
        }
        for method in methods
    }
    lines = [f"{protocol_of(drawn[0], seeds)}.", *left_out, _GLOSSARY]
    if limit_draws:
        limits = _limits(drawn, names, limit_draws, lambda done: progress(len(jobs) + done, total))
        for rows in table.values():
            for city, row in rows.items():
                row[_LIMIT] = limits[city]
        lines.append(_LIMIT_GLOSSARY)
    lines.insert(0, _table(table))
    return Report("\n".join(lines), list(_figures(table)), queries)


def _limits(
    drawn: Sequence[ViewsParams], names: dict[str, str], draws: int, progress: Callable[[int], None]
) -> dict[str, float]:
    """Returns the percent within reach of each city, the mean over its seeds."""
    shares: dict[str, list[float]] = {}
    for number, views in enumerate(drawn, start=1):
        shares.setdefault(names[views.city_model], []).append(share_within_reach(views, draws))
        progress(number)
    return {city: float(np.mean(of_seeds)) for city, of_seeds in shares.items()}


def _job(method: Method, views: ViewsParams, cause: str, city: str) -> Job:
    shown = views
    if cause == "place known":
        shown = replace(shown, range_m=0.0, height_m=None)
    if "exact map" in cause:
        shown = replace(shown, lod=views.mask_lod or views.lod)
    if "perfect masks" in cause:
        shown = replace(shown, mask_iou=1.0)
    tilt = "truth" if cause == "true tilt" else "prior"
    return Job(method, shown, tilt, {"city": city, "cause": cause}, views.prior(tilt))


def _row(queries: pd.DataFrame) -> dict[str, float]:
    """Returns what was found of a city's views, percent, by cause."""
    as_drawn = queries[queries["cause"] == _AS_DRAWN]
    found = {cause: percent_within(queries[queries["cause"] == cause]) for cause in _CAUSES}
    given = as_drawn["probability"]
    kept = {
        "any kept": 100.0 * float(as_drawn["is_any_kept_found"].mean()),
        "said": 100.0 * float(given.fillna(0.0).mean()) if given.notna().any() else float("nan"),
    }
    return {_AS_DRAWN: found.pop(_AS_DRAWN), **kept, **found}


def _table(table: dict[str, dict[str, dict[str, float]]]) -> str:
    rows: list[list[str]] = []
    for method, cities in table.items():
        columns = list(next(iter(cities.values())))
        rows = rows or [["", *columns]]
        mean = {column: float(np.mean([row[column] for row in cities.values()])) for column in columns}
        for city, row in [*cities.items(), (f"mean of {len(cities)}", mean)]:
            rows.append([f"{method}  {city}", *(finite_text(row[column], ".1f") for column in columns)])
    return format_columns(rows)


def _figures(table: dict[str, dict[str, dict[str, float]]]) -> Iterator[Figure]:
    for method, cities in table.items():
        for city, row in cities.items():
            for column, percent in row.items():
                yield Figure(f"found {column} {method} {city}", percent, "%")


@dataclass(frozen=True, kw_only=True)
class CausesOptions:
    """What is measured."""

    viewed: ViewedOptions = part(ViewedOptions)
    limit: int = flag(
        0, "what the best estimate finds that knows map and noise, from so many masks a view", metavar="MASKS"
    )


def _measured(given: CausesOptions, steps: Progress) -> Report:
    if 0 < given.limit < _FEWEST_MASKS:
        raise ConfigError(f"--limit is of {_FEWEST_MASKS} masks a view or more.", "Write --limit 200.")
    methods, drawn = given.viewed.methods(), given.viewed.views()
    return measure_causes(drawn, given.viewed.drawn.each_seed(), methods, steps, limit_draws=given.limit)


if __name__ == "__main__":
    sys.exit(run("causes", CausesOptions, _measured))
