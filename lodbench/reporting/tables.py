"""Recall tables: methods by splits, from summaries of runs, and what rows are called; no formats."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from lodbench.citymodel.lods import lod_in_words
from lodbench.reporting.aligned_text import count_of, plain_text
from lodbench.reporting.summaries import (
    common_photos,
    mean_numbers,
    numbers_of,
    require_one_run_a_seed,
    require_seeds_alone,
)
from lodbench.reporting.table_columns import Column, columns_named, paper_columns, protocol_columns
from lodbench.storage import digest_of

if TYPE_CHECKING:
    import pandas as pd


# Parts of the protocol that may be freed to differ within a table.
FREE = ("lod", "segmenter", "renderer", "tilt", "prior", "seed")
# How names of a segmenter's settings begin.
_OF_SEGMENTER = "segmenter."


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


def titles_of(heads: Sequence[str], summaries: Sequence[dict[str, Any]]) -> list[str]:
    """Returns the titles of tables, given a run of each; those of one dataset say how its data were set."""
    titles = []
    for head, summary in zip(heads, summaries, strict=True):
        peers = [other for other in summaries if _dataset_of(other) == _dataset_of(summary)]
        # The level of detail is in the head, where it is known.
        words = [word for word in _set_apart(summary, peers) if not word.startswith("lod=")]
        titles.append(" · ".join([head, *words]))
    return titles


def _dataset_of(summary: dict[str, Any]) -> tuple[str, str]:
    return summary["dataset"]["name"], summary["dataset"]["version"]


def _set_apart(summary: dict[str, Any], peers: Sequence[dict[str, Any]]) -> list[str]:
    """Returns the settings of a run's data that are not those of its peers, where they are known.

    And those of its segmenter that peers of the same segmenter set otherwise.
    """
    alike = [peer for peer in peers if _segmenter(peer) == _segmenter(summary)]
    known = {key: value for key, value in summary.get("settings", {}).items() if value is not None}
    words = []
    for key, value in known.items():
        others = alike if key.startswith(_OF_SEGMENTER) else peers
        if any(other.get("settings", {}).get(key) != value for other in others):
            words.append(f"{key}={value}")
    return words


def _segmenter(summary: dict[str, Any]) -> str:
    return str(summary["protocol"].get("segmenter"))


def names_of(summaries: Sequence[dict[str, Any]], free: Collection[str] = ()) -> list[str]:
    """Returns a name for each run: its method, and whatever sets it apart from the others; unique.

    Where tilts differ all say theirs: one of them is an oracle.
    """
    labels = labels_of(summaries, free)
    names = []
    for label, summary in zip(labels, summaries, strict=True):
        peers = [other for other, theirs in zip(summaries, labels, strict=True) if theirs == label]
        differing = [*_differing(("tilt",), summaries), *_differing(FREE, peers)]
        words = [
            f"{key}={summary['protocol'].get(key)}" for key in dict.fromkeys(differing) if key not in free
        ]
        names.append(" ".join(dict.fromkeys([label, *words, *_set_apart(summary, peers)])))
    seen: dict[str, int] = {}
    unique = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        unique.append(f"{name} #{seen[name]}" if names.count(name) > 1 else name)
    return unique


def _differing(keys: Sequence[str], summaries: Sequence[dict[str, Any]]) -> list[str]:
    """Returns the parts of the protocol that some summaries do not agree on."""
    return [key for key in keys if len({str(each["protocol"].get(key)) for each in summaries}) > 1]


def natural(text: str) -> list[tuple[float, str]]:
    """Returns what sorts steps=5 before steps=10."""
    words = re.split(r"(\d+(?:\.\d+)?)", text)
    return [(float(word), "") if number % 2 else (0.0, word) for number, word in enumerate(words)]


def method_name(member: dict[str, Any]) -> str:
    """Returns the method of a run's summary with its variant."""
    method = member["method"]
    return " ".join(filter(None, [method["name"], method.get("variant", "").replace("_", " ")]))


def settings_apart(members: Sequence[dict[str, Any]]) -> list[str]:
    """Returns for each run the settings of its method that other runs of that method have otherwise.

    And those that are not the method's defaults, where these are known (``method.settings``).
    """
    texts = []
    for member, words in zip(members, _words_apart(members, (), ()), strict=True):
        named = {word.partition("=")[0] for word in words}
        changed = member["method"].get("settings", {})
        texts.append(
            " ".join([*words, *(f"{key}={_short(changed[key])}" for key in changed if key not in named)])
        )
    return texts


def labels_of(
    members: Sequence[dict[str, Any]], free: Collection[str], others: Sequence[dict[str, Any]] = ()
) -> list[str]:
    """Returns a name for each run: method, variant, and whatever else differs between runs of that method.

    Args:
        members: Summaries of the runs of a table.
        free: Parts of the protocol that may differ within it.
        others: Summaries of all runs shown: a setting that is not its method's default is named where a run
            of that method in another table has it otherwise.
    """
    words = _words_apart(members, free, others)
    return [" ".join([method_name(member), *mine]) for member, mine in zip(members, words, strict=True)]


def _words_apart(
    members: Sequence[dict[str, Any]], free: Collection[str], others: Sequence[dict[str, Any]]
) -> list[list[str]]:
    """Returns for each run the words of ``labels_of`` beside its method's name."""
    names = [method_name(member) for member in members]
    found = []
    for member, name in zip(members, names, strict=True):
        peers = [other for other, theirs in zip(members, names, strict=True) if theirs == name]
        params = member["method"].get("params", {})
        shown = [_params(other) for other in others if method_name(other) == name]
        changed = member["method"].get("settings", {})
        differing = [
            key
            for key in params
            if any(_params(peer).get(key) != params[key] for peer in peers)
            or (key in changed and any(theirs.get(key) != params[key] for theirs in shown))
        ]
        words = [f"{key}={params[key]}" for key in differing]
        words += [f"{key}={member['protocol'].get(key)}" for key in sorted(free)]
        words += [word for word in _set_apart(member, peers) if word.startswith(_OF_SEGMENTER)]
        found.append(words)
    return found


def _params(member: dict[str, Any]) -> dict[str, Any]:
    params: dict[str, Any] = member["method"].get("params", {})
    return params


def _short(value: Any) -> str:
    """Returns a setting as a word; of a path its last name."""
    return Path(value).name if isinstance(value, str) and "/" in value else str(value)


_LABEL = re.compile(r"[\d.e+-]+m-[\d.e+-]+deg")
# What is no number in the rows of a table.
_WORDS = ("group", "method", "split", "is_printed")


# The method that answers with the prior.
PRIOR_METHOD = "prior_only"


class Line(NamedTuple):
    """A method in a table.

    Attributes:
        label: The method, or its variant where ``group`` names the method.
        splits: Numbers by split, in the format of ``numbers_of``.
        group: What lines next to each other have in common: ``method | map``, or "".
        link: Where a page's label leads, or "".
        is_prior: Whether it is what methods start from: never the best of them.
    """

    label: str
    splits: dict[str, dict[str, Any]]
    group: str = ""
    link: str = ""
    is_prior: bool = False

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
        return self.columns or (*paper_columns(self.labels()), *protocol_columns(self.numbers()))

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

    Runs over other queries, masks, photos or another city never share a table, whatever their names.

    Args:
        summaries: ``summary.json`` of each run.
        free: Parts of the protocol that may differ within a table: its rows then say which they have.
        over_seeds: Whether runs that differ in their seed alone become one row, mean and spread.

    Raises:
        ConfigError: Runs that would become one row have the same seed, or other code, settings or inputs.
    """
    free = {*free, "seed"} if over_seeds else set(free)
    keys = [_shared(summary, free) for summary in summaries]
    photos = common_photos(keys, [summary["dataset"].get("images") for summary in summaries])
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for summary, key, seen in zip(summaries, keys, photos, strict=True):
        groups.setdefault((*key, seen), []).append(summary)
    titles = titles_of([shared[0] for shared in groups], [members[0] for members in groups.values()])
    return [
        replace(
            _table(title, members, free, over_seeds, summaries), protocol=f"{title} · {digest_of(shared)}"
        )
        for title, (shared, members) in zip(titles, groups.items(), strict=True)
    ]


def frame_of(tables: Sequence[RecallTable]) -> pd.DataFrame:
    """Returns every number of some tables: those of ``RecallTable.frame``, and the column ``protocol``."""
    import pandas as pd

    frames = [table.frame().assign(protocol=table.protocol or table.title) for table in tables]
    return pd.concat(frames, ignore_index=True)


def _shared(summary: dict[str, Any], free: Collection[str]) -> tuple[str, ...]:
    """Returns what a run shares with all runs of its table, photos aside; first the table's title."""
    inputs = [str(summary["dataset"].get(name, "")) for name in _fixed_inputs(summary, free)]
    renderer = "" if "renderer" in free else str(summary["protocol"].get("renderer", ""))
    return title_of(summary, free), renderer, *inputs


def _fixed_inputs(summary: dict[str, Any], free: Collection[str]) -> list[str]:
    """Returns the digests that must agree: another level is another scene, another segmenter other masks.

    Other priors, which another seed draws too, are other ``queries``: of these the names must agree then.
    """
    is_drawn = summary["protocol"].get("prior", "file") != "file"
    has_own_priors = "prior" in free or ("seed" in free and is_drawn)
    names = ["names" if has_own_priors and "names" in summary["dataset"] else "queries"]
    names += [] if "lod" in free else ["scene"]
    return names + ([] if "segmenter" in free else ["masks"])


def _table(
    title: str,
    members: list[dict[str, Any]],
    free: set[str],
    over_seeds: bool,
    others: Sequence[dict[str, Any]],
) -> RecallTable:
    rows = []
    priors = [member["prior"] for member in members]
    if all(prior == priors[0] for prior in priors):
        numbers = {split: numbers_of(value) for split, value in priors[0].items()}
        rows.append(Line("Prior", numbers, is_prior=True))
    labelled: dict[str, list[dict[str, Any]]] = {}
    labels = labels_of(members, free - {"seed"} if over_seeds else free, others)
    for label, member in zip(labels, members, strict=True):
        labelled.setdefault(label if over_seeds else f"{label}\0{len(labelled)}", []).append(member)
    found = []
    for label, runs in labelled.items():
        require_one_run_a_seed(label, runs)
        require_seeds_alone(label, runs)
        shown = label.split("\0")[0] + (f" ({count_of(len(runs), 'seeds')})" if over_seeds else "")
        numbers = {name: mean_numbers(runs, name) for name in runs[0]["splits"]}
        found.append(Line(shown, numbers, is_prior=runs[0]["method"]["name"] == PRIOR_METHOD))
    if len({method_name(member) for member in members}) == 1:
        # One method under several settings: in their order, whatever the order of the folders.
        found.sort(key=lambda row: natural(row.label))
    return RecallTable(title, tuple([*rows, *found]))
