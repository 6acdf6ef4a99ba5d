"""Recall tables: methods by splits, from summaries of runs; formats are elsewhere."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

from lodbench.citymodel.lods import lod_in_words
from lodbench.reporting.safe_text import plain_text
from lodbench.reporting.split_numbers import mean_numbers, numbers_of, require_one_run_a_seed
from lodbench.reporting.table_columns import Column, columns_named, paper_columns
from lodbench.storage import digest_of

if TYPE_CHECKING:
    import pandas as pd

_LABEL = re.compile(r"[\d.e+-]+m-[\d.e+-]+deg")
# Parts of the protocol that may be freed to differ within a table.
FREE = ("lod", "segmenter", "renderer", "tilt", "prior", "seed")
# What is no number in the rows of a table.
_WORDS = ("group", "method", "split", "is_printed")


class Line(NamedTuple):
    """A method in a table.

    Attributes:
        label: The method, or its variant where ``group`` names the method.
        splits: Numbers by split, in the format of ``numbers_of``.
        group: What lines next to each other have in common: ``method | map``, or "".
        link: Where a page's label leads, or "".
    """

    label: str
    splits: dict[str, dict[str, Any]]
    group: str = ""
    link: str = ""

    def group_text(self) -> str:
        """Returns ``name (map)`` of a group ``name | map``."""
        name, _, map_name = plain_text(self.group).partition(" | ")
        return f"{name} ({map_name})" if map_name else name


@dataclass(frozen=True, slots=True, repr=False)
class RecallTable:
    """Methods over columns of splits.

    Attributes:
        title: What the lines have in common: dataset, tilt, segmenter, seed.
        lines: Top to bottom; the priors' first, where there is one.
        columns: Columns of each split; empty for the paper's.
        protocol: The title and a digest of all that the lines share, where that is more: only rows of one
            protocol compare.
    """

    title: str
    lines: tuple[Line, ...]
    columns: tuple[Column, ...] = ()
    protocol: str = ""

    def __repr__(self) -> str:
        return f"RecallTable({self.title}, {len(self.lines)} lines)"

    @property
    def splits(self) -> tuple[str, ...]:
        """Returns the names of the splits, left to right."""
        return tuple(dict.fromkeys(split for line in self.lines for split in line.splits))

    def frame(self) -> pd.DataFrame:
        """Returns every number: a row per method and split, columns group, method, split and the numbers."""
        import pandas as pd

        rows = [
            {"group": line.group, "method": line.label, "split": split, **numbers}
            for line in self.lines
            for split, numbers in line.splits.items()
        ]
        return pd.DataFrame(rows)

    def numbers(self) -> list[str]:
        """Returns the names of all numbers of the table."""
        every = (numbers for line in self.lines for numbers in line.splits.values())
        return list(dict.fromkeys(name for numbers in every for name in numbers if name not in _WORDS))

    def labels(self) -> list[str]:
        """Returns the labels of the thresholds."""
        return [name for name in self.numbers() if _LABEL.fullmatch(name)]

    def with_columns(self, name: str) -> RecallTable:
        """Returns the table with other columns: a group's name, or a number's.

        Raises:
            ConfigError: There is neither.
        """
        return replace(self, columns=columns_named(name, self.labels(), self.numbers()))

    def by_split(self) -> list[RecallTable]:
        """Returns a table of each split."""
        return [
            replace(
                self,
                lines=tuple(
                    line._replace(splits={split: line.splits[split]})
                    for line in self.lines
                    if split in line.splits
                ),
            )
            for split in self.splits
        ]

    def shown(self) -> tuple[Column, ...]:
        """Returns the columns of each split."""
        return self.columns or paper_columns(self.labels())

    def cells(self, line: Line) -> Iterator[tuple[Column, Mapping[str, Any] | None]]:
        """Yields the columns of a line with the numbers behind them, all columns of the first split first."""
        for split in self.splits:
            for column in self.shown():
                yield column, line.splits.get(split)

    def texts(self, line: Line) -> list[str]:
        """Returns the cells of a line as text."""
        return [column.text(numbers) for column, numbers in self.cells(line)]

    def denominators(self, split: str) -> str:
        """Returns the numbers of queries of a split: one, or all there are; "" where none is known."""
        counts = dict.fromkeys(line.splits[split]["queries"] for line in self.lines if split in line.splits)
        return "/".join(str(count) for count in counts if count)


def tables_of(
    summaries: Sequence[dict[str, Any]], free: Collection[str] = (), over_seeds: bool = False
) -> list[RecallTable]:
    """Returns one table per protocol (dataset, tilt, segmenter, seed), the priors' row on top of each.

    Runs over other queries, masks or another city never share a table, whatever their names.

    Args:
        summaries: ``summary.json`` of each run.
        free: Parts of the protocol that may differ within a table: its rows then say which they have.
        over_seeds: Whether runs that differ in their seed alone become one row, mean and spread.

    Raises:
        ConfigError: Two runs that would become one row have the same seed.
    """
    free = {*free, "seed"} if over_seeds else set(free)
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for summary in summaries:
        inputs = [str(summary["dataset"].get(name, "")) for name in _fixed_inputs(summary, free)]
        renderer = "" if "renderer" in free else str(summary["protocol"].get("renderer", ""))
        groups.setdefault((title_of(summary, free), renderer, *inputs), []).append(summary)
    return [
        replace(_table(shared[0], members, free, over_seeds), protocol=f"{shared[0]} · {digest_of(shared)}")
        for shared, members in groups.items()
    ]


def frame_of(tables: Sequence[RecallTable]) -> pd.DataFrame:
    """Returns every number of some tables: those of ``RecallTable.frame``, and the column ``protocol``."""
    import pandas as pd

    frames = [table.frame().assign(protocol=table.protocol or table.title) for table in tables]
    return pd.concat(frames, ignore_index=True)


def title_of(summary: dict[str, Any], free: Collection[str] = ()) -> str:
    """Returns what a run's table is headed with: everything that must agree to compare rows."""
    dataset, protocol = summary["dataset"], summary["protocol"]
    version = f" ({dataset['version']})" if dataset.get("version") else ""
    lod = f" · {lod_in_words(str(protocol['lod']))}" if protocol.get("lod") and "lod" not in free else ""
    words = [f"{name}={protocol[name]}" for name in ("tilt", "segmenter", "seed") if name not in free]
    drawn = protocol.get("prior", "file")
    if drawn != "file" and "prior" not in free:
        words.append(f"priors {drawn}")
    return " · ".join([f"{dataset['name']}{version}{lod}", *words])


def _fixed_inputs(summary: dict[str, Any], free: Collection[str]) -> list[str]:
    """Returns the digests that must agree: another level is another scene, another segmenter other masks.

    Other priors, which another seed draws too, are other ``queries``: of these the names must agree then.
    """
    is_drawn = summary["protocol"].get("prior", "file") != "file"
    has_own_priors = "prior" in free or ("seed" in free and is_drawn)
    names = ["names" if has_own_priors and "names" in summary["dataset"] else "queries"]
    names += [] if "lod" in free else ["scene"]
    return names + ([] if "segmenter" in free else ["masks"])


def _table(title: str, members: list[dict[str, Any]], free: set[str], over_seeds: bool) -> RecallTable:
    rows = []
    priors = [member["prior"] for member in members]
    if all(prior == priors[0] for prior in priors):
        rows.append(Line("Prior", {split: numbers_of(value) for split, value in priors[0].items()}))
    labelled: dict[str, list[dict[str, Any]]] = {}
    labels = _labels(members, free - {"seed"} if over_seeds else free)
    for label, member in zip(labels, members, strict=True):
        labelled.setdefault(label if over_seeds else f"{label}\0{len(labelled)}", []).append(member)
    found = []
    for label, runs in labelled.items():
        require_one_run_a_seed(label, runs)
        shown = label.split("\0")[0] + (f" ({len(runs)} seeds)" if over_seeds else "")
        found.append(Line(shown, {name: mean_numbers(runs, name) for name in runs[0]["splits"]}))
    if len({_name(member) for member in members}) == 1:
        # One method under several settings: in their order, whatever the order of the folders.
        found.sort(key=lambda row: _natural(row.label))
    return RecallTable(title, tuple([*rows, *found]))


def names_of(summaries: Sequence[dict[str, Any]], free: Collection[str] = ()) -> list[str]:
    """Returns a name for each run: its method, and whatever sets it apart from the others; unique.

    Where tilts differ all say theirs: one of them is an oracle.
    """
    labels = _labels(summaries, free)
    names = []
    for label, summary in zip(labels, summaries, strict=True):
        peers = [other for other, theirs in zip(summaries, labels, strict=True) if theirs == label]
        differing = [*_differing(("tilt",), summaries), *_differing(FREE, peers)]
        words = [
            f"{key}={summary['protocol'].get(key)}" for key in dict.fromkeys(differing) if key not in free
        ]
        names.append(" ".join([label, *words]))
    seen: dict[str, int] = {}
    unique = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        unique.append(f"{name} #{seen[name]}" if names.count(name) > 1 else name)
    return unique


def _differing(keys: Sequence[str], summaries: Sequence[dict[str, Any]]) -> list[str]:
    """Returns the parts of the protocol that some summaries do not agree on."""
    return [key for key in keys if len({str(each["protocol"].get(key)) for each in summaries}) > 1]


def _natural(text: str) -> list[tuple[float, str]]:
    """Returns what sorts steps=5 before steps=10."""
    words = re.split(r"(\d+(?:\.\d+)?)", text)
    return [(float(word), "") if number % 2 else (0.0, word) for number, word in enumerate(words)]


def _name(member: dict[str, Any]) -> str:
    method = member["method"]
    return " ".join(filter(None, [method["name"], method.get("variant", "").replace("_", " ")]))


def _labels(members: Sequence[dict[str, Any]], free: Collection[str]) -> list[str]:
    """Returns a name for each run: method, variant, and whatever else differs between runs of that method."""
    names = [_name(member) for member in members]
    labels = []
    for member, name in zip(members, names, strict=True):
        peers = [other for other, theirs in zip(members, names, strict=True) if theirs == name]
        params = member["method"].get("params", {})
        differing = [
            key for key in params if any(p["method"].get("params", {}).get(key) != params[key] for p in peers)
        ]
        words = [f"{key}={params[key]}" for key in differing]
        words += [f"{key}={member['protocol'].get(key)}" for key in sorted(free)]
        labels.append(" ".join([name, *words]))
    return labels
