"""The leaderboard: entries, one JSON file each, under a schema; CSV, Markdown and LaTeX that they make.

The same entries make the same bytes. They rank only with entries of the same protocol. Rows reported in
papers, and those kept apart for a reason, stand in blocks of their own and have no rank.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.citymodel.model import lod_in_words
from lodbench.datasets.folder import BOARD_HEAD, REAL_FLIGHTS
from lodbench.errors import DatasetError
from lodbench.evaluation.metrics import LODLOC, is_taken, protocol_named
from lodbench.evaluation.pose_errors import DEFAULT_THRESHOLDS, EVALUATOR_VERSION
from lodbench.reporting import table_heads
from lodbench.reporting.aligned_text import csv_cell, plain_text
from lodbench.reporting.page import facts, markup, rendered
from lodbench.reporting.summaries import common_photos, numbers_of, plugin_metrics, upgraded_split
from lodbench.reporting.tables import RecallTable, format_html, format_latex, format_markdown
from lodbench.storage import digest_of
from lodbench.storage.json_text import parse_json

if TYPE_CHECKING:
    import pandas as pd

Entry = dict[str, Any]

ENTRY_SCHEMA = 1
# Digests of what went into a run that are part of its protocol.
_INPUTS = ("queries", "scene", "masks", "images", "poses", "code")
INDEX = "index.html"
# What the head of a board says of its data.
_HEADS = {REAL_FLIGHTS: BOARD_HEAD}
# What must agree for two rows to rank together. Renderer and seed may differ: they are the method's own.
_SHARED = ("prior", "split", "queries", "scene", "masks", "lod", "tilt", "segmenter", "evaluator")
LABELS = tuple(threshold.label for threshold in DEFAULT_THRESHOLDS)
_PRINTED = (*LABELS, "T.e./R.e.", "IoU")
_NUMBERS = (
    "source", "rank", "method", "variant", "settings", "map", "condition", "split",
    *LABELS, *(f"{label} {end}" for label in LABELS for end in ("low", "high")),
    "median_translation_m", "median_rotation_deg", "mask_iou", "queries", "failed", "hypotheses_per_query",
    "seconds_per_query",
)  # fmt: skip
_PROTOCOL = ("tilt", "segmenter", "renderer", "lod", "seeds", "evaluator", "code", "protocol")
_ORIGIN = (*(f"{name} printed" for name in _PRINTED), "table", "row", "run", "kept apart because", "notes")


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


@dataclass(frozen=True, slots=True)
class Block:
    """Entries that stand together."""

    title: str  # what they have in common
    entries: tuple[Entry, ...]  # best first; those of a paper's table in its order
    ranks: tuple[int | None, ...]  # by entry; None does not rank
    photos: str = ""  # a digest of those it is of, where others of its protocol are of others; else ""


def build_leaderboard(root: Path) -> dict[Path, str]:
    """Returns the text of every file that the entries below ``root`` make, by path.

    Raises:
        DatasetError: An entry is malformed.
    """
    datasets: dict[str, list[Entry]] = {}
    for entry in read_entries(root):
        datasets.setdefault(slug(entry["dataset"]["name"]), []).append(entry)
    if not datasets:
        return {}
    boards = [
        (
            name,
            _HEADS.get(name, ""),
            facts(Counter(entry["source"] for entry in members)),
            best_of(blocks_of(members)),
        )
        for name, members in datasets.items()
    ]
    texts = {root / INDEX: rendered("leaderboard_index.html.jinja", boards=boards)}
    for name, entries in datasets.items():
        blocks = blocks_of(entries)
        tables = [_table(block) for block in blocks]
        texts[root / f"{name}.csv"] = format_leaderboard_csv(blocks)
        head = _HEADS.get(name, "")
        title = f"# {name}\n\n" + (f"{head}\n\n" if head else "")
        texts[root / f"{name}.md"] = title + "\n".join(map(format_markdown, tables))
        texts[root / f"{name}.tex"] = "\n".join(map(format_latex, tables))
        files = [
            path.relative_to(root).as_posix() for path in sorted((root / "entries" / name).glob("*.json"))
        ]
        pieces = [markup(format_html(_page_table(block))) for block in blocks]
        texts[root / f"{name}.html"] = rendered(
            "leaderboard.html.jinja", name=name, head=head, tables=pieces, files=files, index=INDEX
        )
    return texts


def best_of(blocks: Sequence[Block]) -> list[dict[str, Any]]:
    """Returns the best row of each block: its title, method, and strictest recall by split."""
    rows = []
    for block in blocks:
        best = min(block.entries, key=_standing)
        label = _labels(block.entries)[0]
        recalls = {
            split: table_heads.finite_text(_recall(values, label), ".2f")
            for split, values in best["splits"].items()
        }
        # Tables that print no recall, as those of masks alone, name nobody best.
        if any(text != "-" for text in recalls.values()):
            line = _line(best, None, table_heads.settings_apart(block.entries)[block.entries.index(best)])
            name = f"{line.group_text()} {line.label}".removesuffix(" -").strip()
            rows.append({"title": block.title, "name": name, "label": label, "recalls": recalls})
    return rows


def blocks_of(entries: Sequence[Entry]) -> list[Block]:
    """Returns the entries of one dataset in blocks: ranked, then kept apart, then reported by table."""
    keys = [_group(entry) for entry in entries]
    photos = common_photos(keys, [entry["protocol"].get("images") for entry in entries])
    groups: dict[tuple[int, str, str], dict[str, list[Entry]]] = {}
    for key, photo_set, entry in zip(keys, photos, entries, strict=True):
        groups.setdefault(key, {}).setdefault(photo_set, []).append(entry)
    return [
        _block(key, members, photo_set if len(by_photos) > 1 else "")
        for key, by_photos in sorted(groups.items())
        for photo_set, members in sorted(by_photos.items())
    ]


def protocol_digest(entry: Entry) -> str:
    """Returns a digest of all that two entries must share to be compared, the photos they looked at aside."""
    protocol = entry["protocol"]
    bins = [protocol["bins"]] if "bins" in protocol else []
    return digest_of([entry["dataset"], *(protocol.get(name) for name in _SHARED), *bins])


def leaderboard_frame(blocks: Sequence[Block]) -> pd.DataFrame:
    """Returns one row per entry and split, with values, intervals, and cells as printed."""
    import pandas as pd

    rows = [
        _row_of(entry, rank, name, split) | _protocol_of(entry, block) | {"settings": settings}
        for block in blocks
        for entry, rank, settings in zip(
            block.entries, block.ranks, table_heads.settings_apart(block.entries), strict=True
        )
        for name, split in entry["splits"].items()
    ]
    # Recalls, medians and counts first; then whatever metrics there are; then where it comes from.
    known = set(_NUMBERS) | {*_PROTOCOL, *_ORIGIN}
    # Bins of other protocols come with the metrics.
    metrics = dict.fromkeys(name for row in rows for name in row if name not in known)
    return pd.DataFrame(rows, columns=[*_NUMBERS, *metrics, *_PROTOCOL, *_ORIGIN], dtype=object)


def format_leaderboard_csv(blocks: Sequence[Block]) -> str:
    """Returns ``leaderboard_frame`` as CSV that no spreadsheet takes for formulas."""
    frame = leaderboard_frame(blocks)
    cells = frame.where(frame.notna(), None).map(csv_cell)
    return str(cells.to_csv(index=False, lineterminator="\n"))


def _row_of(entry: Entry, rank: int | None, name: str, split: dict[str, Any]) -> dict[str, Any]:
    method, protocol, origin = entry["method"], entry["protocol"], entry["provenance"]
    bounds, printed = split.get("recall_interval_95", {}), split.get("printed", {})
    names = ("median_translation_m", "median_rotation_deg", "hypotheses_per_query", "seconds_per_query")
    return {
        **split.get("metrics", {}),
        **{"source": entry["source"], "rank": rank, "condition": protocol["condition"], "split": name},
        **{"method": method["name"], "variant": method["variant"], "map": method["map"]},
        **{label: split["recall"].get(label) for label in LABELS},
        **split["recall"],
        **{f"{label} {end}": bounds[label][i] for label in bounds for i, end in enumerate(("low", "high"))},
        **{key: split.get(key) for key in names},
        **{"queries": split["num_queries"], "failed": split["num_failed"]},
        **{key: protocol.get(key) for key in ("tilt", "segmenter", "renderer", "lod", "evaluator", "code")},
        "seeds": " ".join(map(str, protocol["seeds"])),
        **{f"{key} printed": printed.get(key) for key in _PRINTED},
        **{key: origin.get(key) for key in ("table", "row", "run")},
        "kept apart because": "; ".join(entry["ranking"]["reasons"]),
        "notes": "; ".join(origin.get("notes", ())),
    }


def _protocol_of(entry: Entry, block: Block) -> dict[str, str]:
    digest = "" if entry["source"] == "reported" else protocol_digest(entry)
    return {"protocol": f"{digest} {block.photos}".rstrip()}


def _group(entry: Entry) -> tuple[int, str, str]:
    """Returns what block an entry belongs to; blocks are sorted by this."""
    if entry["source"] == "reported":
        return 2, entry["provenance"]["table"], ""
    if not entry["ranking"]["ranked"]:
        return 1, protocol_digest(entry), "; ".join(entry["ranking"]["reasons"])
    return 0, protocol_digest(entry), ""


def _block(key: tuple[int, str, str], members: list[Entry], photos: str) -> Block:
    kind, name, reasons = key
    if kind == 2:
        members = sorted(members, key=lambda entry: entry["provenance"]["order"])
        title = f"Reported by the paper, {name}; not measured here, not ranked"
        return Block(title, tuple(members), (None,) * len(members))
    protocol = members[0]["protocol"]
    lod = f"{lod_in_words(str(protocol['lod']))} · " if protocol.get("lod") else ""
    stated = f"{lod}tilt={protocol['tilt']} · segmenter={protocol['segmenter']} · protocol {name}"
    stated += f" · photos {photos}" if photos else ""
    members = sorted(members, key=_standing)
    if kind == 1:
        return Block(f"Kept apart: {reasons} · {stated}", tuple(members), (None,) * len(members), photos)
    standings = [_standing(entry)[:-1] for entry in members]
    ranks = tuple(standings.index(standing) + 1 for standing in standings)
    return Block(f"Measured · {stated}", tuple(members), ranks, photos)


def _labels(entries: Sequence[Entry]) -> tuple[str, ...]:
    """Returns what recalls of entries of one protocol are called, strictest first, or shares in plan."""
    protocol = protocol_named(str(entries[0]["protocol"].get("bins", LODLOC)))
    labels = tuple(threshold.label for threshold in protocol.thresholds)
    return labels or tuple(f"horizontal_{most:g}m_percent" for most in protocol.horizontal_m)


def _recall(split: dict[str, Any], label: str) -> float | None:
    value: float | None = split["recall"].get(label, split.get("metrics", {}).get(label))
    return value


def _standing(entry: Entry) -> tuple[float | str, ...]:
    """Returns what entries are sorted by: mean recall over splits, strictest first; then mean medians.

    The name comes last, to fix the order of equals; it is no part of a rank.
    """
    splits = list(entry["splits"].values())

    def mean(values: list[float | None], sign: int) -> float:
        known = [value for value in values if value is not None]
        return sign * sum(known) / len(known) if known and len(known) == len(values) else math.inf

    # What is not known is worse than all that is.
    recalls = [mean([_recall(split, label) for split in splits], -1) for label in _labels([entry])]
    medians = [
        mean([split[key] for split in splits], 1) for key in ("median_translation_m", "median_rotation_deg")
    ]
    return (*recalls, *medians, f"{entry['method']['name']} {entry['method']['variant']}")


def _table(block: Block) -> RecallTable:
    settings = table_heads.settings_apart(block.entries)
    lines = [_line(*each) for each in zip(block.entries, block.ranks, settings, strict=True)]
    names = [_line(*each).label for each in zip(block.entries, repeat(None), settings)]
    lines = [
        line if line.group or names.count(name) == 1 else line._replace(label=f"{line.label} [{_own(entry)}]")
        for line, name, entry in zip(lines, names, block.entries, strict=True)
    ]
    return RecallTable(plain_text(block.title), tuple(lines), _columns(block))


def _own(entry: Entry) -> str:
    """Returns what tells an entry from others of its method: the run's folder, and its seeds."""
    seeds = " ".join(map(str, entry["protocol"]["seeds"]))
    return plain_text(f"{entry['provenance']['run']}, seed {seeds}" if seeds else entry["provenance"]["run"])


def _page_table(block: Block) -> RecallTable:
    """Returns a block as its page shows it: with intervals, masks' IoU and time, and links to the entries."""
    table = _table(block)
    lines = tuple(
        line._replace(link=f"entries/{slug(entry['dataset']['name'])}/{entry['file']}")
        for line, entry in zip(table.lines, block.entries, strict=True)
    )
    if all(entry["source"] == "reported" for entry in block.entries):
        return RecallTable(table.title, lines, table.columns)
    labels = [label for label in _labels(block.entries) if "-" in label]
    recalls, others = (
        table_heads.interval_columns(labels)[: len(labels)],
        table_heads.paper_columns(labels)[len(labels) :],
    )
    cost = (
        table_heads.Column("IoU", ("mask_iou",), better=1),
        table_heads.Column("s/query", ("seconds_per_query",), better=-1),
    )
    return RecallTable(table.title, lines, (*recalls, *others, *cost, *_metrics(block)))


def _columns(block: Block) -> tuple[table_heads.Column, ...]:
    """Returns the paper's columns and plug-ins' metrics; of reported rows only those that were printed."""
    if any(entry["source"] != "reported" for entry in block.entries):
        labels = [label for label in _labels(block.entries) if "-" in label]
        return *table_heads.paper_columns(labels), *_metrics(block)
    splits = [split for entry in block.entries for split in entry["splits"].values()]
    printed = {name for split in splits for name in split["printed"]}
    columns = {
        column.head: column
        for column in (*table_heads.paper_columns(LABELS), *table_heads.segmenter_columns(LABELS))
    }
    return tuple(column for head, column in columns.items() if head in printed)


def _metrics(block: Block) -> tuple[table_heads.Column, ...]:
    return table_heads.metric_columns(set().union(*map(plugin_metrics, block.entries)))


def _line(entry: Entry, rank: int | None, settings: str = "") -> table_heads.Line:
    splits = {name: numbers_of(split) for name, split in entry["splits"].items()}
    method, condition = entry["method"], entry["protocol"]["condition"]
    variant = method["variant"].replace("_", " ")
    if entry["source"] == "reported" and method["map"]:
        label = " ".join(filter(None, [variant, condition])) or "-"
        return table_heads.Line(plain_text(label), splits, f"{plain_text(method['name'])} | {method['map']}")
    words = [f"{rank}." if rank else "", method["name"], variant, settings]
    words += [f"({method['map']})" if method["map"] else "", condition]
    is_prior = method["name"] in (table_heads.PRIOR_METHOD, "Prior")
    return table_heads.Line(plain_text(" ".join(filter(None, words))), splits, is_prior=is_prior)
