"""Heads and lines of tables: columns of what is shown of a split, titles, and what rows are called."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from lodbench.citymodel.model import lod_in_words
from lodbench.errors import ConfigError, nearest_names
from lodbench.reporting.aligned_text import plain_text

if TYPE_CHECKING:
    pass
_SHARES = re.compile(r"(horizontal)_[\d.]+m_percent|beyond_[\d.]+m_[\d.]+deg_percent")
# A count as it is, and a mean of counts to one digit: none of five runs' failures is rounded away.
_COUNT = "count"
# Parts of the protocol that may be freed to differ within a table.
FREE = ("lod", "segmenter", "renderer", "tilt", "prior", "seed")
# How names of a segmenter's settings begin.
_OF_SEGMENTER = "segmenter."
# The method that answers with the prior.
PRIOR_METHOD = "prior_only"


class Column(NamedTuple):
    """What is shown of a split."""

    head: str  # name of the column
    numbers: tuple[str, ...]  # names of the numbers in a cell; more than one are parted by a slash
    spec: str = ".2f"  # how they are written
    better: int = 0  # 1 if more is better, -1 if less is, 0 if neither
    has_bounds: bool = False  # whether the 95 % interval stands behind the number

    def value(self, row: Mapping[str, Any]) -> float:
        """Returns the first number, NaN where there is none: what rows are sorted by."""
        return self.values(row)[0]

    def values(self, row: Mapping[str, Any]) -> tuple[float, ...]:
        """Returns its numbers, NaN for those that are not there."""
        numbers = (row.get(name) for name in self.numbers)
        return tuple(math.nan if value is None else float(value) for value in numbers)

    def text(self, row: Mapping[str, Any] | None) -> str:
        """Returns a cell: what a paper printed where it did, a dash where there is nothing."""
        if row is None:
            return "-"
        if row.get("is_printed") is True:
            printed = row.get(f"{self.head} printed")
            return plain_text(printed) if isinstance(printed, str) else "-"
        text = "/".join(self._number(row, name) for name in self.numbers)
        low, high = (row.get(f"{self.numbers[0]} {end}", math.nan) for end in ("low", "high"))
        low_text, high_text = (
            finite_text(end, ".1f" if self.better > 0 else self.spec) for end in (low, high)
        )
        return f"{text} [{low_text}, {high_text}]" if self.has_bounds and math.isfinite(low) else text

    def _number(self, row: Mapping[str, Any], name: str) -> str:
        text = finite_text(row.get(name, math.nan), self.spec)
        spread = row.get(f"{name} spread", math.nan)
        has_spread = math.isfinite(spread) and text != "-"
        return f"{text} ±{finite_text(spread, self.spec)}" if has_spread else text


def finite_text(value: float | None, spec: str) -> str:
    """Returns a number as text, a dash where it is not finite."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{round(value, 1):.10g}" if spec == _COUNT else format(value, spec)


def paper_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns recalls, both medians in one cell, and the number of failures."""
    medians = Column("T.e./R.e.", ("median_translation_m", "median_rotation_deg"), better=-1)
    return *_recalls(labels), medians, Column("failed", ("failed",), _COUNT, -1)


def protocol_columns(numbers: Sequence[str]) -> tuple[Column, ...]:
    """Returns the shares that only some protocols have: within a distance in plan, and beyond all bins."""
    return tuple(
        Column(name.removesuffix("_percent").replace("_", " "), (name,), better=1 if match[1] else -1)
        for name in numbers
        if (match := _SHARES.fullmatch(name))
    )


def segmenter_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns recalls and the masks' IoU, as in the paper's Table 4."""
    return *_recalls(labels), Column("IoU", ("mask_iou",), better=1)


def detail_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns what the paper's layout leaves out: areas, parts of the error, cost, answered queries."""
    return (
        *_areas(labels),
        *(Column(f"{label} of answered", (f"{label} of answered",), better=1) for label in labels[:1]),
        Column("horizontal m", ("median_horizontal_m",), better=-1),
        Column("vertical m", ("median_vertical_m",), better=-1),
        Column("yaw deg", ("median_yaw_deg",), better=-1),
        Column("hypotheses", ("hypotheses_per_query",), ".0f"),
        Column("s/query", ("seconds_per_query",), better=-1),
    )


def interval_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns recalls, their areas and both medians with their 95 % intervals."""
    columns = (
        *_recalls(labels),
        *_areas(labels),
        Column("T.e.", ("median_translation_m",), better=-1),
        Column("R.e.", ("median_rotation_deg",), better=-1),
    )
    return tuple(column._replace(has_bounds=True) for column in columns)


def calibration_columns(labels: Sequence[str]) -> tuple[Column, ...]:
    """Returns the first recall beside the method's own confidence, ECE and AURC, percent."""
    return (
        *_recalls(labels[:1]),
        Column("mean_confidence", ("mean_confidence_percent",)),
        Column("ece", ("ece_percent",), better=-1),
        Column("aurc", ("aurc_percent",), better=-1),
    )


def metric_columns(names: Collection[str]) -> tuple[Column, ...]:
    """Returns a column of each metric of a plug-in, by name."""
    return tuple(Column(name, (name,)) for name in sorted(names))


COLUMNS: dict[str, Callable[[Sequence[str]], tuple[Column, ...]]] = {
    "calibration": calibration_columns,
    "paper": paper_columns,
    "details": detail_columns,
    "intervals": interval_columns,
    "segmenter": segmenter_columns,
}


def columns_named(name: str, labels: Sequence[str], numbers: Sequence[str]) -> tuple[Column, ...]:
    """Returns the columns of a group in ``COLUMNS``, or the one of a number by its name, a metric's perhaps.

    Raises:
        ConfigError: There is neither.
    """
    if name in COLUMNS:
        return COLUMNS[name](labels)
    if name in numbers:
        return (Column(name, (name,)),)
    raise ConfigError(f"There are no columns {name!r}.", nearest_names(name, [*COLUMNS, *numbers]))


def _recalls(labels: Sequence[str]) -> list[Column]:
    return [Column(label, (label,), better=1) for label in labels]


def _areas(labels: Sequence[str]) -> list[Column]:
    return [Column(f"AUC {label}", (f"AUC {label}",), better=1) for label in labels]


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
    counts: dict[str, int] = {}
    unique = []
    for name in names:
        counts[name] = counts.get(name, 0) + 1
        unique.append(f"{name} #{counts[name]}" if names.count(name) > 1 else name)
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
    per_run = []
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
        per_run.append(words)
    return per_run


def _params(member: dict[str, Any]) -> dict[str, Any]:
    params: dict[str, Any] = member["method"].get("params", {})
    return params


def _short(value: Any) -> str:
    return Path(value).name if isinstance(value, str) and "/" in value else str(value)


class Line(NamedTuple):
    """A method in a table."""

    label: str  # the method, or its variant where ``group`` names the method
    splits: dict[str, dict[str, Any]]  # numbers by split, in the format of ``numbers_of``
    group: str = ""  # what lines next to each other have in common: ``method | map``, or ""
    link: str = ""  # where a page's label leads, or ""
    is_prior: bool = False  # whether it is what methods start from: never the best of them

    def group_text(self) -> str:
        """Returns ``name (map)`` of a group ``name | map``."""
        name, _, map_name = plain_text(self.group).partition(" | ")
        return f"{name} ({map_name})" if map_name else name
