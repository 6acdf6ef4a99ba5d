"""Reading back what a run left in its folder."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from lodbench.datasets.pose_text import parse_pose
from lodbench.errors import DatasetError, LodbenchError
from lodbench.evaluation.errors import FAILED, FAILED_PARTS, ErrorParts, PoseError
from lodbench.evaluation.predictions import Prediction
from lodbench.evaluation.rows import QueryRow, is_without_truth
from lodbench.geometry import Pose
from lodbench.harness.runs.predict import open_predictions
from lodbench.reporting.summaries import read_summary
from lodbench.storage import show_formula

_FOLDER_HINT = "Name a folder that `lodbench run` or `lodbench evaluate` made."
_ERROR_COLUMNS = ("translation_error_m", "rotation_error_deg")
_PRIOR_COLUMNS = ("prior_translation_error_m", "prior_rotation_error_deg")
_PART_COLUMNS = ("horizontal_error_m", "vertical_error_m", "yaw_error_deg")


@dataclass(frozen=True, slots=True, eq=False)
class StoredRun:
    """A run folder's content.

    Attributes:
        folder: The run folder.
        summary: ``summary.json``.
        provenance: ``provenance.json``; empty where there is none.
        predictions: What was answered, by key: the rows' with the masks of the stored predictions.
        rows: ``queries.csv`` with the poses of ``poses.txt``, in the file's order; no times.
        strays: Names in ``poses.txt`` that are no query of the run.
        tilts: What the rows' ``tilt`` column holds.
        digests: SHA-256 of the files that follow from the inputs alone.
    """

    folder: Path
    summary: dict[str, Any]
    provenance: dict[str, Any]
    predictions: dict[str, Prediction]
    rows: tuple[QueryRow, ...]
    strays: tuple[str, ...]
    tilts: frozenset[str]
    digests: dict[str, str]


def read_run(folder: Path) -> StoredRun:
    """Returns the content of a run folder.

    Raises:
        DatasetError: A file is missing or cannot be read; the message names it, and the line.
    """
    summary = read_summary(folder)
    poses = _read_poses(folder / "poses.txt")
    table = _read_table(folder / "queries.csv")
    with_split = len({row["split"] for row in table}) > 1
    rows, used = [], set()
    for number, cells in enumerate(table, start=2):
        name = f"{cells['split']}/{cells['query']}" if with_split else cells["query"]
        used.add(name)
        rows.append(_row(cells, poses.get(name), f"{folder / 'queries.csv'}, line {number}"))
    provenance = folder / "provenance.json"
    files = ["config.yaml", "poses.txt", "queries.csv", "summary.json"]
    files += ["priors.txt"] if (folder / "priors.txt").is_file() else []
    return StoredRun(
        folder=folder,
        summary=summary,
        provenance=_read_json(provenance) if provenance.is_file() else {},
        predictions=_predictions(folder, rows),
        rows=tuple(rows),
        strays=tuple(name for name in poses if name not in used),
        tilts=frozenset(cells["tilt"] for cells in table),
        digests={name: sha256(_read(folder / name).encode()).hexdigest() for name in files},
    )


def _predictions(folder: Path, rows: list[QueryRow]) -> dict[str, Prediction]:
    stored = open_predictions(folder, read_only=True)
    masks = {row.key: stored[row.key].get("mask_png", "") for row in rows if row.key in stored}
    return {row.key: Prediction(row.pose, row.failure, mask_png=masks.get(row.key, "")) for row in rows}


def _read(path: Path) -> str:
    try:
        return path.read_bytes().decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path} cannot be read: {error}.", _FOLDER_HINT) from error


def _read_json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(_read(path))
    except ValueError as error:
        raise DatasetError(f"{path} is not JSON: {error}.", _FOLDER_HINT) from error
    if not isinstance(value, dict):
        raise DatasetError(f"{path} is no JSON object.", _FOLDER_HINT)
    return value


def _read_poses(path: Path) -> dict[str, Pose]:
    """Returns poses by name; unlike those of a dataset the names keep their split."""
    poses: dict[str, Pose] = {}
    for number, line in enumerate(_read(path).splitlines(), start=1):
        words = line.split()
        try:
            if not words or words[0] in poses:
                raise LodbenchError("an empty line or a name that occurs twice")
            poses[words[0]] = parse_pose(words[1:])
        except (LodbenchError, ValueError) as error:
            raise DatasetError(f"{path}, line {number}: {str(error).rstrip('.')}.", _FOLDER_HINT) from error
    return poses


def _read_table(path: Path) -> list[dict[str, str]]:
    reader = csv.DictReader(_read(path).splitlines(), strict=True)
    needed = {"query", "split", "score", "hypotheses", "failure", "tilt", "mask_iou"}
    try:
        rows = list(reader)
    except csv.Error as error:
        raise DatasetError(f"{path}, line {reader.line_num}: {error}.", _FOLDER_HINT) from error
    needed |= {*_ERROR_COLUMNS, *_PRIOR_COLUMNS, *_PART_COLUMNS}
    lacking = sorted(needed - set(reader.fieldnames or ()))
    if lacking:
        raise DatasetError(f"{path} has no column {lacking[0]}.", _FOLDER_HINT)
    if any(None in row or None in row.values() for row in rows):
        raise DatasetError(f"{path} has rows of different lengths.", _FOLDER_HINT)
    for row in rows:
        row.update({name: show_formula(row[name]) for name in ("query", "split", "failure")})
    return rows


def _row(cells: dict[str, str], pose: Pose | None, where: str) -> QueryRow:
    """Returns the row of a line; an empty error is a failure unless there was nothing to compare with."""
    no_truth = is_without_truth(cells["failure"])
    try:
        return QueryRow(
            name=cells["query"],
            split=cells["split"],
            pose=pose,
            score=_number(cells["score"]) if cells["score"] else None,
            hypotheses=int(cells["hypotheses"]) if cells["hypotheses"] else None,
            failure=cells["failure"],
            error=None if no_truth else _error([cells[name] for name in _ERROR_COLUMNS]),
            prior_error=None if no_truth else _error([cells[name] for name in _PRIOR_COLUMNS]),
            seconds={},
            parts=None if no_truth else _parts([cells[name] for name in _PART_COLUMNS]),
            mask_iou=_number(cells["mask_iou"]) if cells["mask_iou"] else None,
            # Runs made before these columns were have none of them.
            probability=_number(cells["probability"]) if cells.get("probability") else None,
            covariance=tuple(_number(value) for value in cells.get("covariance", "").split()),
        )
    except ValueError as error:
        raise DatasetError(f"{where}: {error}.", _FOLDER_HINT) from error


def _error(cells: list[str]) -> PoseError:
    return PoseError(_number(cells[0]), _number(cells[1])) if any(cells) else FAILED


def _parts(cells: list[str]) -> ErrorParts:
    return ErrorParts(*map(_number, cells)) if any(cells) else FAILED_PARTS


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a finite number")
    return value
