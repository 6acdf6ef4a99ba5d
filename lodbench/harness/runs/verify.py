"""Whether a run's numbers follow from its poses: everything is computed again and compared.

Each on its own: the files are those the run wrote (digests in ``provenance.json``), poses are those that
the ledger has, the errors in ``queries.csv`` follow from ``poses.txt`` and the dataset's truth, and
``summary.json`` follows from ``queries.csv``. The errors need the data. A method's own scores, probabilities
and counts of hypotheses cannot be computed again without the method; they are those of the ledger.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lodbench.citymodel.scene import Scene
from lodbench.datasets.folder import select_splits
from lodbench.datasets.prior_sources import prior_digest
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import LodbenchError
from lodbench.evaluation import metrics
from lodbench.evaluation.predictions import evaluate
from lodbench.geometry import wrap_deg
from lodbench.harness.city import city_digests, city_of_dataset
from lodbench.harness.runs import artefacts, compare, predict
from lodbench.harness.runs.inputs import chosen_entries, flights_digest, queries_digest
from lodbench.harness.runs.queries import prior_of
from lodbench.harness.runs.stored import StoredRun, read_run
from lodbench.rendering import Scorer, make_renderer
from lodbench.reporting.summaries import plugin_metrics, without_metrics
from lodbench.segmentation import Segmenter
from lodbench.segmentation.protocol import fingerprint_of, masks_digest
from lodbench.storage import digest_of

if TYPE_CHECKING:
    import pandas as pd

_COMPARED = (
    (metrics.ERROR[0], "error", " m", compare.TOLERANCE_M),
    (metrics.ERROR[1], "error", " deg", compare.TOLERANCE_DEG),
    (metrics.PRIOR_ERROR[0], "prior error", " m", compare.TOLERANCE_M),
    (metrics.PRIOR_ERROR[1], "prior error", " deg", compare.TOLERANCE_DEG),
    *((name, name.replace("_", " "), "", compare.TOLERANCE_M) for name in metrics.PARTS),
    ("mask_iou", "mask IoU", "", 0.0),
)
# Sums may be taken in another order on another machine.
_RELATIVE = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What verifying a run found."""

    stored: StoredRun  # the run
    differences: tuple[str, ...]  # one line each; empty if all numbers follow
    notes: tuple[str, ...]  # what could not be looked at, and why
    is_weak: bool  # True if the truth was not there, so that errors were taken as written
    dataset: Dataset | None  # the dataset, or None
    entries: tuple[Entry, ...]  # the queries scored; empty without the dataset
    # Metrics of plug-ins that only the run has, or only what is installed now: not compared.
    unknown: tuple[str, ...] = ()
    # The summary that follows from the run's rows, with the metrics that are installed now.
    computed: dict[str, Any] = field(default_factory=dict)


def verify_run(
    folder: Path,
    config: dict[str, Any],
    dataset: Dataset | None,
    segmenter: Segmenter | None = None,
    *,
    has_own_priors: bool = False,
) -> Verdict:
    """Returns what is wrong with a stored run, if anything.

    Args:
        folder: The run folder.
        config: Its ``config.yaml``.
        dataset: The dataset it was scored on, or None to compare the summary with the rows only.
        segmenter: To look whether the masks are the same; None to leave that out.
        has_own_priors: The dataset's priors are those of the run's ``priors.txt``: they cannot be had
            again from anywhere else.

    Raises:
        LodbenchError: A file of the run cannot be read, or the configuration is of another kind.
    """
    stored = read_run(folder)
    differences = [*changed_files(stored), *_changed_rows(stored, config), *compare.changed_answers(stored)]
    notes = [] if "files" in stored.provenance else ["provenance.json holds no digests of the files"]
    if compare.is_without_ledger(stored):
        notes.append(
            f"{predict.PREDICTIONS_FILE} is missing: scores, probabilities and masks are those of queries.csv"
        )
    entries: tuple[Entry, ...] = ()
    inputs, lod = _inputs(stored), stored.summary["protocol"].get("lod")
    reported = _stand_in(stored)
    if dataset is not None:
        splits = select_splits(dataset, config.get("split") or ())
        entries = chosen_entries(dataset, splits, config.get("limit"))
        if has_own_priors:
            notes.append("the priors are taken from the run's own priors.txt")
        else:
            inputs["queries"] = queries_digest(dataset, entries)
            if "priors" in inputs:
                inputs["priors"] = prior_digest(entries)
        if "flights" in inputs:
            inputs["flights"] = flights_digest(entries) or ""
        # What was said of a pose file stands with its method: the file itself need not be there.
        reported = replace(dataset, notes=dataset.notes + tuple(config["method"].get("notes", ())))
        if "masks" in inputs and segmenter is not None:
            # Runs of older versions never say what settings a fingerprint leaves out.
            earlier = fingerprint_of(segmenter, entries)
            is_same = inputs["masks"] == earlier
            inputs["masks"] = earlier if is_same else masks_digest(segmenter, entries)
        scorer = None
        if "scene" in inputs and dataset.city_model is not None:
            city = city_of_dataset(dataset)
            inputs, lod = _with_city(inputs, city.scene, notes), city.scene.lod
            scorer = make_renderer("silhouette", city.scene, None)
            reported = replace(dataset, notes=dataset.notes + city.notes())
        elif "scene" in inputs:
            notes.append("the city model is not there: not compared")
            reported = replace(dataset, notes=_stand_in(stored).notes)
        if "textured_map" in inputs:
            reported = _with_words_of_the_map(reported, stored)
        differences += _changed_errors(stored, entries, dataset, str(config["tilt"]), scorer)
    splits = tuple(stored.queries["split"].unique())
    computed = artefacts.summary_of(
        artefacts.Result(folder, config, reported, splits, stored.predictions, stored.queries, inputs, lod)
    )
    # Plug-ins may have come and gone since.
    unknown = plugin_metrics(stored.summary) ^ plugin_metrics(computed)
    actual, expected = (without_metrics(each, unknown) for each in (stored.summary, computed))
    differences += compare_values(actual, expected, "summary.json")
    differences += _wrong_name(folder, config, inputs)
    return Verdict(
        stored,
        tuple(differences),
        tuple(notes),
        dataset is None,
        dataset,
        entries,
        tuple(sorted(unknown)),
        computed,
    )


def compare_values(actual: Any, expected: Any, where: str) -> list[str]:
    """Returns a line for each place where a JSON value differs from the expected one."""
    if isinstance(actual, dict) and isinstance(expected, dict):
        lines = []
        for key in dict.fromkeys([*expected, *actual]):
            if key not in actual or key not in expected:
                lines.append(f"{where}: {key} is {'missing' if key in expected else 'not expected'}")
            else:
                lines += compare_values(actual[key], expected[key], f"{where}: {key}")
        return lines
    if isinstance(actual, list) and isinstance(expected, list) and len(actual) == len(expected):
        pairs = enumerate(zip(actual, expected, strict=True))
        return [line for i, (a, b) in pairs for line in compare_values(a, b, f"{where}[{i}]")]
    if isinstance(actual, float) and isinstance(expected, float):
        same = math.isclose(actual, expected, rel_tol=_RELATIVE)
    else:
        # 1, 1.0 and true are equal in Python, not in a file; a whole number may be written either way.
        same = actual == expected and isinstance(actual, bool) == isinstance(expected, bool)
    return [] if same else [f"{where} is {actual!r}, not {expected!r}"]


def changed_files(stored: StoredRun) -> list[str]:
    """Returns a line for each file that is no longer the one the run wrote."""
    written = stored.provenance.get("files", {})
    gone = [f"{name} is missing" for name in written if name not in stored.digests]
    return gone + [
        f"{name} is not the file the run wrote (SHA-256 {digest[:12]}, not {str(written[name])[:12]})"
        for name, digest in stored.digests.items()
        if name in written and written[name] != digest
    ]


def _changed_rows(stored: StoredRun, config: dict[str, Any]) -> list[str]:
    queries = stored.queries
    lines = [f"poses.txt: {name} is not a query of queries.csv" for name in stored.strays]
    for key, failure, error_m in zip(
        queries.index, queries["failure"], queries[metrics.ERROR[0]], strict=True
    ):
        is_answered = key in stored.poses
        # A pose with nothing to compare it with is an answer all the same.
        if failure not in ("", metrics.NO_TRUTH) and is_answered:
            lines.append(f"queries.csv: {key} has a failure, and a pose in poses.txt")
        if not failure and not is_answered:
            lines.append(f"queries.csv: {key} has no failure, and no pose in poses.txt")
        if not math.isnan(error_m) and is_answered != math.isfinite(error_m):
            lines.append(f"queries.csv: {key} has an error but no pose, or a pose but no error")
    for tilt in sorted(set(queries["tilt"]) - {str(config["tilt"])}):
        lines.append(f"queries.csv: a tilt is {tilt!r}, config.yaml says {config['tilt']!r}")
    return lines


def _changed_errors(
    stored: StoredRun, entries: tuple[Entry, ...], dataset: Dataset, tilt: str, scorer: Scorer | None
) -> list[str]:
    """Returns where the rows' errors do not follow from the poses, the masks and the truth."""
    rows = stored.queries
    keys = [entry.key for entry in entries]
    lines = [f"queries.csv: {key} is missing" for key in keys if key not in rows.index]
    lines += [f"queries.csv: {key} is not a query of the dataset" for key in rows.index.difference(keys)]
    there = [entry for entry in entries if entry.key in rows.index]
    priors = {entry.key: prior_of(entry, dataset, tilt) for entry in there}
    columns = metrics.protocol_named(dataset.protocol).columns
    expected = evaluate(there, stored.predictions, dataset.truth, priors, scorer, tilt, columns)
    actual = rows.loc[expected.index]
    known = metrics.has_truth(expected)
    for key in expected.index[known == actual["failure"].map(metrics.is_without_truth).astype(bool)]:
        lines.append(f"queries.csv: {key} fails with {actual['failure'][key]!r}, against the truth list")
    return lines + [line for column in _COMPARED for line in _other_numbers(actual, expected, *column)]


def _other_numbers(
    actual: pd.DataFrame, expected: pd.DataFrame, name: str, words: str, unit: str, tolerance: float
) -> list[str]:
    """Returns a line for each query whose number in a column is not the expected one."""
    a, b = actual[name], expected[name]
    with np.errstate(invalid="ignore"):
        apart = (a - b).map(wrap_deg).abs() if name == "yaw_error_deg" else (a - b).abs()
    is_same = (apart <= tolerance) | (a == b) | (a.isna() & b.isna())
    # A mask that was not kept, as before there were stored predictions, tells nothing.
    is_same |= b.isna() if name == "mask_iou" else False
    return [
        f"queries.csv: {key}: {words} is {float(a[key])!r}{unit}, its pose says {float(b[key])!r}"
        for key in expected.index[~is_same]
    ]


def _inputs(stored: StoredRun) -> dict[str, str]:
    dataset = stored.summary.get("dataset")
    if not isinstance(dataset, dict) or not {"name", "version"} <= set(dataset):
        raise LodbenchError(f"{stored.folder / 'summary.json'} does not say which dataset it is of.")
    return {key: str(value) for key, value in dataset.items() if key not in ("name", "version")}


def _with_city(inputs: dict[str, str], scene: Scene, notes: list[str]) -> dict[str, str]:
    """Returns digests of inputs with those of a city as it is now."""
    now = city_digests(scene)
    if "roofs" in now and "roofs" not in inputs:
        # Runs of older versions never do.
        notes.append("the run records no pitched roofs, but the city model has them: not compared")
        del now["roofs"]
    return {name: digest for name, digest in inputs.items() if name != "roofs"} | now


def _stand_in(stored: StoredRun) -> Dataset:
    """Returns a dataset that only tells what the summary says of it."""
    stated = stored.summary["dataset"]
    notes = tuple(stored.summary.get("notes", ()))
    bins = stored.summary["protocol"].get("bins", metrics.LODLOC)
    return Dataset(
        stated["name"], stated["version"], stored.folder, None, None, (), (), {}, notes, protocol=bins
    )


def _with_words_of_the_map(reported: Dataset, stored: StoredRun) -> Dataset:
    """Returns a dataset with the notes of a textured map, which takes minutes to make and is not opened."""
    stated = _stand_in(stored).notes
    return replace(reported, notes=stated) if stated[: len(reported.notes)] == reported.notes else reported


def _wrong_name(folder: Path, config: dict[str, Any], inputs: dict[str, str]) -> list[str]:
    """Returns a line if a folder named by a digest has another one than its content."""
    digest = digest_of({"config": config, "inputs": inputs})
    name = folder.resolve().name
    is_digest = len(name) == len(digest) and set(name) <= set("0123456789abcdef")
    if not is_digest or name == digest:
        return []
    return [f"the folder is named {name}, its configuration and inputs make {digest}"]
