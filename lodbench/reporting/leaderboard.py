"""The leaderboard: from entries to CSV, Markdown and LaTeX, byte for byte the same from the same entries.

Entries rank only with entries of the same protocol. Rows reported in papers, and those kept apart for a
reason, stand in blocks of their own and have no rank.
"""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lodbench.reporting.cells import SplitCells, cells_of
from lodbench.reporting.leaderboard_entry import Entry, read_entries, slug
from lodbench.reporting.leaderboard_page import INDEX, dataset_page, index_page
from lodbench.reporting.safe_text import csv_cell, plain_text
from lodbench.reporting.table_columns import Column, paper_columns, segmenter_columns
from lodbench.reporting.table_formats import format_markdown
from lodbench.reporting.table_latex import format_latex
from lodbench.reporting.tables import RecallTable, TableRow
from lodbench.storage import digest_of

# What must agree for two rows to rank together. Renderer and seed may differ: they are the method's own.
_SHARED = ("prior", "split", "queries", "scene", "masks", "lod", "tilt", "segmenter", "evaluator")
LABELS = ("2m-2deg", "3m-3deg", "5m-5deg")
_PRINTED = (*LABELS, "T.e./R.e.", "IoU")


@dataclass(frozen=True, slots=True)
class Block:
    """Entries that stand together.

    Attributes:
        title: What they have in common.
        entries: Entries, best first where they rank, else in the order of their paper or file.
        ranks: Their ranks, None where they do not rank.
    """

    title: str
    entries: tuple[Entry, ...]
    ranks: tuple[int | None, ...]


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
    texts = {root / INDEX: index_page({name: _sources(entries) for name, entries in datasets.items()})}
    for name, entries in datasets.items():
        blocks = blocks_of(entries)
        tables = [_table(block) for block in blocks]
        texts[root / f"{name}.csv"] = format_leaderboard_csv(blocks)
        texts[root / f"{name}.md"] = f"# {name}\n\n" + "\n".join(map(format_markdown, tables))
        texts[root / f"{name}.tex"] = "\n".join(map(format_latex, tables))
        files = [
            path.relative_to(root).as_posix() for path in sorted((root / "entries" / name).glob("*.json"))
        ]
        texts[root / f"{name}.html"] = dataset_page(name, tables, files)
    return texts


def _sources(entries: Sequence[Entry]) -> dict[str, int]:
    return dict(Counter(entry["source"] for entry in entries))


def blocks_of(entries: Sequence[Entry]) -> list[Block]:
    """Returns the entries of one dataset in blocks: ranked, then kept apart, then reported by table."""
    groups: dict[tuple[int, str, str], list[Entry]] = {}
    for entry in entries:
        groups.setdefault(_group(entry), []).append(entry)
    return [_block(key, members) for key, members in sorted(groups.items())]


def protocol_digest(entry: Entry) -> str:
    """Returns a digest of all that two entries must share to be compared."""
    protocol = entry["protocol"]
    return digest_of([entry["dataset"], *(protocol.get(name) for name in _SHARED)])


def format_leaderboard_csv(blocks: Sequence[Block]) -> str:
    """Returns one line per entry and split, with values, intervals, and cells as printed."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(_HEADER)
    for block in blocks:
        for entry, rank in zip(block.entries, block.ranks, strict=True):
            for name, split in entry["splits"].items():
                writer.writerow([csv_cell(value) for value in _line(entry, rank, name, split)])
    return stream.getvalue()


_HEADER = (
    "source", "rank", "method", "variant", "map", "condition", "split",
    *LABELS, *(f"{label} {end}" for label in LABELS for end in ("low", "high")),
    "median_translation_m", "median_rotation_deg", "mask_iou", "queries", "failed", "hypotheses_per_query",
    "seconds_per_query", "tilt", "segmenter", "renderer", "lod", "seeds", "evaluator", "code", "protocol",
    *(f"{name} printed" for name in _PRINTED), "table", "row", "run", "kept apart because", "notes",
)  # fmt: skip


def _line(entry: Entry, rank: int | None, name: str, split: dict[str, Any]) -> list[Any]:
    method, protocol, origin = entry["method"], entry["protocol"], entry["provenance"]
    is_reported = entry["source"] == "reported"
    intervals, printed = split.get("recall_interval_95", {}), split.get("printed", {})
    return [
        entry["source"],
        rank,
        method["name"],
        method["variant"],
        method["map"],
        protocol["condition"],
        name,
        *(split["recall"].get(label) for label in LABELS),
        *(end for label in LABELS for end in intervals.get(label, (None, None))),
        *(split[key] for key in ("median_translation_m", "median_rotation_deg")),
        split.get("mask_iou"),
        split["num_queries"],
        split["num_failed"],
        split.get("hypotheses_per_query"),
        split.get("seconds_per_query"),
        *(protocol[key] for key in ("tilt", "segmenter", "renderer", "lod")),
        " ".join(map(str, protocol["seeds"])),
        protocol["evaluator"],
        protocol.get("code"),
        "" if is_reported else protocol_digest(entry),
        *(printed.get(key) for key in _PRINTED),
        origin.get("table"),
        origin.get("row"),
        origin.get("run"),
        "; ".join(entry["ranking"]["reasons"]),
        "; ".join(origin.get("notes", ())),
    ]


def _group(entry: Entry) -> tuple[int, str, str]:
    """Returns what block an entry belongs to; blocks are sorted by this."""
    if entry["source"] == "reported":
        return 2, entry["provenance"]["table"], ""
    if not entry["ranking"]["ranked"]:
        return 1, protocol_digest(entry), "; ".join(entry["ranking"]["reasons"])
    return 0, protocol_digest(entry), ""


def _block(key: tuple[int, str, str], members: list[Entry]) -> Block:
    kind, name, reasons = key
    if kind == 2:
        members = sorted(members, key=lambda entry: entry["provenance"]["order"])
        title = f"Reported by the paper, {name}; not measured here, not ranked"
        return Block(title, tuple(members), (None,) * len(members))
    protocol = members[0]["protocol"]
    said = f"tilt={protocol['tilt']} · segmenter={protocol['segmenter']} · protocol {name}"
    members = sorted(members, key=_standing)
    if kind == 1:
        return Block(f"Kept apart: {reasons} · {said}", tuple(members), (None,) * len(members))
    standings = [_standing(entry)[:-1] for entry in members]
    ranks = tuple(standings.index(standing) + 1 for standing in standings)
    return Block(f"Measured · {said}", tuple(members), ranks)


def _standing(entry: Entry) -> tuple[float | str, ...]:
    """Returns what entries are sorted by: mean recall over splits, strictest first; then mean medians.

    The name comes last, to fix the order of equals; it is no part of a rank.
    """
    splits = list(entry["splits"].values())

    def mean(values: list[float | None]) -> float:
        return (
            math.inf
            if not values or None in values
            else sum(v for v in values if v is not None) / len(values)
        )

    recalls = [-mean([split["recall"].get(label, 0.0) for split in splits]) for label in LABELS]
    medians = [
        mean([split[key] for split in splits]) for key in ("median_translation_m", "median_rotation_deg")
    ]
    return (*recalls, *medians, f"{entry['method']['name']} {entry['method']['variant']}")


def _table(block: Block) -> RecallTable:
    splits = tuple(dict.fromkeys(name for entry in block.entries for name in entry["splits"]))
    rows = [
        _row(entry, rank, {name: _cells(split) for name, split in entry["splits"].items()})
        for entry, rank in zip(block.entries, block.ranks, strict=True)
    ]
    return RecallTable(plain_text(block.title), splits, tuple(rows), _columns(block))


def _columns(block: Block) -> tuple[Column, ...]:
    """Returns the paper's columns; of reported rows only those that the paper printed."""
    if any(entry["source"] != "reported" for entry in block.entries):
        return paper_columns(LABELS)
    splits = [split for entry in block.entries for split in entry["splits"].values()]
    printed = {name for split in splits for name in split["printed"]}
    columns = {column.head: column for column in (*paper_columns(LABELS), *segmenter_columns(LABELS))}
    return tuple(column for head, column in columns.items() if head in printed)


def _row(entry: Entry, rank: int | None, cells: dict[str, SplitCells]) -> TableRow:
    """Returns an entry's line; reported ones stand in groups of one method and map, as in the paper."""
    method, condition = entry["method"], entry["protocol"]["condition"]
    variant = method["variant"].replace("_", " ")
    if entry["source"] == "reported" and method["map"]:
        label = " ".join(filter(None, [variant, condition])) or "-"
        return TableRow(plain_text(label), cells, f"{plain_text(method['name'])} | {method['map']}")
    words = [f"{rank}." if rank else "", method["name"], variant]
    words += [f"({method['map']})" if method["map"] else "", condition]
    return TableRow(plain_text(" ".join(filter(None, words))), cells)


def _cells(split: dict[str, Any]) -> SplitCells:
    return replace(cells_of(split), printed=split.get("printed", {}))
