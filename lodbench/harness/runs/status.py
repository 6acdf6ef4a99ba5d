"""How far a run is, from what it has left in its folder so far."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from lodbench.errors import DatasetError
from lodbench.evaluation.predictions import Prediction
from lodbench.harness.runs.predict import open_predictions
from lodbench.storage.json_text import parse_json

PLAN_FILE = "plan.json"


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
