"""`lodbench compare RUN ...`: finished runs side by side, with paired tests."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lodbench.cli.parser import Parser
from lodbench.cli.verify import DataOptions, read_config, reopen_dataset, run_folders
from lodbench.errors import ConfigError, LodbenchError
from lodbench.evaluation.pose_errors import DEFAULT_THRESHOLDS, Threshold
from lodbench.evaluation.queries import PROTOCOLS, has_truth
from lodbench.harness.results import protocol_of, summary_at
from lodbench.harness.runs.compare import (
    agreement,
    answers_apart,
    budget_panels,
    comparison_page,
    paired_comparison,
    require_same_queries,
    why_other_photos,
)
from lodbench.harness.runs.photo_pairs import DrawnRun, photo_pairs_of, read_tags, tags_file_of
from lodbench.harness.runs.stored import StoredRun, read_whole_run, require_writable
from lodbench.harness.runs.verify import changed_files
from lodbench.params import flag, parsed, part, word
from lodbench.reporting.answers import format_answers
from lodbench.reporting.figures import draw_budget
from lodbench.reporting.run_figures import agreement_text, format_apart, format_comparison
from lodbench.reporting.summaries import with_settings
from lodbench.reporting.table_heads import COLUMNS, FREE, names_of
from lodbench.reporting.tables import FORMATS, format_csv, tables_of
from lodbench.storage import make_folder, write_bytes, write_text

_MOST_PANELS = 4
# Of files that a format may replace.
_ENDINGS = {
    "csv": (".csv",), "html": (".html", ".htm"), "latex": (".tex",), "markdown": (".md", ".markdown"),
    "text": (".txt", ".log", ""),
}  # fmt: skip
# Of an option: several words behind it, taken together.
_SEVERAL: dict[str, Any] = {"nargs": "+", "action": "store"}
_EPILOG = """\
Runs share a table if dataset, queries, city, masks, tilt, segmenter and seed agree; --free lets some of
these differ, and the rows then say which they have. Examples:
  lodbench compare RUN RUN                               # side by side, and whether they differ
  lodbench compare runs/demo/*/*                         # all of a dataset; other folders are skipped
  lodbench compare RUN RUN --out compared.html           # a page: curves, map, every photo with both outlines
  lodbench compare runs/demo/lodlocv2/* --over-seeds     # mean and spread over seeds
  lodbench compare RUN ... --free lod --columns details  # levels of detail in one table
  lodbench compare RUN ... --budget pictures             # recall over poses drawn, a line a method
"""


@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """What the command is given."""

    runs: tuple[Path, ...] = word("run folders", metavar="RUN")
    format: str = flag(
        None,
        "text, or by the ending of --out; html is a page: of two runs, every photo with both outlines",
        choices=sorted(FORMATS),
    )
    out: Path | None = flag(None, "write there, and not to the terminal", metavar="FILE")
    columns: tuple[str, ...] = flag(
        (),
        f"what to show (paper): {', '.join(sorted(COLUMNS))}, or any number by its name in CSV",
        metavar="COLUMNS",
        **_SEVERAL,
    )
    thresholds: tuple[str, ...] = flag(
        (),
        f"where to measure recall, or a name: {', '.join(PROTOCOLS)} (the dataset's own)",
        metavar="M/DEG",
        **_SEVERAL,
    )
    free: tuple[str, ...] = flag((), "what may differ within a table", choices=FREE, **_SEVERAL)
    over_seeds: bool = flag(False, "one row for runs that differ in their seed: mean +- spread")
    budget: Path | None = flag(
        None,
        "write budget.png and budget.svg there: recall over poses drawn per query, a line a method",
        metavar="FOLDER",
    )
    data: DataOptions = part(DataOptions)

    def __post_init__(self) -> None:
        is_page = self.out is not None and self.out.suffix.lower() in _ENDINGS["html"]
        object.__setattr__(self, "format", self.format or ("html" if is_page else "text"))


OPTIONS = {"compare": CompareOptions}


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    options = parsed(Parser("lodbench compare", "Compare finished runs.", _EPILOG), argv, CompareOptions)
    folders = run_folders(options.runs)
    require_writable(options.out, folders, endings=_ENDINGS[options.format])
    configs = [read_config(folder) for folder in folders]
    runs = [read_whole_run(folder) for folder in folders]
    for run in runs:
        for line in changed_files(run):
            sys.stderr.write(f"lodbench: {run.folder}: {line}: edited by hand?\n")
    thresholds = parse_thresholds(options.thresholds)
    runs = [
        replace(run, summary=with_settings(run.summary, config, run.provenance.get("city_model")))
        for run, config in zip(runs, configs, strict=True)
    ]
    summaries = [summary_at(run, thresholds or None) for run in runs]
    # Tests are at the bins of the first run, which others are compared with.
    thresholds = thresholds or protocol_of(runs[0]).thresholds or DEFAULT_THRESHOLDS
    scored = [summary for run, summary in zip(runs, summaries, strict=True) if has_truth(run.queries).any()]
    _require_truth(options, len(runs) - len(scored), len(scored))
    tables = tables_of(scored, options.free, options.over_seeds)
    shown = [table.with_columns(columns) for table in tables for columns in options.columns or ("paper",)]
    names = names_of(summaries, options.free)
    if options.format == "html":
        beside = Path() if options.out is None else options.out.parent
        photos = _photo_by_photo(runs, names, configs, options)
        text = comparison_page(runs, names, shown, thresholds, beside, *photos)
    elif options.format == "csv":
        # It has every number, whatever columns are shown: each row once, under one head.
        text = format_csv(*tables)
    else:
        text = "\n".join(FORMATS[options.format](table) for table in shown)
    if options.format == "text":
        text += "".join(map(_answers, runs, names))
        if len(runs) > 1 and not options.over_seeds:
            text += _tests(runs, names, thresholds)
    if options.out is None:
        sys.stdout.write(text)
    else:
        write_text(options.out, text)
        sys.stdout.write(f"{options.out}\n")
    if options.budget is not None:
        _write_budget(runs, options.budget)
    return 0


def _require_truth(options: CompareOptions, without: int, scored: int) -> None:
    """Says which runs a table of numbers leaves out."""
    if options.columns and not scored:
        raise ConfigError("No run has a truth: there is no table for --columns.", "Leave --columns out.")
    kind = options.format
    if kind in ("text", "html"):
        return
    if not scored:
        raise ConfigError(
            f"No run has a truth, and --format {kind} has nothing but errors and recalls.",
            "--format text or html shows the answers themselves.",
        )
    if without:
        sys.stderr.write(f"lodbench: runs without a truth, left out of --format {kind}: {without}\n")


def _photo_by_photo(
    runs: Sequence[StoredRun],
    names: Sequence[str],
    configs: Sequence[Mapping[str, Any]],
    options: CompareOptions,
) -> tuple[str, str]:
    """Returns the part of the page that shows two runs photo by photo, and why there is none."""
    if len(runs) != 2:
        return "", "Name two runs to see them photo by photo, on one page." if len(runs) > 2 else ""
    first, second = runs
    if reason := why_other_photos(first, second):
        return "", f"Not shown photo by photo: {reason}."
    file = tags_file_of(options.out)
    tags = {} if options.out is None else read_tags(file, first.summary["dataset"])
    if strays := len(tags.keys() - set(first.queries.index) - set(second.queries.index)):
        sys.stderr.write(f"lodbench: {file}: tags of {strays} photos that are in neither run are kept\n")
    drawn, why = _with_data(runs, configs, options)
    beside = Path() if options.out is None else options.out.parent
    return photo_pairs_of((first, second), drawn, (names[0], names[1]), beside, file, tags, why), ""


def _with_data(
    runs: Sequence[StoredRun], configs: Sequence[Mapping[str, Any]], options: CompareOptions
) -> tuple[tuple[DrawnRun, DrawnRun] | None, str]:
    """Returns two runs with their data, or None and why it cannot be had."""
    try:
        one, other = (
            DrawnRun(
                run,
                reopen_dataset(run.folder, options.data.dataset_root, options.data.city_model),
                str(config["tilt"]),
            )
            for run, config in zip(runs, configs, strict=True)
        )
    except LodbenchError as error:
        if options.data.is_given:
            raise
        return None, f"{error.message} {error.hint}".strip()
    return (one, other), ""


def _write_budget(runs: Sequence[StoredRun], folder: Path) -> None:
    """Draws recall over poses drawn."""
    panels = budget_panels([run for run in runs if has_truth(run.queries).any()])
    if not 1 <= len(panels) <= _MOST_PANELS:
        raise ConfigError(
            f"The runs are of {len(panels)} splits and tilts.",
            f"A picture has 1 to {_MOST_PANELS} of them.",
        )
    make_folder(folder)
    for kind, picture in draw_budget(panels).items():
        write_bytes(folder / f"budget.{kind}", picture)
        sys.stdout.write(f"{folder / f'budget.{kind}'}\n")


def _answers(run: StoredRun, name: str) -> str:
    """Returns the answers of a run without a truth; "" for one that has one: its tables say more."""
    if has_truth(run.queries).any():
        return ""
    return f"{name} ({run.folder})\n{format_answers(run.queries, run.predictions)}\n"


def parse_thresholds(words: Sequence[str]) -> tuple[Threshold, ...]:
    """Returns thresholds written as ``metres/degrees``, or by the name of a protocol that has them.

    Raises:
        ConfigError: A word is not two positive numbers, and no such name.
    """
    thresholds: list[Threshold] = []
    for text in words:
        if text in PROTOCOLS:
            thresholds += PROTOCOLS[text].thresholds
            continue
        try:
            metres, degrees = (float(part) for part in text.split("/"))
        except ValueError:
            metres = degrees = 0.0
        if not (0 < metres < float("inf") and 0 < degrees < float("inf")):
            raise ConfigError(f"The threshold {text!r} is not METRES/DEGREES.", "For example 2/2 or 0.5/1.")
        thresholds.append(Threshold(metres, degrees))
    return tuple(thresholds)


def _tests(runs: Sequence[StoredRun], names: Sequence[str], thresholds: tuple[Threshold, ...]) -> str:
    """Returns the paired tests of each run against the first, or why there are none."""
    parts = []
    for run, name in zip(runs[1:], names[1:], strict=True):
        reason = require_same_queries(runs[0], run)
        head = f"\n{name} ({run.folder}) against {names[0]} ({runs[0].folder})"
        if reason:
            parts.append(f"{head}: no paired test: {reason}\n")
        else:
            tests = paired_comparison(runs[0], run, thresholds)
            parts.append(f"{head}\n\n{format_comparison(tests, (names[0], name))}\n")
        together = agreement_text(agreement(runs[0], run))
        parts.append(f"{together}\n" if together else "")
        if together and not has_truth(run.queries).any():
            parts.append(f"\n{format_apart(answers_apart(runs[0], run))}\n")
    return "".join(parts)
