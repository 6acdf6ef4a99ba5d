"""What a finished run leaves in its folder; everything printed can be recomputed from it."""

from __future__ import annotations

import json
import math
import platform
import sys
from hashlib import sha256
from pathlib import Path
from typing import Any

from lodbench import __version__
from lodbench.datasets.pose_text import format_pose, lines_to_text
from lodbench.datasets.prior_sources import prior_text
from lodbench.evaluation.queries import queries_csv, summarize_queries
from lodbench.execution.same_code import LIBRARIES
from lodbench.harness.runs.named_paths import named_by
from lodbench.harness.runs.result import Result
from lodbench.harness.runs.run import Run
from lodbench.plugins import blaming, load_plugin, of_kind
from lodbench.reporting.leaderboard_entry import has_random_weights
from lodbench.reporting.summaries import SUMMARY_SCHEMA
from lodbench.storage import hide_formula, write_text
from lodbench.storage.digest import versions_of
from lodbench.storage.seal import seal_of


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
    for split in run.splits:
        estimates, prior = summarize_queries(run.queries, split)
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
