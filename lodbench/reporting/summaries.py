"""What a run left, its ``summary.json``, and the numbers of a split by flat names."""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Sequence
from pathlib import Path
from typing import Any

from lodbench.errors import ConfigError, DatasetError
from lodbench.evaluation.metrics import OWN_NUMBERS, is_taken
from lodbench.methods.registry import changed_settings
from lodbench.storage.json_text import parse_json

# Raised whenever a number of a summary gets another meaning, or a new one must be there.
SUMMARY_SCHEMA = 3
# What stood beside the recalls of a split before metrics had a place, and under which names.
_MOVED = ("median_horizontal_m", "median_vertical_m", "median_yaw_deg", "mask_iou")
_RENAMED = {
    "said": "mean_confidence_percent", "said_found": "ece_percent", "risk_area": "aurc_percent",
}  # fmt: skip

_NUMBER = {"type": ["number", "null"], "minimum": -1e12, "maximum": 1e12}
_NUMBERS = {"type": "object", "additionalProperties": _NUMBER}
_ENDS = {"type": "array", "minItems": 2, "maxItems": 2, "items": _NUMBER}
_INTERVALS = {"type": "object", "additionalProperties": _ENDS}
_SPLITS = {
    "type": "object",
    "additionalProperties": {
        "type": "object",
        "required": ["recall", "num_queries", "num_failed"],
        "properties": {
            **dict.fromkeys(("recall", "recall_of_answered", "auc", "metrics"), _NUMBERS),
            **dict.fromkeys((f"{name}_interval_95" for name in ("recall", "median", "auc")), _INTERVALS),
            **dict.fromkeys(("num_queries", "num_failed", "hypotheses_per_query"), _NUMBER),
            **dict.fromkeys(("median_translation_m", "median_rotation_deg"), _NUMBER),
        },
    },
}
_TEXT = {"type": "string"}
# What tables and pages rely on; JSON Schema. Anything may stand besides.
_SHAPE = {
    "type": "object",
    "required": ["dataset", "method", "protocol", "splits"],
    "properties": {
        "dataset": {
            "type": "object",
            "required": ["name", "version"],
            "properties": {"name": _TEXT, "version": _TEXT, "images": _TEXT},
        },
        "method": {
            "type": "object",
            "required": ["name", "variant"],
            "properties": {"name": _TEXT, "variant": _TEXT, "params": {"type": "object"}},
        },
        "protocol": {"type": "object", "required": ["tilt", "segmenter", "seed"]},
        "splits": _SPLITS,
        "prior": _SPLITS,
        "notes": {"type": "array", "items": _TEXT},
    },
}
# What runs of one row over seeds have in common, of the digests of their inputs, and what each is called.
_NO_SEEDS = {
    "code": "code", "weights": "weights", "masks": "masks", "images": "photos",
    "references": "posed pictures", "textured_map": "textured map",
}  # fmt: skip


def read_summary(folder: Path) -> dict[str, Any]:
    """Returns the summary of a run folder, with the times that ``provenance.json`` holds.

    Raises:
        DatasetError: The folder holds no readable summary, or one of another version of lodbench.
    """
    path = folder / "summary.json"
    try:
        summary: dict[str, Any] = parse_json(path.read_text(encoding="utf-8"), is_strict=True)
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"{path} is not a readable run summary.", "Name a folder that `lodbench run` made."
        ) from error
    if not isinstance(summary, dict) or "splits" not in summary or "protocol" not in summary:
        raise DatasetError(f"{path} is not a run summary.")
    if summary.get("schema") == 2:
        try:
            summary = _upgraded(summary)
        except (AttributeError, TypeError) as error:
            raise DatasetError(f"{path} is not a run summary: {error}.") from error
    if summary.get("schema") != SUMMARY_SCHEMA:
        raise DatasetError(
            f"{path} has schema {summary.get('schema')}, this lodbench reads 2 and {SUMMARY_SCHEMA}.",
            "Run again: the same command resumes nothing of another version, and ranks with nothing of it.",
        )
    fault = _fault(summary)
    if fault:
        raise DatasetError(
            f"{path} is not a run summary: {fault}.", "Name a folder that `lodbench run` made."
        )
    if summary.get("invalid"):
        raise DatasetError(f"The run {folder} is invalid: {summary['invalid']}.", "It can enter no table.")
    return summary


def _fault(summary: dict[str, Any]) -> str:
    """Returns the first place where a summary is of another form, and how; "" where there is none."""
    import jsonschema

    error = next(jsonschema.Draft202012Validator(_SHAPE).iter_errors(summary), None)
    if error is None:
        return ""
    # A value may be as long as its writer liked.
    return f"{'.'.join(map(str, ['summary', *error.absolute_path]))}: {error.message:.200}"


def with_seconds(summary: dict[str, Any], seconds: dict[str, float | None]) -> dict[str, Any]:
    """Returns a summary whose splits also hold the wall time per query: no part of the summary's file."""
    splits = {
        name: {**split, "seconds_per_query": seconds.get(name)} for name, split in summary["splits"].items()
    }
    return {**summary, "splits": splits}


def with_settings(summary: dict[str, Any], config: dict[str, Any], city: str | Path | None) -> dict[str, Any]:
    """Returns a summary with the ``settings`` of its data and its segmenter: no part of the summary's file.

    Tables and runs that are called alike are distinguished by them. And ``method.settings`` are those of the
    method that are not its defaults.
    """
    reported = {**config["dataset"], "limit": config.get("limit"), "city": Path(city).name if city else None}
    segmenter = config.get("segmenter")
    if isinstance(segmenter, dict):
        reported["segmenter"] = {key: _place(value) for key, value in segmenter.items() if key != "name"}
    nested = {key: value for key, value in reported.items() if isinstance(value, dict)}
    inner = {f"{key}.{name}": value for key, values in nested.items() for name, value in values.items()}
    settings = {key: value for key, value in {**reported, **inner}.items() if key not in nested}
    method = {**summary["method"], "settings": changed_settings(config.get("method", {}))}
    return {**summary, "method": method, "settings": settings}


def _place(value: Any) -> Any:
    """Returns a setting; of a path its last name."""
    return Path(value).name if isinstance(value, str) else value


def without_metrics(summary: dict[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Returns a summary less the numbers of some metrics."""
    parts: dict[str, Any] = {
        part: {
            split: {**numbers, "metrics": {k: v for k, v in numbers["metrics"].items() if k not in names}}
            if "metrics" in numbers
            else numbers
            for split, numbers in summary[part].items()
        }
        for part in ("splits", "prior")
        if part in summary
    }
    return {**summary, **parts}


def with_plugin_metrics(summary: dict[str, Any], computed: dict[str, Any]) -> dict[str, Any]:
    """Returns a summary with those numbers of plug-ins' metrics that only another summary of its run has."""
    splits = summary["splits"]
    for split, numbers in computed.get("splits", {}).items():
        more = numbers.get("metrics", {})
        if split in splits and (names := more.keys() - OWN_NUMBERS - splits[split].get("metrics", {}).keys()):
            metrics = {**splits[split].get("metrics", {}), **{name: more[name] for name in sorted(names)}}
            splits = {**splits, split: {**splits[split], "metrics": metrics}}
    return {**summary, "splits": splits}


def plugin_metrics(summary: dict[str, Any]) -> set[str]:
    """Returns the names of the numbers that metrics of plug-ins give."""
    splits = [*summary["splits"].values(), *summary.get("prior", {}).values()]
    return {name for split in splits for name in split.get("metrics", {})} - OWN_NUMBERS


def upgraded_split(split: dict[str, Any]) -> dict[str, Any]:
    """Returns the numbers of a split; those of older summaries and entries are put under ``metrics``."""
    known = {_RENAMED.get(name, name): value for name, value in split.get("calibration", {}).items()}
    known |= {name: split[name] for name in _MOVED if split.get(name) is not None}
    rest = {name: value for name, value in split.items() if name not in ("calibration", *_MOVED)}
    return {**rest, "metrics": {**known, **split.get("metrics", {})}}


def _upgraded(summary: dict[str, Any]) -> dict[str, Any]:
    parts = {
        part: {name: upgraded_split(split) for name, split in summary.get(part, {}).items()}
        for part in ("splits", "prior")
    }
    return {**summary, **parts, "schema": SUMMARY_SCHEMA}


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
    """Makes sure that no seed counts twice in a mean: the spread would be stated too small.

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


def require_seeds_alone(label: str, runs: Sequence[dict[str, Any]]) -> None:
    """Makes sure that runs which become one row differ in their seed alone, as far as they tell.

    Raises:
        ConfigError: Something else of them differs.
    """
    reported = {words: [run["dataset"].get(name) for run in runs] for name, words in _NO_SEEDS.items()}
    reported["settings"] = [run["method"].get("params") for run in runs]
    for words, values in reported.items():
        known = [value for value in values if value]
        if any(value != known[0] for value in known):
            raise ConfigError(
                f"The runs of {label} differ in their {words}, not in their seed alone.",
                "A mean over seeds takes runs that are otherwise alike: leave the others out.",
            )


def common_photos(keys: Sequence[Hashable], photos: Sequence[str | None]) -> list[str]:
    """Returns for each run the digest of the photos that its rows are of, "" where none is stated.

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
