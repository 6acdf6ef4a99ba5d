"""Reading back what a run left in its folder, finished or not."""

from __future__ import annotations

import html
import io
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.datasets.pose_text import parse_pose
from lodbench.errors import ConfigError, DatasetError, LodbenchError
from lodbench.evaluation import metrics
from lodbench.evaluation.predictions import Prediction
from lodbench.geometry import Pose
from lodbench.harness.runs.predict import open_predictions
from lodbench.reporting import answers, summaries, tables
from lodbench.storage import show_formula
from lodbench.storage.json_text import parse_json

if TYPE_CHECKING:
    import pandas as pd


# What a run wrote itself, and is read back from.
_OWN_FILES = (
    "config.yaml", "ledger.jsonl", "plan.json", "poses.txt", "predictions.jsonl", "priors.txt",
    "provenance.json", "queries.csv", "summary.json",
)  # fmt: skip
_FOLDER_HINT = "Name a folder that `lodbench run` or `lodbench evaluate` made."
# Columns that runs of older versions do not have.
_LATER = {"probability", "covariance"}
# What no run writes anything beyond.
_BOUNDS = {
    **dict.fromkeys((metrics.ERROR[0], metrics.PRIOR_ERROR[0], "hypotheses"), (0.0, math.inf)),
    **dict.fromkeys((metrics.ERROR[1], metrics.PRIOR_ERROR[1]), (0.0, 180.0)),
    **dict.fromkeys(("probability", "mask_iou"), (0.0, 1.0)),
}
PLAN_FILE = "plan.json"


@dataclass(frozen=True, slots=True)
class PictureFile:
    """A PNG on disk, which a notebook shows in its place."""

    path: Path  # the file

    def _repr_png_(self) -> bytes:
        return self.path.read_bytes()


@dataclass(frozen=True, eq=False)
class StoredRun:
    """A run folder's content.

    Attributes:
        folder: The run folder.
        summary: ``summary.json``.
        provenance: ``provenance.json``; empty where there is none.
        queries: ``queries.csv`` as a table, one row per query (``lodbench.evaluation.metrics``).
        poses: Estimates by ``split/query``, in the dataset's frame.
        strays: Names in ``poses.txt`` that are no query of the run.
        digests: SHA-256 of the files that follow from the inputs alone.
    """

    folder: Path
    summary: dict[str, Any]
    provenance: dict[str, Any]
    queries: pd.DataFrame
    poses: dict[str, Pose]
    strays: tuple[str, ...]
    digests: dict[str, str]

    def __repr__(self) -> str:
        method, dataset = self.summary["method"], self.summary["dataset"]
        name = " ".join(filter(None, [method["name"], method["variant"]]))
        return f"StoredRun({name} on {dataset['name']}, {len(self.queries)} queries, {self.folder})"

    def _repr_html_(self) -> str:
        """Returns the tables of the run, or where there is no truth its answers: what a notebook shows."""
        if metrics.has_truth(self.queries).any():
            return "".join(map(tables.format_html, tables.tables_of([self.summary])))
        return f"<pre>{html.escape(answers.format_answers(self.queries, self.predictions))}</pre>"

    @property
    def overlays(self) -> dict[str, PictureFile]:
        """Returns the pictures that the run left, by their names; a notebook shows each."""
        return {path.stem: PictureFile(path) for path in sorted((self.folder / "overlays").glob("*.png"))}

    @cached_property
    def predictions(self) -> dict[str, Prediction]:
        """Returns what was answered, by ``split/query``: the stored predictions with the poses of the run."""
        stored = open_predictions(self.folder, read_only=True)
        failures = self.queries["failure"].items()
        known = {str(key): Prediction(None, failure) for key, failure in failures}
        known |= {
            key: Prediction.from_json(stored[key], f"{self.folder}: {key}") for key in known if key in stored
        }
        return {
            key: replace(prediction, pose=self.poses.get(key), failure=self.queries["failure"][key])
            for key, prediction in known.items()
        }


def require_writable(
    out: Path | None, folders: Sequence[Path], may_be_folder: bool = False, endings: Sequence[str] = ()
) -> None:
    """Checks that what is to be written is none of the files that runs are read from.

    Args:
        out: What is to be written; None for what is beside them by default.
        folders: Of the runs.
        may_be_folder: Whether it may be a folder that is there.
        endings: Of files of its kind; empty where the ending tells nothing.

    Raises:
        ConfigError: It is one of a run's own files, a folder where a file is meant, or a file of another
            kind that is there.
    """
    if out is None:
        return
    if not may_be_folder and (out.is_dir() or not out.name):
        raise ConfigError(f"`--out {str(out)!r}` is a folder.", "Name a file with `--out`.")
    if out.name in _OWN_FILES and out.resolve().parent in [folder.resolve() for folder in folders]:
        raise ConfigError(f"{out} is what the run itself wrote.", "Name another file with `--out`.")
    if endings and out.exists() and out.suffix.lower() not in endings:
        raise ConfigError(
            f"{out} is there already, and is none of {', '.join(filter(None, endings))}.",
            "Name another file with `--out`.",
        )


def read_whole_run(folder: str | Path) -> StoredRun:
    """Returns the content of a run folder whose rows are those that its summary counts.

    Raises:
        DatasetError: As ``read_run``, or rows are missing, or there are more of them.
    """
    run = read_run(folder)
    rows = run.queries["split"][metrics.has_truth(run.queries)].value_counts()
    counts = {split: numbers["num_queries"] for split, numbers in run.summary["splits"].items()}
    hint = f"lodbench verify {run.folder} says what else is not as it was written."
    for split in dict.fromkeys([*counts, *run.queries["split"]]):
        if rows.get(split, 0) != counts.get(split):
            raise DatasetError(
                f"{run.folder / 'queries.csv'} has {rows.get(split, 0)} queries of {split} with a truth, "
                f"summary.json counts {counts.get(split, 'none')}.",
                hint,
            )
    if run.strays:
        stray = run.strays[0]
        raise DatasetError(f"{run.folder / 'poses.txt'}: {stray} is not a query of queries.csv.", hint)
    return run


def read_run(folder: str | Path) -> StoredRun:
    """Returns the content of a run folder.

    Raises:
        DatasetError: A file is missing or cannot be read; the message names it, and the line.
    """
    folder = Path(folder)
    summary = summaries.read_summary(folder)
    poses = _read_poses(folder / "poses.txt")
    queries = _read_queries(folder / "queries.csv")
    names = queries.index if queries["split"].nunique() > 1 else queries["query"]
    keys = dict(zip(names, queries.index, strict=True))
    provenance = folder / "provenance.json"
    files = ["config.yaml", "poses.txt", "queries.csv", "summary.json"]
    files += ["priors.txt"] if (folder / "priors.txt").is_file() else []
    return StoredRun(
        folder=folder,
        summary=summary,
        provenance=_read_provenance(provenance) if provenance.is_file() else {},
        queries=queries,
        poses={keys[name]: pose for name, pose in poses.items() if name in keys},
        strays=tuple(name for name in poses if name not in keys),
        digests={name: sha256(_read(folder / name).encode()).hexdigest() for name in files},
    )


def _read(path: Path) -> str:
    try:
        return path.read_bytes().decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path} cannot be read: {error}.", _FOLDER_HINT) from error


def _read_json(path: Path) -> dict[str, Any]:
    try:
        value = parse_json(_read(path))
    except ValueError as error:
        raise DatasetError(f"{path} is not JSON: {error}.", _FOLDER_HINT) from error
    if not isinstance(value, dict):
        raise DatasetError(f"{path} is not a JSON object.", _FOLDER_HINT)
    return value


def _read_provenance(path: Path) -> dict[str, Any]:
    value = _read_json(path)
    seconds = value.get("seconds_per_query", {})
    times = seconds.values() if isinstance(seconds, dict) else ["none"]
    if not all(time is None or (isinstance(time, int | float) and 0 <= time < math.inf) for time in times):
        raise DatasetError(f"{path}: seconds_per_query holds no seconds by split.", _FOLDER_HINT)
    files = value.get("files", {})
    if not isinstance(files, dict) or not all(isinstance(digest, str) for digest in files.values()):
        raise DatasetError(f"{path}: files holds no digests by name.", _FOLDER_HINT)
    return value


def _read_poses(path: Path) -> dict[str, Pose]:
    """Returns poses by name; unlike those of a dataset the names keep their split."""
    poses: dict[str, Pose] = {}
    for number, line in enumerate(_read(path).splitlines(), start=1):
        # From the right: a name may hold spaces.
        name, *numbers = line.rsplit(maxsplit=7) or [""]
        try:
            if not name or name in poses:
                raise LodbenchError("an empty line or a name that occurs twice")
            poses[name] = parse_pose(numbers)
        except (LodbenchError, ValueError) as error:
            raise DatasetError(f"{path}, line {number}: {str(error).rstrip('.')}.", _FOLDER_HINT) from error
    return poses


def _read_queries(path: Path) -> pd.DataFrame:
    import pandas as pd

    try:
        cells = pd.read_csv(io.StringIO(_read(path)), dtype=str, keep_default_na=False, index_col=False)
    except ValueError as error:  # what pandas' own parser errors are
        raise DatasetError(f"{path}: {str(error).strip()}.", _FOLDER_HINT) from error
    lacking = [name for name in metrics.COLUMNS if name not in cells and name not in _LATER]
    if lacking:
        raise DatasetError(f"{path} has no column {lacking[0]}.", _FOLDER_HINT)
    if cells.isna().any(axis=None):
        raise DatasetError(f"{path} has rows of different lengths.", _FOLDER_HINT)
    columns = {name: cells[name] if name in cells else pd.Series("", cells.index) for name in metrics.COLUMNS}
    columns |= {name: cells[name] for name in metrics.MORE if name in cells}
    columns |= {name: columns[name].map(show_formula) for name in ("query", "split", "failure")}
    numbers = {
        name: _numbers(list(column), path, *_BOUNDS.get(name, (-math.inf, math.inf)))
        for name, column in columns.items()
        if name not in metrics.TEXTS
    }
    frame = metrics.queries_frame(pd.DataFrame({**columns, **numbers}))
    if frame.index.has_duplicates:
        raise DatasetError(f"{path}: {frame.index[frame.index.duplicated()][0]} occurs twice.", _FOLDER_HINT)
    return metrics.fill_failures(frame, ~frame["failure"].map(metrics.is_without_truth).astype(bool))


def _numbers(cells: Sequence[str], path: Path, least: float, most: float) -> list[float]:
    """Returns the finite numbers within bounds of a column's cells, NaN where a cell is empty."""
    numbers = []
    for line, cell in enumerate(cells, start=2):
        try:
            number = float(cell) if cell else math.nan
        except ValueError as error:
            raise DatasetError(f"{path}, line {line}: {error}.", _FOLDER_HINT) from error
        if cell and not (math.isfinite(number) and least <= number <= most):
            within = "" if math.isinf(least) else f" from {least:g} to {most:g}"
            raise DatasetError(f"{path}, line {line}: {cell} is not a finite number{within}.", _FOLDER_HINT)
        numbers.append(number)
    return numbers


@dataclass(frozen=True, slots=True)
class RunStatus:
    """How far a run is; ``seconds_per_query`` is the mean of answered queries, 0 if there is none yet."""

    folder: Path
    num_queries: int
    num_done: int
    failures: dict[str, int]
    seconds_per_query: float
    is_finished: bool

    @property
    def seconds_left(self) -> float:
        """Returns the time that the remaining queries will take, one after another."""
        return self.seconds_per_query * (self.num_queries - self.num_done)


def find_runs(folder: Path) -> list[Path]:
    """Returns a run folder itself, or all below a folder of runs; the folder where there are none."""
    if (folder / PLAN_FILE).is_file():
        return [folder]
    return sorted(plan.parent for plan in folder.rglob(PLAN_FILE)) or [folder]


def read_status(folder: Path) -> RunStatus:
    """Returns how far a run is, whether it is going on, was stopped, or is done.

    Raises:
        DatasetError: The folder holds no run, or a line of its answers is none.
    """
    try:
        keys = [str(key) for key in parse_json((folder / PLAN_FILE).read_text(encoding="utf-8"))["queries"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{folder} holds no run.", "Name a folder that `lodbench run` made.") from error
    stored = open_predictions(folder, read_only=True)
    rows = [Prediction.from_json(stored[key], f"{folder}: {key}") for key in keys if key in stored]
    failures = Counter(row.failure for row in rows if row.failure)
    times = [sum(row.seconds.values()) for row in rows if not row.failure]
    mean = sum(times) / len(times) if times else 0.0
    # A stopped run may stand beside the tables of an earlier, whole one: rows tell, not files alone.
    is_finished = len(rows) == len(keys) and (folder / "summary.json").is_file()
    return RunStatus(folder, len(keys), len(rows), failures, mean, is_finished)
