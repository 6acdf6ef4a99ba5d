"""The numbers of a split by flat names: of one run, or the means of several with their spread."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from typing import Any

from lodbench.errors import ConfigError
from lodbench.evaluation.metrics import is_taken


def numbers_of(split: dict[str, Any]) -> dict[str, Any]:
    """Returns the numbers of one split of a ``summary.json`` by flat names, as CSV has them."""
    bounds = {
        **split.get("recall_interval_95", {}),
        **{f"median_{name}": ends for name, ends in split.get("median_interval_95", {}).items()},
        **{f"AUC {label}": ends for label, ends in split.get("auc_interval_95", {}).items()},
    }
    counts = {"queries": split["num_queries"] or 0, "failed": split["num_failed"] or 0}
    printed = {f"{head} printed": text for head, text in split.get("printed", {}).items()}
    costs = ("hypotheses_per_query", "seconds_per_query")
    numbers = {
        **split["recall"],
        **{
            f"{label} {end}": value
            for label, ends in bounds.items()
            for end, value in zip(("low", "high"), ends, strict=True)
        },
        **{f"{label} of answered": value for label, value in split.get("recall_of_answered", {}).items()},
        **{f"AUC {label}": value for label, value in split.get("auc", {}).items()},
        **{name: split.get(name) for name in ("median_translation_m", "median_rotation_deg")},
        **{name: value for name, value in split.get("metrics", {}).items() if not is_taken(name)},
    }
    known = {name: math.nan if value is None else float(value) for name, value in numbers.items()}
    known |= {name: math.nan if split.get(name) is None else float(split[name]) for name in costs}
    return {**known, **counts, **printed, **({"is_printed": True} if printed else {})}


def mean_numbers(runs: Sequence[dict[str, Any]], split: str) -> dict[str, Any]:
    """Returns the numbers of one run, or the means of several with their standard deviations (``spread``)."""
    import pandas as pd

    known = [numbers_of(run["splits"][split]) for run in runs if split in run["splits"]]
    if len(known) == 1:
        return known[0]
    frame = pd.DataFrame(known)
    bounds = [name for name in frame if str(name).endswith((" low", " high"))]
    numbers = frame.drop(columns=[*bounds, "queries"])
    spread = numbers.std(ddof=1, skipna=False).add_suffix(" spread")
    means = {str(name): value for name, value in [*numbers.mean(skipna=False).items(), *spread.items()]}
    return {**means, "queries": int(frame["queries"].iloc[0])}


def require_one_run_a_seed(label: str, runs: Sequence[dict[str, Any]]) -> None:
    """Makes sure that no seed counts twice in a mean: the spread would be told too small.

    Raises:
        ConfigError: One would.
    """
    seeds = [run["protocol"].get("seed") for run in runs]
    twice = next((seed for seed in seeds if seeds.count(seed) > 1), None)
    if twice is not None:
        raise ConfigError(
            f"{seeds.count(twice)} of the runs of {label} have seed {twice}.",
            "A mean over seeds takes one run of each: leave the others out.",
        )


# What runs of one row over seeds have in common, of the digests of their inputs, and what each is called.
_NO_SEEDS = {
    "code": "code", "weights": "weights", "masks": "masks", "images": "photos",
    "references": "posed pictures", "textured_map": "textured map",
}  # fmt: skip


def require_seeds_alone(label: str, runs: Sequence[dict[str, Any]]) -> None:
    """Makes sure that runs which become one row differ in their seed alone, as far as they tell.

    Raises:
        ConfigError: Something else of them differs.
    """
    told = {words: [run["dataset"].get(name) for run in runs] for name, words in _NO_SEEDS.items()}
    told["settings"] = [run["method"].get("params") for run in runs]
    for words, values in told.items():
        known = [value for value in values if value]
        if any(value != known[0] for value in known):
            raise ConfigError(
                f"The runs of {label} differ in their {words}, not in their seed alone.",
                "A mean over seeds takes runs that are otherwise alike: leave the others out.",
            )


def common_photos(keys: Sequence[Hashable], photos: Sequence[str | None]) -> list[str]:
    """Returns for each run the digest of the photos that its rows are of, "" where none is told.

    A run that looked at no photo, or does not say at which, stands beside those of its key that do, where all
    of these looked at the same; otherwise by itself.

    Args:
        keys: Of each run, what else it shares with those beside it.
        photos: Of each run, the digest of what it looked at.
    """
    known: dict[Hashable, set[str]] = {}
    for key, digest in zip(keys, photos, strict=True):
        known.setdefault(key, set()).update([digest] if digest else [])
    return [
        digest or (next(iter(known[key])) if len(known[key]) == 1 else "")
        for key, digest in zip(keys, photos, strict=True)
    ]
