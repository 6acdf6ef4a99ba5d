"""`lodbench leaderboard add|build`: rows that were verified, and the tables they make."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from lodbench.cli.parser import Parser
from lodbench.cli.verify import DataOptions, describe, read_config, run_folders, verify_folder
from lodbench.datasets.prior_sources import prior_digest
from lodbench.errors import DatasetError
from lodbench.evaluation.queries import has_truth
from lodbench.harness.runs.inputs import split_digest
from lodbench.harness.runs.verify import Verdict
from lodbench.methods.registry import changed_settings
from lodbench.params import add_options, flag, options_of, part, word
from lodbench.reporting.leaderboard import build_leaderboard
from lodbench.reporting.leaderboard_entry import (
    Entry,
    entry_path,
    entry_text,
    measured_entry,
    read_entries,
    reasons_against,
)
from lodbench.reporting.summaries import with_plugin_metrics, without_metrics
from lodbench.storage import make_folder, write_text

_ROOT = "its folder (leaderboard)"


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


OPTIONS = {f"leaderboard {name}": kind for name, (kind, *_) in _ACTIONS.items()}


def main(argv: Sequence[str]) -> int:
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
    reasons = [*reasons_against(config, _sizes(verdict), inputs), *_doubts(verdict)]
    entry = measured_entry(
        with_plugin_metrics(without_metrics(verdict.stored.summary, verdict.unknown), verdict.computed),
        verdict.stored.provenance,
        digests=_digests(verdict),
        run=run.resolve().name,
        map_name=options.map,
        reasons=reasons,
        settings=changed_settings(config["method"]),
    )
    text, path = entry_text(entry), entry_path(options.root, entry)
    twin = _twin(options.root, path, entry)
    if twin is not None:
        raise DatasetError(f"{run} is a copy of a run that has an entry: {twin}.", "Each run is ranked once.")
    make_folder(path.parent)
    write_text(path, text)
    sys.stdout.write(f"{path}\n" + "".join(f"  kept out of the ranking: {reason}\n" for reason in reasons))
    return 0


def _twin(root: Path, path: Path, entry: Entry) -> Path | None:
    """Returns another entry of the very same files, or None."""
    files = entry["provenance"]["files"]
    for other in read_entries(root) if (root / "entries").is_dir() else ():
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
    texts = build_leaderboard(root)
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
