"""Recall tables: methods by splits, from summaries of runs; as text, Markdown, CSV, LaTeX and HTML."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lodbench.reporting import table_heads
from lodbench.reporting.aligned_text import count_of, csv_cell, plain_text
from lodbench.reporting.page import rendered
from lodbench.reporting.summaries import (
    common_photos,
    mean_numbers,
    numbers_of,
    require_one_run_a_seed,
    require_seeds_alone,
)
from lodbench.storage import digest_of

if TYPE_CHECKING:
    import pandas as pd


_LABEL = re.compile(r"[\d.e+-]+m-[\d.e+-]+deg")
# What is no number in the rows of a table.
_WORDS = ("group", "method", "split", "is_printed")


@dataclass(frozen=True, slots=True, repr=False)
class RecallTable:
    """Methods over columns of splits."""

    title: str  # what the lines have in common: dataset, tilt, segmenter, seed
    lines: tuple[table_heads.Line, ...]  # top to bottom; the priors' first, where there is one
    columns: tuple[table_heads.Column, ...] = ()  # columns of each split; empty for the paper's
    # The title and a digest of all that the lines share, where that is more: only rows of one protocol
    # compare.
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
        return replace(self, columns=table_heads.columns_named(name, self.labels(), self.numbers()))

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

    def shown(self) -> tuple[table_heads.Column, ...]:
        """Returns the columns of each split."""
        return self.columns or (
            *table_heads.paper_columns(self.labels()),
            *table_heads.protocol_columns(self.numbers()),
        )

    def cells(self, line: table_heads.Line) -> Iterator[tuple[table_heads.Column, Mapping[str, Any] | None]]:
        """Yields the columns of a line with the numbers behind them, all columns of the first split first."""
        for split in self.splits:
            for column in self.shown():
                yield column, line.splits.get(split)

    def texts(self, line: table_heads.Line) -> list[str]:
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
    for summary, key, photo_set in zip(summaries, keys, photos, strict=True):
        groups.setdefault((*key, photo_set), []).append(summary)
    titles = table_heads.titles_of(
        [shared[0] for shared in groups], [members[0] for members in groups.values()]
    )
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
    return table_heads.title_of(summary, free), renderer, *inputs


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
        rows.append(table_heads.Line("Prior", numbers, is_prior=True))
    labelled: dict[str, list[dict[str, Any]]] = {}
    labels = table_heads.labels_of(members, free - {"seed"} if over_seeds else free, others)
    for label, member in zip(labels, members, strict=True):
        labelled.setdefault(label if over_seeds else f"{label}\0{len(labelled)}", []).append(member)
    lines = []
    for label, runs in labelled.items():
        require_one_run_a_seed(label, runs)
        require_seeds_alone(label, runs)
        shown = label.split("\0")[0] + (f" ({count_of(len(runs), 'seeds')})" if over_seeds else "")
        numbers = {name: mean_numbers(runs, name) for name in runs[0]["splits"]}
        lines.append(
            table_heads.Line(shown, numbers, is_prior=runs[0]["method"]["name"] == table_heads.PRIOR_METHOD)
        )
    if len({table_heads.method_name(member) for member in members}) == 1:
        # One method under several settings: in their order, whatever the order of the folders.
        lines.sort(key=lambda row: table_heads.natural(row.label))
    return RecallTable(title, tuple([*rows, *lines]))


def format_text(table: RecallTable) -> str:
    """Returns the table for a terminal."""
    width = len(table.shown())
    head = [["", ""], ["", "method"]]
    for split in table.splits:
        count = table.denominators(split)
        head[0] += [
            plain_text(split) + (f" ({count_of(count, 'queries')})" if count else ""),
            *[""] * (width - 1),
        ]
        head[1] += [column.head for column in table.shown()]
    body = [[group, plain_text(line.label), *table.texts(line)] for group, line in _grouped(table)]
    if not any(row[0] for row in body):
        head, body = [row[1:] for row in head], [row[1:] for row in body]
    firsts = 2 if len(head[0]) > 1 + width * len(table.splits) else 1
    return f"{plain_text(table.title)}\n\n{_align(head, body, width, firsts)}\n"


def format_markdown(table: RecallTable) -> str:
    """Returns the table in Markdown."""
    is_grouped = any(line.group for line in table.lines)
    names = [f"{split} {column.head}" for split in table.splits for column in table.shown()]
    first = ["Method", "Variant"] if is_grouped else ["Method"]
    counts = [f"{split} {table.denominators(split)}" for split in table.splits if table.denominators(split)]
    queries = f" (queries: {_md(', '.join(counts))})" if counts else ""
    lines = [f"**{_md(table.title)}**{queries}", ""]
    lines += [_pipes([*first, *names]), _pipes([*["---"] * len(first), *["--:"] * len(names)])]
    for group, line in _grouped(table):
        lines.append(_pipes([*([group] if is_grouped else []), line.label, *table.texts(line)]))
    return "\n".join(lines) + "\n"


def format_csv(*tables: RecallTable) -> str:
    """Returns tables as one CSV, a line per method and split, every number to ten digits, under one head."""
    frame = frame_of(tables)
    frame.insert(0, "protocol", frame.pop("protocol"))
    words = ["protocol", "group", "method", "split"]
    frame[words] = frame[words].map(csv_cell)
    frame = frame.replace([math.inf, -math.inf], math.nan)
    return str(frame.to_csv(index=False, float_format="%.10g", lineterminator="\n"))


def format_latex(table: RecallTable) -> str:
    """Returns the table as a LaTeX tabular in the paper's layout (needs booktabs, multirow, makecell)."""
    columns = tuple(column for column in table.shown() if column.head != "failed")
    shown = RecallTable(table.title, table.lines, columns)
    is_grouped = any(line.group for line in table.lines)
    firsts, width = (2 if is_grouped else 1), len(columns)
    best = _best(shown)
    rows = []
    for number, (line, follows) in enumerate(zip(table.lines, (None, *table.lines), strict=False)):
        starts = follows is None or follows.group != line.group or not line.group
        cells = [
            rf"\textbf{{{tex(text)}}}" if (number, i) in best and text != "-" else tex(text)
            for i, text in enumerate(shown.texts(line))
        ]
        first = (
            [_tex_group(table, number) if starts else "", tex(line.label)]
            if is_grouped
            else [tex(line.label)]
        )
        if is_grouped and not line.group:
            first = [rf"\multicolumn{{2}}{{l}}{{{tex(line.label)}}}"]
        text = " & ".join([*first, *cells])
        # The end of the row above would take these for its own.
        text = "{}" + text if text.startswith(("[", "*")) else text
        rows.append((text, bool(number) and is_grouped and starts))
    return rendered(
        "table.tex.jinja",
        title=plain_text(table.title),
        layout="l" * firsts + "c" * (width * len(table.splits)),
        spans=[rf"\multicolumn{{{width}}}{{c}}{{\textit{{{tex(split)}}}}}" for split in table.splits],
        ends=[(firsts + 1 + i * width, firsts + (i + 1) * width) for i in range(len(table.splits))],
        heads=[tex(column.head).replace("deg", r"$^\circ$") for column in columns] * len(table.splits),
        blank="& " * (firsts - 1),
        rows=rows,
    )


def format_html(table: RecallTable) -> str:
    """Returns the table as an HTML table whose columns a script may sort by ``data-value``."""
    return rendered("table.html.jinja", table=table, isfinite=math.isfinite)


FORMATS: dict[str, Callable[[RecallTable], str]] = {
    "text": format_text,
    "markdown": format_markdown,
    "csv": format_csv,
    "latex": format_latex,
    "html": format_html,
}


def tex(text: str) -> str:
    """Returns plain text with every character that LaTeX gives a meaning made harmless."""
    plain = plain_text(text).replace("\\", "/").replace("~", "-").replace("^", "")
    return re.sub(r"[&%$#_{}]", r"\\\g<0>", plain).replace("±", r"$\pm$").replace("·", r"$\cdot$")


def _best(table: RecallTable) -> set[tuple[int, int]]:
    """Returns the line and place of the best cells of each column, where there is anything to compare.

    The prior is no method; a recall of 0 is nobody's best; a cell of two numbers is best if both are.
    """
    places = [(n, list(table.cells(line))) for n, line in enumerate(table.lines) if not line.is_prior]
    best: set[tuple[int, int]] = set()
    for i in range(len(places[0][1]) if places else 0):
        column: table_heads.Column = places[0][1][i][0]
        rows = {n: cells[i][1] for n, cells in places}
        values = {n: np.multiply(column.better, column.values(row)) for n, row in rows.items() if row}
        known = {n: value for n, value in values.items() if np.isfinite(value).all()}
        if column.better and len(known) > 1:
            most = np.max(list(known.values()), axis=0)
            is_any = column.better < 0 or most[0] > 0
            best |= {(n, i) for n, value in known.items() if is_any and np.array_equal(value, most)}
    return best


def _tex_group(table: RecallTable, start: int) -> str:
    """Returns the cell that names a group and spans its lines; ``name | map`` on two lines."""
    group, count = table.lines[start].group, 0
    while start + count < len(table.lines) and table.lines[start + count].group == group:
        count += 1
    name, _, map_name = group.partition(" | ")
    cell = rf"\makecell[c]{{{tex(name)}\\\textit{{{tex(map_name)}}}}}" if map_name else tex(name)
    return rf"\multirow{{{count}}}{{*}}{{{cell}}}" if count > 1 else cell


def _grouped(table: RecallTable) -> list[tuple[str, table_heads.Line]]:
    befores = (None, *table.lines)
    return [
        ("" if before is not None and before.group == line.group else line.group_text(), line)
        for before, line in zip(befores, table.lines, strict=False)
    ]


def _md(text: str) -> str:
    return html.escape(plain_text(text), quote=False).replace("|", r"\|")


def _pipes(cells: Sequence[str]) -> str:
    return "| " + " | ".join(map(_md, cells)) + " |"


def _align(head: list[list[str]], body: list[list[str]], group: int, firsts: int) -> str:
    """Returns rows in columns: ``firsts`` flush left, others right; the first head row spans ``group``."""
    widths = [max(map(len, column)) for column in zip(head[1], *body, strict=True)]
    for start in range(firsts, len(widths), group):
        missing = len(head[0][start]) - (sum(widths[start : start + group]) + 2 * (group - 1))
        widths[start + group - 1] += max(0, missing)

    def line(row: list[str]) -> str:
        cells = [
            cell.ljust(width) if i < firsts else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        return "  ".join(cells).rstrip()

    spans = [" " * (sum(widths[:firsts]) + 2 * (firsts - 1))]
    for start in range(firsts, len(widths), group):
        spans.append(head[0][start].center(sum(widths[start : start + group]) + 2 * (group - 1)))
    ruler = "-" * (sum(widths) + 2 * (len(widths) - 1))
    return "\n".join(["  ".join(spans).rstrip(), line(head[1]), ruler, *map(line, body)])
