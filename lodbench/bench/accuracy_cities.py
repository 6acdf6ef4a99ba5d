"""How well methods find poses over several cities: a row each, and their mean."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lodbench.bench.figures import Figure, Progress, Report, no_progress
from lodbench.bench.views import TILTS, Job, of_seeds, protocol_of, sweep
from lodbench.errors import DatasetError, LodbenchError
from lodbench.evaluation.queries import ERROR
from lodbench.evaluation.recall import PROBABILITY_THRESHOLD, hits_of
from lodbench.methods import Method
from lodbench.reporting.aligned_text import format_columns
from lodbench.reporting.table_columns import finite_text
from lodbench.synthesis.views_dataset import ViewsParams, open_views

if TYPE_CHECKING:
    import pandas as pd

_KEPT = 0.9
_HEAD = ("views", "2m-2deg %", "median m", "median deg", "vertical m", "probability %")
_DIGITS = (".0f", ".1f", ".2f", ".2f", "+.2f", ".1f")
_GLOSSARY = (
    "vertical: median error in height, above 0 too high; probability: mean of what a method gives of being "
    "within (2 m, 2 deg); mean: over cities, each counting alike; rejected: wrong answers, of all cities, "
    "whose probability is below that of 90 % of the right ones, and how many that would be on the average "
    "of worlds in which every probability is exact."
)


def measure_cities(
    cities: Sequence[ViewsParams],
    seeds: Sequence[int],
    methods: Sequence[Method],
    progress: Progress = no_progress,
    threads: int | None = None,
) -> Report:
    """Returns how well methods find seeded views over several cities; ``data`` is the table of ``sweep``.

    A city over which no views can be drawn, or that cannot be read, has no row and is named with its reason.

    Raises:
        DatasetError: No city is left.
    """
    drawn, left_out = drawable(cities, seeds)
    names = names_of(cities)
    jobs = [Job(m, v, t, {"city": names[v.city_model]}) for t, m, v in product(TILTS, methods, drawn)]
    queries = sweep(jobs, progress, threads)
    groups = [
        ((t, m.name), queries[(queries["tilt"] == t) & (queries["method"] == m.name)])
        for t, m in product(TILTS, methods)
    ]
    lines = [_table(groups), f"{protocol_of(drawn[0], seeds)}.", *left_out]
    lines += [f"tilt={tilt} {method}: {_rejected_in_words(rows)}" for (tilt, method), rows in groups]
    return Report("\n".join([*lines, _GLOSSARY]), list(_figures(groups)), queries)


def drawable(cities: Sequence[ViewsParams], seeds: Sequence[int]) -> tuple[list[ViewsParams], list[str]]:
    """Returns what is drawn over the cities for each seed, and why those have none that are left out.

    Raises:
        DatasetError: No city is left.
    """
    names, drawn, left_out = names_of(cities), [], []
    for city in cities:
        try:
            drawn += [view for view in of_seeds(city, seeds) if open_views(view)]
        except LodbenchError as error:
            left_out.append(f"{names[city.city_model]} is left out: {error}")
    if not drawn:
        raise DatasetError("No city is left to find views in.", "; ".join(left_out))
    return drawn, left_out


def share_rejected(queries: pd.DataFrame) -> float:
    """Returns the share of wrong answers that go where 90 % of the right ones are kept; nan without either.

    Args:
        queries: As ``sweep`` has them. Queries without an answer count as wrong, with a probability of 0.
    """
    found = hits_of(queries[list(ERROR)].to_numpy(), PROBABILITY_THRESHOLD)
    given = queries["probability"].fillna(0.0).to_numpy()
    if found.all() or not found.any():
        return float("nan")
    return float(np.mean(given[~found] < np.quantile(given[found], 1.0 - _KEPT)))


def share_rejectable(queries: pd.DataFrame) -> float:
    """Returns what ``share_rejected`` is expected to be if every probability is exact; nan if all are 0 or 1.

    How far apart right and wrong answers can be told is limited by how sure the answers are: of those
    that all say one half no more wrong ones go than right ones, however true that is.
    """
    given = np.sort(queries["probability"].fillna(0.0).to_numpy())
    wrong = np.concatenate([[0.0], np.cumsum(1.0 - given)])
    right = np.concatenate([[0.0], np.cumsum(given)])
    if wrong[-1] <= 0 or right[-1] <= 0:
        return float("nan")
    lost = int(np.searchsorted(right, (1.0 - _KEPT) * right[-1] + 1e-9, side="right")) - 1
    return float(wrong[lost] / wrong[-1])


def names_of(cities: Sequence[ViewsParams]) -> dict[str, str]:
    """Returns what tables call each city model: its file's name, or its path where others share that."""
    files = {views.city_model: Path(views.city_model).name for views in cities}
    counts = Counter(files.values())
    return {model: name if counts[name] == 1 else model for model, name in files.items()}


def share_found(queries: pd.DataFrame) -> float:
    """Returns the percentage within (2 m, 2 deg)."""
    return 100.0 * float(hits_of(queries[list(ERROR)].to_numpy(), PROBABILITY_THRESHOLD).mean())


def _table(groups: Sequence[tuple[tuple[str, str], pd.DataFrame]]) -> str:
    rows = [["", *_HEAD]]
    for (tilt, method), queries in groups:
        cities = [(city, _row(of_city)) for city, of_city in queries.groupby("city", sort=False)]
        mean = np.mean([row for _, row in cities], axis=0).tolist()
        for city, row in [*cities, (f"mean of {len(cities)}", [len(queries), *mean[1:]])]:
            texts = [finite_text(value, form) for value, form in zip(row, _DIGITS, strict=True)]
            rows.append([f"tilt={tilt}  {method}  {city}", *texts])
    return format_columns(rows)


def _row(queries: pd.DataFrame) -> list[float]:
    medians = [float(queries[name].median()) for name in (*ERROR, "vertical_error_m")]
    given = queries["probability"]
    mean = float(given.fillna(0.0).mean()) if given.notna().any() else float("nan")
    return [len(queries), share_found(queries), *medians, 100.0 * mean]


def _rejected_in_words(queries: pd.DataFrame) -> str:
    if not queries["probability"].notna().any():
        return "gives no probability."
    share, most = share_rejected(queries), share_rejectable(queries)
    if share != share:
        return "nothing to reject."
    bound = "" if most != most else f"; {100.0 * most:.0f} % were each probability exact"
    return f"{100.0 * share:.0f} % of wrong answers rejected{bound}."


def _figures(groups: Sequence[tuple[tuple[str, str], pd.DataFrame]]) -> Iterator[Figure]:
    for (tilt, method), queries in groups:
        recalls = []
        for city, of_city in queries.groupby("city", sort=False):
            recalls.append(_row(of_city)[1])
            yield Figure(f"recall 2m-2deg {method} tilt={tilt} {city}", recalls[-1], "%")
        yield Figure(f"mean recall 2m-2deg {method} tilt={tilt}", float(np.mean(recalls)), "%")
        yield Figure(f"wrong answers rejected {method} tilt={tilt}", 100.0 * share_rejected(queries), "%")
        if queries["probability"].notna().any():
            rejectable = 100.0 * share_rejectable(queries)
            yield Figure(f"wrong answers rejected {method} tilt={tilt}, expected", rejectable, "%")
