"""Results as tables for Python and notebooks: a run, several beside each other, the leaderboard."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.query import Dataset
from lodbench.datasets.registry import dataset_opener
from lodbench.errors import ConfigError, nearest_names
from lodbench.evaluation.metrics import LODLOC, Protocol, has_truth, protocol_named, summarize_queries
from lodbench.evaluation.pose_errors import Threshold
from lodbench.harness.runs.stored import StoredRun, read_whole_run
from lodbench.methods import Method
from lodbench.methods.registry import configure_method
from lodbench.reporting import summaries, tables
from lodbench.reporting.leaderboard import blocks_of, leaderboard_frame, read_entries, slug
from lodbench.segmentation import Segmenter
from lodbench.segmentation.protocol import chosen_segmenter, make_segmenter
from lodbench.storage import digest_of

if TYPE_CHECKING:
    import pandas as pd


def load_run(folder: str | Path) -> StoredRun:
    """Returns a finished run: ``queries`` is a DataFrame, ``poses`` and ``predictions`` are by its index.

    Raises:
        DatasetError: The folder holds no run, or a file of it cannot be read.
    """
    return read_whole_run(folder)


def run_method(
    method: str | Method,
    dataset: str | Path | Dataset,
    *,
    city: str | Path | None = None,
    segmenter: Segmenter | None = None,
    runs: str | Path = "runs",
    tilt: str = "prior",
    seed: int = 0,
    limit: int | None = None,
) -> StoredRun:
    """Runs a method over a dataset as ``lodbench run`` does, and returns the finished run.

    Args:
        method: A method, or the name of one with its settings as they are.
        dataset: A dataset, the name of one that needs no paths (``demo``), or a folder in the text layout.
        city: City model of such a folder, where its ``dataset.json`` names none.
        segmenter: Makes the masks; by default as the dataset has it: its masks, or a network on its photos.
        runs: Folder that the run's folder is made below; an interrupted run goes on there.
        tilt: ``prior``, or ``truth`` for the true pitch and roll, which a method named is given.
        seed: Of the search.
        limit: At most this many queries per split.

    Raises:
        LodbenchError: A name is unknown, or something is missing, before any work.
    """
    import yaml

    from lodbench.harness.runs.artefacts import write_artefacts
    from lodbench.harness.runs.gallery import write_overlays
    from lodbench.harness.runs.requirements import segmented_inputs
    from lodbench.harness.runs.run import RunSettings
    from lodbench.harness.runs.run import run_method as run

    made = configure_method({"name": method}).for_tilt(tilt).make() if isinstance(method, str) else method
    opened, stated = _opened(dataset, city)
    if segmenter is None:
        segmenter, _ = make_segmenter(chosen_segmenter(opened, segmented_inputs(made))[0])
    config: dict[str, Any] = {
        **{"renderer": "silhouette", "tilt": tilt, "seed": seed, "split": [], "limit": limit},
        "prior": {"name": "file"},
        "method": {"name": made.name, **_settings(made)},
        "segmenter": {"name": segmenter.name, **_settings(segmenter)},
        "dataset": stated,
        "source": {"name": "folder", "lod": None, "options": {}},
    }
    settings = RunSettings(Path(runs), config=config, tilt=tilt, seed=seed, limit=limit)
    done = run(made, opened, segmenter, settings)
    # Through JSON: tuples are lists in a file.
    write_artefacts(done, yaml.safe_dump(json.loads(json.dumps(config)), sort_keys=True, allow_unicode=True))
    write_overlays(done, done.preparation, lambda: done.scorer)
    return read_whole_run(done.folder)


def _opened(dataset: str | Path | Dataset, city: str | Path | None) -> tuple[Dataset, dict[str, Any]]:
    """Returns a dataset, and the settings that name it in a run's configuration, less paths."""
    if isinstance(dataset, Dataset):
        return dataset, {"name": dataset.name}
    if Path(dataset).expanduser().is_dir():
        params = FolderParams(str(dataset), None if city is None else str(city))
        left_out = {"root", "city_model"}
        return open_folder(params), {k: v for k, v in asdict(params).items() if k not in left_out}
    opener, params = dataset_opener({"name": str(dataset)})
    return opener(params), asdict(params)


def _settings(part: object) -> dict[str, Any]:
    """Returns the settings of a method or a segmenter."""
    params: Any = getattr(part, "params", None)
    if is_dataclass(params) and not isinstance(params, type):
        return asdict(params)
    kind: Any = getattr(part, "params_type", None)
    if vars(part) if kind is None else is_dataclass(kind) and fields(kind):
        raise ConfigError(
            f"{type(part).__name__} does not keep its settings in params, so that a run with others could "
            "not be distinguished from this one.",
            "Set self.params, a dataclass, in its __init__.",
        )
    return {}


def compare(
    runs: str | Path | StoredRun | Sequence[str | Path | StoredRun],
    thresholds: Sequence[Threshold] | None = None,
) -> pd.DataFrame:
    """Returns the numbers of runs, one row per method and split, and of their priors.

    The column ``protocol`` says what rows share: only rows of one protocol compare.

    Args:
        runs: Run folders, or what ``load_run`` made of them; or one of these.
        thresholds: Where to measure recall; None for the bins of each run's dataset.

    Raises:
        DatasetError: A folder holds no run.
    """
    given = [runs] if isinstance(runs, str | Path | StoredRun) else runs
    stored = [run if isinstance(run, StoredRun) else read_whole_run(run) for run in given]
    if not stored:
        raise ConfigError("There are no runs to compare.")
    return tables.frame_of(tables.tables_of([summary_at(run, thresholds) for run in stored]))


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


def protocol_of(run: StoredRun) -> Protocol:
    """Returns the protocol that a run is reported by.

    Raises:
        ConfigError: This lodbench does not know it.
    """
    return protocol_named(str(run.summary["protocol"].get("bins", LODLOC)))


def summary_at(run: StoredRun, thresholds: Sequence[Threshold] | None) -> dict[str, Any]:
    """Returns a run's summary at its protocol's or some thresholds, from its queries, with its times.

    Its dataset has a digest of the queries' ``names``, too: what runs from other priors have in common.
    """
    splits, priors = {}, {}
    protocol = protocol_of(run)
    for split in run.summary["splits"]:
        estimates, prior = summarize_queries(run.queries, split, protocol, thresholds)
        splits[split], priors[split] = estimates.to_json(), prior.to_json()
    seconds = run.provenance.get("seconds_per_query", {})
    names = digest_of([[str(key), bool(known)] for key, known in has_truth(run.queries).sort_index().items()])
    dataset = {**run.summary["dataset"], "names": names}
    return summaries.with_seconds(
        {**run.summary, "dataset": dataset, "splits": splits, "prior": priors}, seconds
    )
