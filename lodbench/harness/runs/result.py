"""What a scored set of poses is, wherever the poses came from: a method's run, a file, a stored run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.datasets.query import Dataset, Entry, repeated_keys
from lodbench.errors import DatasetError
from lodbench.evaluation.predictions import Prediction, pose_numbers
from lodbench.storage import digest_of

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Result:
    """Rows and all that the tables and artefacts say about where they came from.

    Attributes:
        folder: The run folder.
        config: The resolved configuration.
        dataset: The dataset.
        splits: Splits scored, in order.
        predictions: What was answered, by ``Entry.key``.
        queries: One row per query (``lodbench.evaluation.queries``).
        inputs: Digests of what went in.
        lod: Level of detail localised against; None where no city was opened or it has no name.
    """

    folder: Path
    config: dict[str, Any]
    dataset: Dataset
    splits: tuple[str, ...]
    predictions: Mapping[str, Prediction]
    queries: pd.DataFrame
    inputs: dict[str, str]
    lod: str | None

    def __repr__(self) -> str:
        name = self.config["method"]["name"]
        kind = type(self).__name__
        return f"{kind}({name} on {self.dataset.name}, {len(self.queries)} queries, {self.folder})"

    def seconds_per_query(self, split: str) -> float:
        """Returns the mean wall time of a split's answered queries, NaN if there is none."""
        mine = [self.predictions[key] for key in self.queries.index[self.queries["split"] == split]]
        times = [sum(prediction.seconds.values()) for prediction in mine if prediction.pose is not None]
        return sum(times) / len(times) if times else math.nan


def chosen_entries(dataset: Dataset, splits: tuple[str, ...], limit: int | None) -> tuple[Entry, ...]:
    """Returns the entries of some splits, at most ``limit`` of each, in file order by split.

    Raises:
        DatasetError: Two have one key: one would count twice and the other never.
    """
    by_split = [[entry for entry in dataset.entries if entry.split == split] for split in splits]
    twice = repeated_keys(entry for entries in by_split for entry in entries)
    if twice:
        raise DatasetError(
            f"The dataset {dataset.name} has several queries {twice[0]}.",
            "Give each query of a split a name of its own.",
        )
    return tuple(entry for entries in by_split for entry in entries[:limit])


def queries_digest(dataset: Dataset, entries: tuple[Entry, ...]) -> str:
    """Returns a digest of some entries: names, cameras and how well these are known, priors, truth."""
    return digest_of(
        [
            [
                entry.key,
                repr(entry.camera),
                pose_numbers(entry.prior),
                pose_numbers(dataset.truth.get(entry.key)),
                *([] if entry.lens_percent is None else [entry.lens_percent]),
                *([] if entry.camera_sigmas is None else astuple(entry.camera_sigmas)),
                *([] if entry.measured is None else entry.measured.words()),
            ]
            for entry in entries
        ]
    )


def flights_digest(entries: tuple[Entry, ...]) -> str | None:
    """Returns a digest of what ties photos together: flights and reconstructions; None where nothing does."""
    tied = [e for e in entries if e.sequence or e.reconstructed is not None]
    return digest_of([[e.key, e.sequence, pose_numbers(e.reconstructed)] for e in tied]) if tied else None


def truth_digest(dataset: Dataset, entries: tuple[Entry, ...]) -> str:
    """Returns a digest of the true poses of some entries: what an oracle is shown."""
    return digest_of([[entry.key, pose_numbers(dataset.truth.get(entry.key))] for entry in entries])


def split_digest(entries: tuple[Entry, ...]) -> str:
    """Returns a digest of which queries are scored, in which splits."""
    return digest_of([entry.key for entry in entries])
