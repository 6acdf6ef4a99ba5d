"""Rows of the leaderboard as they are stored: one JSON file each, under a schema."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from lodbench.errors import DatasetError
from lodbench.evaluation.metrics import is_taken
from lodbench.evaluation.pose_errors import EVALUATOR_VERSION
from lodbench.reporting.summaries import upgraded_split
from lodbench.storage.json_text import parse_json

Entry = dict[str, Any]

ENTRY_SCHEMA = 1
# Digests of what went into a run that are part of its protocol.
_INPUTS = ("queries", "scene", "masks", "images", "poses", "code")


def entry_schema() -> dict[str, Any]:
    """Returns the JSON schema of an entry."""
    text = (files("lodbench.reporting") / "leaderboard.schema.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    return schema


def schema_faults(entry: Any) -> list[str]:
    """Returns a line for each place where a JSON value is no entry; the empty list if it is one."""
    import jsonschema

    # NaN is not a number of JSON, and would be within any bounds.
    finite = json.loads(json.dumps(entry), parse_constant=lambda name: name)
    errors = jsonschema.Draft202012Validator(entry_schema()).iter_errors(finite)
    faults = [f"{'.'.join(map(str, ['entry', *error.absolute_path]))}: {error.message}" for error in errors]
    return faults or [
        f"entry.splits.{split}.metrics: {name} is a name of lodbench's own"
        for split, numbers in entry["splits"].items()
        for name in filter(is_taken, numbers.get("metrics", {}))
    ]


def read_entries(root: Path) -> list[Entry]:
    """Returns the entries below ``root/entries``, in order of their files.

    Raises:
        DatasetError: A file is no JSON, breaks the schema, or stands under another dataset's name.
    """
    entries = []
    for path in sorted((root / "entries").glob("*/*.json")):
        try:
            entry = parse_json(path.read_text(encoding="utf-8"), is_strict=True)
        except (OSError, ValueError) as error:
            raise DatasetError(f"{path} is not readable as JSON: {error}.") from error
        faults = schema_faults(entry)
        if faults:
            raise DatasetError(f"{path}: {faults[0]}.", "The schema is lodbench/reporting/*.schema.json.")
        if slug(entry["dataset"]["name"]) != path.parent.name:
            raise DatasetError(f"{path} is of dataset {entry['dataset']['name']}, not {path.parent.name}.")
        splits = {name: upgraded_split(split) for name, split in entry["splits"].items()}
        # Its file's name is no part of an entry, but what a page links to.
        entries.append({**entry, "splits": splits, "file": path.name})
    return entries


def entry_path(root: Path, entry: Entry) -> Path:
    """Returns where a measured entry is stored: by dataset, method, variant and run."""
    method = entry["method"]
    words = [method["name"], method["variant"], entry["provenance"]["run"]]
    name = "-".join(slug(word) for word in words if word)
    return root / "entries" / slug(entry["dataset"]["name"]) / f"{name}.json"


def entry_text(entry: Entry) -> str:
    """Returns an entry as the text of its file.

    Raises:
        DatasetError: It breaks the schema.
    """
    faults = schema_faults(entry)
    if faults:
        raise DatasetError(f"The run makes no leaderboard entry: {faults[0]}.")
    return json.dumps(entry, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def measured_entry(
    summary: dict[str, Any],
    provenance: dict[str, Any],
    *,
    digests: dict[str, str],
    run: str,
    map_name: str,
    reasons: Sequence[str],
    settings: Mapping[str, Any] | None = None,
) -> Entry:
    """Returns the entry of a run or of a scored pose file.

    Args:
        summary: The run's ``summary.json``, verified.
        provenance: Its ``provenance.json``.
        digests: ``prior`` and ``split`` digests, and the SHA-256 of the run's files.
        run: Name of the run folder.
        map_name: What the method localises against.
        reasons: Why the entry must not rank; empty if it may.
        settings: Those of the method that are not its defaults.
    """
    dataset, protocol = summary["dataset"], summary["protocol"]
    seconds = provenance.get("seconds_per_query", {})
    changed = {"settings": dict(settings)} if settings else {}
    return {
        "schema": ENTRY_SCHEMA,
        "source": "submitted" if "poses" in dataset else "measured",
        "dataset": {"name": dataset["name"], "version": dataset["version"]},
        "method": {**summary["method"], "map": map_name, **changed},
        "protocol": {
            "condition": "",
            **{key: digests.get(key) for key in ("prior", "split")},
            # Of masks that nobody makes there is no digest.
            **{key: dataset[key] for key in _INPUTS if dataset.get(key)},
            "tilt": protocol["tilt"],
            "segmenter": protocol["segmenter"],
            "renderer": protocol["renderer"],
            "lod": protocol["lod"],
            "priors": protocol["prior"],
            "seeds": [protocol["seed"]] if isinstance(protocol["seed"], int) else [],
            "evaluator": EVALUATOR_VERSION,
            **({"bins": protocol["bins"]} if "bins" in protocol else {}),
        },
        "splits": {
            name: {**split, "seconds_per_query": seconds.get(name)}
            for name, split in summary["splits"].items()
        },
        "ranking": {"ranked": not reasons, "reasons": list(reasons)},
        "hardware": {key: provenance.get(key) for key in ("machine", "system", "threads")},
        "provenance": {
            "run": run,
            "lodbench": provenance.get("lodbench"),
            "files": {key: value for key, value in digests.items() if "." in key},
            "notes": list(summary.get("notes", ())),
        },
    }


def reasons_against(
    config: dict[str, Any], sizes: Mapping[str, int] | None = None, inputs: Collection[str] = ()
) -> list[str]:
    """Returns why a configuration's run must not rank beside others; empty if it may.

    Args:
        config: Of the run.
        sizes: Queries of the dataset by split: a limit above them all leaves nothing out. None if unknown.
        inputs: Names of what went into the run, as its summary has their digests.
    """
    reasons = []
    if config["tilt"] == "truth":
        reasons.append("oracle: the true pitch and roll were given (tilt=truth)")
    if "oracle" in str(config["segmenter"]["name"]):
        reasons.append(f"oracle: masks made from the truth (segmenter={config['segmenter']['name']})")
    if config.get("method", {}).get("matcher") == "oracle":
        reasons.append("oracle: correspondences made from the truth (method.matcher=oracle)")
    if "truth" in inputs and not any("made from the truth" in reason for reason in reasons):
        reasons.append("oracle: the method, or what makes its masks, is shown the truth")
    if config["segmenter"]["name"] == "unstated":
        reasons.append("a pose file made elsewhere: its protocol is its author's word")
    limit = config.get("limit")
    if limit is not None and (sizes is None or max(sizes.values(), default=0) > limit):
        reasons.append(f"only the first {limit} queries of each split")
    if config.get("split") and set(config["split"]) != set(sizes or ()):
        reasons.append(f"only some splits: {', '.join(config['split'])}")
    if has_random_weights(config):
        reasons.append("random weights")
    return reasons


def slug(text: str) -> str:
    """Returns a text as a file name."""
    return re.sub(r"[^\w+-]+", "_", text).strip("_") or "unnamed"


def has_random_weights(value: Any) -> bool:
    """Returns whether a configuration asks for a network with random weights anywhere."""
    if isinstance(value, dict):
        return value.get("weights") == "random" or any(map(has_random_weights, value.values()))
    return False
