"""Results as tables for Python and notebooks: a run, several beside each other, the leaderboard."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.errors import ConfigError, nearest_names
from lodbench.evaluation.queries import summarize_queries
from lodbench.evaluation.recall import DEFAULT_THRESHOLDS, Threshold
from lodbench.harness.runs.stored import StoredRun, read_run
from lodbench.reporting.leaderboard import blocks_of, leaderboard_frame
from lodbench.reporting.leaderboard_entry import read_entries, slug
from lodbench.reporting.summaries import with_seconds
from lodbench.reporting.tables import tables_of

if TYPE_CHECKING:
    import pandas as pd


def load_run(folder: str | Path) -> StoredRun:
    """Returns a finished run: ``queries`` is a DataFrame, ``poses`` and ``predictions`` are by its index.

    Raises:
        DatasetError: The folder holds no run, or a file of it cannot be read.
    """
    return read_run(folder)


def compare(
    runs: Sequence[str | Path | StoredRun], thresholds: Sequence[Threshold] = DEFAULT_THRESHOLDS
) -> pd.DataFrame:
    """Returns the numbers of runs, one row per method and split, and of their priors.

    The column ``protocol`` says what rows share: only rows of one protocol compare.

    Args:
        runs: Run folders, or what ``load_run`` made of them.
        thresholds: Where to measure recall.

    Raises:
        DatasetError: A folder holds no run.
    """
    import pandas as pd

    stored = [run if isinstance(run, StoredRun) else read_run(run) for run in runs]
    if not stored:
        raise ConfigError("There are no runs to compare.")
    tables = tables_of([summary_at(run, thresholds) for run in stored])
    return pd.concat([table.frame().assign(protocol=table.title) for table in tables], ignore_index=True)


def leaderboard(dataset: str, root: str | Path = "leaderboard") -> pd.DataFrame:
    """Returns the leaderboard of a dataset, one row per entry and split, best first within a protocol.

    Args:
        dataset: Its name.
        root: Folder of the leaderboard.

    Raises:
        ConfigError: There are no entries of such a dataset.
    """
    entries: dict[str, list[dict[str, Any]]] = {}
    for entry in read_entries(Path(root)):
        entries.setdefault(slug(entry["dataset"]["name"]), []).append(entry)
    if slug(dataset) not in entries:
        raise ConfigError(f"{root} has no entries of {dataset!r}.", nearest_names(dataset, entries))
    return leaderboard_frame(blocks_of(entries[slug(dataset)])).infer_objects()


def summary_at(run: StoredRun, thresholds: Sequence[Threshold]) -> dict[str, Any]:
    """Returns a run's summary at some thresholds, computed from its queries, with its times."""
    splits, priors = {}, {}
    for split in run.summary["splits"]:
        estimates, prior = summarize_queries(run.queries, split, thresholds)
        splits[split], priors[split] = estimates.to_json(), prior.to_json()
    seconds = run.provenance.get("seconds_per_query", {})
    return with_seconds({**run.summary, "splits": splits, "prior": priors}, seconds)
