"""`lodbench compare RUN ...`: runs side by side, with paired tests; `lodbench leaderboard`: ranked runs."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lodbench.cli.parser import Parser
from lodbench.cli.verify import DataOptions, describe, read_config, reopen_dataset, run_folders, verify_folder
from lodbench.datasets.prior_sources import prior_digest
from lodbench.errors import ConfigError, DatasetError, LodbenchError
from lodbench.evaluation.metrics import PROTOCOLS, has_truth
from lodbench.evaluation.pose_errors import DEFAULT_THRESHOLDS, Threshold
from lodbench.harness.results import protocol_of, summary_at
from lodbench.harness.runs import compare
from lodbench.harness.runs.inputs import split_digest
from lodbench.harness.runs.photo_pairs import DrawnRun, photo_pairs_of, read_tags, tags_file_of
from lodbench.harness.runs.stored import StoredRun, read_whole_run, require_writable
from lodbench.harness.runs.verify import Verdict, changed_files
from lodbench.methods.registry import changed_settings
from lodbench.params import add_options, flag, options_of, parsed, part, word
from lodbench.reporting import leaderboard
from lodbench.reporting.answers import format_answers
from lodbench.reporting.figures import agreement_text, draw_budget, format_apart, format_comparison
from lodbench.reporting.summaries import with_plugin_metrics, with_settings, without_metrics
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
_ROOT = "its folder (leaderboard)"


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
        text = compare.comparison_page(runs, names, shown, thresholds, beside, *photos)
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
    if reason := compare.why_other_photos(first, second):
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
    panels = compare.budget_panels([run for run in runs if has_truth(run.queries).any()])
    if not 1 <= len(panels) <= _MOST_PANELS:
        raise ConfigError(
            f"The runs are of {len(panels)} splits and tilts.", f"A picture has 1 to {_MOST_PANELS} of them."
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
        reason = compare.require_same_queries(runs[0], run)
        head = f"\n{name} ({run.folder}) against {names[0]} ({runs[0].folder})"
        if reason:
            parts.append(f"{head}: no paired test: {reason}\n")
        else:
            tests = compare.paired_comparison(runs[0], run, thresholds)
            parts.append(f"{head}\n\n{format_comparison(tests, (names[0], name))}\n")
        together = agreement_text(compare.agreement(runs[0], run))
        parts.append(f"{together}\n" if together else "")
        if together and not has_truth(run.queries).any():
            parts.append(f"\n{format_apart(compare.answers_apart(runs[0], run))}\n")
    return "".join(parts)


@dataclass(frozen=True, kw_only=True)
class AddOptions:
    """What `leaderboard add` is given."""

    runs: tuple[Path, ...] = word("run folders", metavar="RUN")
    map: str = flag("", "what the method localises against, for example 'LoD model'")
    data: DataOptions = part(DataOptions)
    root: Path = flag(Path("leaderboard"), _ROOT)


@dataclass(frozen=True, kw_only=True)
class BuildOptions:
    """What `leaderboard build` is given."""

    check: bool = flag(False, "write nothing; fail if a file is not what they make")
    root: Path = flag(Path("leaderboard"), _ROOT)


_ACTIONS: dict[str, tuple[type, str]] = {
    "add": (
        AddOptions,
        "verify a run and store its row; oracle and unverifiable runs are kept out of the ranking",
    ),
    "build": (BuildOptions, "write CSV, Markdown, LaTeX and pages from the entries"),
}


OPTIONS = {"compare": CompareOptions, **{f"leaderboard {n}": kind for n, (kind, _) in _ACTIONS.items()}}


def main_leaderboard(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = Parser("lodbench leaderboard", description="Rows people can trust.")
    actions = parser.add_subparsers(dest="action", required=True, metavar="add|build")
    for name, (kind, help_) in _ACTIONS.items():
        add_options(actions.add_parser(name, help=help_), kind)
    given = parser.parse_args(argv)
    if given.action == "build":
        built = options_of(given, BuildOptions)
        return _build(built.root, built.check)
    options = options_of(given, AddOptions)
    runs = run_folders(options.runs)
    for run in runs:
        read_config(run)  # all of them are runs, or nothing is stored
    return max(_add(run, options) for run in runs)


def _add(run: Path, options: AddOptions) -> int:
    verdict = verify_folder(run, options.data.dataset_root, options.data.city_model)
    if verdict.differences:
        sys.stdout.write(describe(verdict))
        sys.stderr.write(f"lodbench: {run} was not added: its numbers are not consistent with its poses.\n")
        return 1
    queries = verdict.stored.queries
    has_some = has_truth(queries).groupby(queries["split"]).any()
    if not has_some.all():
        without = ", ".join(map(str, has_some.index[~has_some]))
        raise DatasetError(
            f"{run} has no truth for {without}, without which nothing is scored.",
            "Add a run on data with true poses.",
        )
    inputs = verdict.stored.summary["dataset"]
    config = read_config(run)
    reasons = [*leaderboard.reasons_against(config, _sizes(verdict), inputs), *_doubts(verdict)]
    entry = leaderboard.measured_entry(
        with_plugin_metrics(without_metrics(verdict.stored.summary, verdict.unknown), verdict.computed),
        verdict.stored.provenance,
        digests=_digests(verdict),
        run=run.resolve().name,
        map_name=options.map,
        reasons=reasons,
        settings=changed_settings(config["method"]),
    )
    text, path = leaderboard.entry_text(entry), leaderboard.entry_path(options.root, entry)
    twin = _twin(options.root, path, entry)
    if twin is not None:
        raise DatasetError(f"{run} is a copy of a run that has an entry: {twin}.", "Each run is ranked once.")
    make_folder(path.parent)
    write_text(path, text)
    sys.stdout.write(f"{path}\n" + "".join(f"  kept out of the ranking: {reason}\n" for reason in reasons))
    return 0


def _twin(root: Path, path: Path, entry: leaderboard.Entry) -> Path | None:
    """Returns another entry of the very same files, or None."""
    files = entry["provenance"]["files"]
    for other in leaderboard.read_entries(root) if (root / "entries").is_dir() else ():
        place = path.with_name(other["file"])
        if (
            place != path
            and other["dataset"] == entry["dataset"]
            and other["provenance"].get("files") == files
        ):
            return place
    return None


def _sizes(verdict: Verdict) -> dict[str, int] | None:
    """Returns how many queries the dataset has by split; None where it is not there."""
    if verdict.dataset is None:
        return None
    counts = Counter(entry.split for entry in verdict.dataset.entries)
    return {split: counts[split] for split in verdict.dataset.splits}


def _doubts(verdict: Verdict) -> list[str]:
    """Returns what could not be verified."""
    doubts = ["not verified against the truth: the dataset was not there"] if verdict.is_weak else []
    return doubts + [f"not wholly verified: {note}" for note in verdict.notes]


def _digests(verdict: Verdict) -> dict[str, str]:
    digests = dict(verdict.stored.digests)
    if verdict.entries:
        digests |= {"prior": prior_digest(verdict.entries), "split": split_digest(verdict.entries)}
    return digests


def _build(root: Path, check: bool) -> int:
    texts = leaderboard.build_leaderboard(root)
    if not texts:
        raise DatasetError(f"{root / 'entries'} holds no entries.", "lodbench leaderboard add RUN")
    changed = [
        path for path, text in texts.items() if not (path.is_file() and path.read_bytes() == text.encode())
    ]
    for path in changed:
        if not check:
            write_text(path, texts[path])
        sys.stdout.write(f"{path}{': not what the entries make' if check else ''}\n")
    stale = _stale(root, texts)
    for path in stale:
        sys.stdout.write(f"{path}: no entry makes it any more: remove it\n")
    if not (changed or stale):
        sys.stdout.write(f"{len(texts)} files are what the entries make\n")
    return 1 if check and (changed or stale) else 0


def _stale(root: Path, texts: Collection[Path]) -> list[Path]:
    """Returns the files of boards whose last entry is gone; a board is recognised by its LaTeX."""
    names = {path.stem for path in root.glob("*.tex")} - {path.stem for path in texts}
    files = (
        root / f"{name}{ending}" for name in sorted(names) for ending in (".csv", ".html", ".md", ".tex")
    )
    return [path for path in files if path.is_file()]
