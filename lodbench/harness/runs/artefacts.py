"""A run in memory, and what it leaves in its folder; everything printed can be recomputed from it."""

from __future__ import annotations

import json
import math
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

from lodbench import __version__
from lodbench.citymodel.options import PATH_OPTIONS
from lodbench.datasets.pose_text import format_pose, lines_to_text
from lodbench.datasets.prior_sources import prior_text
from lodbench.datasets.query import Dataset
from lodbench.evaluation.metrics import LODLOC, protocol_named, queries_csv, summarize_queries
from lodbench.evaluation.predictions import Prediction
from lodbench.harness.runs.inputs import words_in
from lodbench.harness.runs.queries import Preparation
from lodbench.plugins import blaming, installed, load_plugin, of_kind
from lodbench.rendering import Scorer
from lodbench.reporting.leaderboard import has_random_weights
from lodbench.reporting.summaries import SUMMARY_SCHEMA
from lodbench.storage import hide_formula, write_text
from lodbench.storage.digest import LIBRARIES, versions_of
from lodbench.storage.paths import is_sealed, seal_of

if TYPE_CHECKING:
    import pandas as pd
# Settings of a configuration's sections that hold a path, and are not the dataset's root and city.
_NAMED = {
    "dataset": ("references", "textured_map", "prior_file"),
    "segmenter": ("weights", "encoder_weights"),
}
# More of them, sealed where they are set: seals of older versions stay good. No run writes the last two.
_NAMED_LATER = {
    "segmenter": ("mask_weights", "folder"), "prior": ("path",), "source.options": PATH_OPTIONS,
}  # fmt: skip
# Sections that may be of a plug-in: which of its settings are paths only its author knows.
_GROUPS = {"dataset": "datasets", "segmenter": "segmenters", "prior": "priors"}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Result:
    """Rows and all that the tables and artefacts say about where they came from."""

    folder: Path  # the run folder
    config: dict[str, Any]  # the resolved configuration
    dataset: Dataset  # the dataset
    splits: tuple[str, ...]  # splits scored, in order
    predictions: Mapping[str, Prediction]  # what was answered, by ``Entry.key``
    queries: pd.DataFrame  # one row per query (``lodbench.evaluation.metrics``)
    inputs: dict[str, str]  # digests of what went in
    lod: str | None  # level of detail localised against; None where no city was opened or it has no name

    def __repr__(self) -> str:
        name = self.config["method"]["name"]
        kind = type(self).__name__
        return f"{kind}({name} on {self.dataset.name}, {len(self.queries)} queries, {self.folder})"

    def seconds_per_query(self, split: str) -> float:
        """Returns the mean wall time of a split's answered queries, NaN if there is none."""
        mine = [self.predictions[key] for key in self.queries.index[self.queries["split"] == split]]
        times = [sum(prediction.seconds.values()) for prediction in mine if prediction.pose is not None]
        return sum(times) / len(times) if times else math.nan


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Run(Result):
    """A finished run, in memory.

    Attributes:
        preparation: How queries were made from entries.
        scorer: The renderer, for pictures.
        resumed: How many rows were taken from an earlier, interrupted run.
    """

    preparation: Preparation
    scorer: Scorer
    resumed: int


def named_by(provenance: dict[str, Any], config: dict[str, Any]) -> list[Any]:
    """Returns what a run's seal is of: all paths in its provenance and its configuration."""
    in_config = [_section(config, section).get(key) for section, keys in _NAMED.items() for key in keys]
    later = [_section(config, section).get(key) for section, key in _later(config)]
    return [provenance.get("dataset_root"), provenance.get("city_model"), *in_config, *later]


def is_own(provenance: dict[str, Any], config: dict[str, Any]) -> bool:
    """Tells whether the run was made with this user's cache, so that the paths it names are this user's."""
    return is_sealed(named_by(provenance, config), provenance.get("seal"))


def without_paths(config: dict[str, Any]) -> dict[str, Any]:
    """Returns a configuration that names no path: those it names count as not set."""
    places = [(section, key) for section, keys in _NAMED.items() for key in keys]
    named = [(section, key) for section, key in places if _is_path(key, _section(config, section).get(key))]
    for section, key in (*named, *_later(config)):
        config = _unset(config, [*section.split("."), key])
    return config


def _later(config: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yields sections and keys that are set and hold a path, of those that older seals are not of."""
    for section, keys in _NAMED_LATER.items():
        values = _section(config, section)
        yield from ((section, key) for key in keys if values.get(key) is not None)
    for section, group in _GROUPS.items():
        values = _section(config, section)
        if not any(part.is_ours and part.name == values.get("name") for part in installed(group)):
            known = (*_NAMED.get(section, ()), *_NAMED_LATER.get(section, ()))
            yield from ((section, key) for key in values if key not in known and _has_path(values[key]))


def _has_path(value: Any) -> bool:
    return any(PurePath(word).name != word or word.startswith("~") for word in words_in(value))


def _is_path(key: str, value: Any) -> bool:
    # A file of priors is looked for in the dataset's folder: as a plain name it stays there.
    return value is not None and not (key == "prior_file" and PurePath(str(value)).name == value)


def _section(config: dict[str, Any], name: str) -> dict[str, Any]:
    section: Any = config
    for key in name.split("."):
        section = section.get(key) if isinstance(section, dict) else None
    return section if isinstance(section, dict) else {}


def _unset(values: dict[str, Any], place: Sequence[str]) -> dict[str, Any]:
    first, *rest = place
    return {**values, first: _unset(values[first], rest) if rest else None}


def write_artefacts(run: Result, config_yaml: str) -> None:
    """Writes config, poses, per-query rows and the summary; and, apart from them, times and provenance.

    ``priors.txt`` has where a method started, before ``tilt``. All but the times and the provenance are
    the same bytes whatever the machine's threads.
    """
    contents = {
        "config.yaml": config_yaml,
        "poses.txt": lines_to_text(_pose_lines(run)),
        "queries.csv": queries_csv(run.queries),
        "summary.json": _json(summary_of(run)),
    }
    if isinstance(run, Run):
        entries = [entry for entry in run.dataset.entries if entry.key in run.queries.index]
        words = _prior_in_words(run.config.get("prior", {"name": "file"}))
        contents["priors.txt"] = prior_text(entries, words, run.config["seed"])
    for name, content in contents.items():
        write_text(run.folder / name, content)
    write_text(run.folder / "timings.csv", _timings_csv(run))
    # What lets a reader see that a file was changed afterwards, down to the last digit of a score.
    digests = {name: sha256(content.encode()).hexdigest() for name, content in contents.items()}
    provenance = {**_provenance(run), "files": digests}
    provenance["seal"] = seal_of(named_by(provenance, run.config))
    write_text(run.folder / "provenance.json", _json(provenance))


def queries_text(folder: Path) -> str:
    """Returns a run folder's per-query rows as they are written; nothing where there are none yet."""
    try:
        return (folder / "queries.csv").read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""


def _crs(run: Result) -> str | None:
    """Returns the reference system of poses; of a dataset's own account whatever text can hold of it."""
    crs = (run.preparation.scene.crs if isinstance(run, Run) else None) or run.dataset.crs
    return None if crs is None else crs.encode("utf-8", "backslashreplace").decode("utf-8")


def summary_of(run: Result) -> dict[str, Any]:
    """Returns the summary: protocol, recalls by split, the priors' own, failures by reason."""
    splits, priors = {}, {}
    bins = run.dataset.protocol
    for split in run.splits:
        estimates, prior = summarize_queries(run.queries, split, protocol_named(bins))
        splits[split], priors[split] = estimates.to_json(), prior.to_json()
    failures = run.queries["failure"][run.queries["failure"] != ""].value_counts()
    config = run.config
    return {
        "schema": SUMMARY_SCHEMA,
        "dataset": {"name": run.dataset.name, "version": run.dataset.version, **run.inputs},
        "method": {
            "name": config["method"]["name"],
            "variant": variant_of(config["method"]),
            "params": {k: v for k, v in config["method"].items() if k not in ("name", "variant", "notes")},
        },
        "protocol": {
            "tilt": config["tilt"],
            "seed": config["seed"],
            "segmenter": config["segmenter"]["name"],
            "renderer": config["renderer"],
            "lod": run.lod,
            "prior": _prior_in_words(config.get("prior", {"name": "file"})),
            **({} if bins == LODLOC else {"bins": bins}),
        },
        "splits": splits,
        "prior": priors,
        "failures": {str(reason): int(count) for reason, count in sorted(failures.items())},
        "notes": list(run.dataset.notes),
        **({"invalid": "random weights"} if has_random_weights(config) else {}),
    }


def _prior_in_words(prior: dict[str, Any]) -> str:
    """Returns the protocol of a configuration's priors; of a file only its digest is known."""
    settings = {key: value for key, value in prior.items() if key not in ("name", "content")}
    kind = load_plugin("priors", prior["name"])
    with blaming("priors", prior["name"], "be described"):
        words = of_kind(kind(**settings).describe(), str)
    return f"of another file ({prior['content']})" if "content" in prior else words


def _pose_lines(run: Result) -> list[str]:
    names = run.queries.index if len(run.splits) > 1 else run.queries["query"]
    poses = [run.predictions[key].pose for key in run.queries.index]
    return [format_pose(name, pose) for name, pose in zip(names, poses, strict=True) if pose is not None]


def _timings_csv(run: Result) -> str:
    import pandas as pd

    seconds = {key: prediction.seconds for key, prediction in run.predictions.items()}
    stages = dict.fromkeys(stage for times in seconds.values() for stage in times)
    names = run.queries[["query", "split"]].map(hide_formula)
    times = pd.DataFrame([seconds[key] for key in run.queries.index], run.queries.index, list(stages))
    frame = pd.concat([names, times.add_suffix("_s")], axis=1)
    return str(frame.to_csv(index=False, lineterminator="\n"))


def _provenance(run: Result) -> dict[str, Any]:
    city = run.dataset.city_model
    return {
        "lodbench": __version__,
        "python": sys.version.split()[0],
        **{name: version for name, version in versions_of(LIBRARIES).items() if version},
        "machine": platform.machine(),
        "system": platform.platform(),
        "city_model": None if city is None else str(Path(city).resolve()),
        "crs": _crs(run),
        "dataset_root": str(Path(run.dataset.root).resolve()),
        **(_work(run) if isinstance(run, Run) else {}),
        "seconds_per_query": {
            split: (None if math.isnan(s := run.seconds_per_query(split)) else s) for split in run.splits
        },
    }


def _work(run: Run) -> dict[str, Any]:
    return {"threads": getattr(run.scorer, "threads", 1), "queries_resumed": run.resumed}


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def variant_of(method: dict[str, Any]) -> str:
    """Returns what tells rows of one method apart in tables: matcher, features, variant; "" for none."""
    words = [str(method[key]) for key in ("matcher", "features") if method.get(key)]
    variant = str(method.get("variant", ""))
    return " ".join(words + ([variant] if variant and not (words and variant == "full") else []))
