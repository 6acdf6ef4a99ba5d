"""What `lodbench localize` left in a folder: the answer to one photo, or all as a run that can be exported.

A run's queries are the photos. Files of answers are written by ``harness.photo.localize.write_answer``.
"""

from __future__ import annotations

import csv
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.crs import is_same_plane
from lodbench.datasets.pose_text import parse_camera
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError, LodbenchError
from lodbench.evaluation.metrics import NO_TRUTH, queries_frame
from lodbench.evaluation.predictions import Prediction, encoded_mask
from lodbench.geometry import Camera, Pose
from lodbench.harness.export import Export
from lodbench.harness.photo.flight_inputs import names_of
from lodbench.harness.photo.many import TABLE_FILE
from lodbench.harness.runs.stored import StoredRun
from lodbench.reporting.answers import is_trusted
from lodbench.storage import file_digest, show_formula
from lodbench.storage.json_text import parse_json

if TYPE_CHECKING:
    import pandas as pd

_SPLIT = "localized"
# What the file of an answer has at least.
_KEYS = {"sha256", "photo", "pose", "camera", "crs", "trusted"}


@dataclass(frozen=True, slots=True, eq=False)
class Localized:
    """What ``localize`` wrote of a photo.

    Attributes:
        file: The JSON file.
        digest: SHA-256 of the photo.
        photo: Its name.
        camera: Of the photo as stored.
        pose: In the city's coordinates.
        covariance: (6, 6) of the pose, or None.
        score: Of the method, or None.
        probability: Of a pose within (2 m, 2 deg), or None.
        crs: Of the city, or None.
        is_trusted: Whether the pose is more likely right than wrong.
        trust: In a word.
        is_laser_used: Whether pose and covariance include a laser's range.
    """

    file: Path
    digest: str
    photo: str
    camera: Camera
    pose: Pose
    covariance: NDArray[np.float64] | None
    score: float | None
    probability: float | None
    crs: str | None
    is_trusted: bool
    trust: str
    is_laser_used: bool

    @classmethod
    def read(cls, file: Path, values: Mapping[str, Any]) -> Localized:
        """Returns the answer that the values of a file hold.

        Raises:
            DatasetError: An earlier version wrote it, or it was changed.
        """
        try:
            numbers = {n: None if values[n] is None else float(values[n]) for n in ("score", "probability")}
            covariance = values["covariance"]
            return cls(
                file=file,
                digest=str(values["sha256"]),
                photo=str(values["photo"]),
                camera=parse_camera(values["camera"]["as_stored"].split())[0],
                pose=Pose.from_quaternion(values["pose"]["quat_wxyz"], values["pose"]["translation_m"]),
                covariance=None if covariance is None else np.array(covariance, np.float64).reshape(6, 6),
                crs=values["crs"],
                is_trusted=bool(values["trusted"]),
                trust=str(values["trust"]),
                is_laser_used=bool(values.get("laser_used")),
                **numbers,
            )
        except (LodbenchError, KeyError, TypeError, ValueError, AttributeError) as fault:
            raise DatasetError(
                f"{file} is no answer that can be read ({type(fault).__name__}: {fault}).",
                "An earlier version wrote it, or it was changed: localize the photo again.",
            ) from fault

    def prediction(self) -> Prediction:
        """Returns the answer as a run stores it."""
        whole = () if self.covariance is None else tuple(self.covariance[np.triu_indices(6)].tolist())
        found = Prediction(self.pose, score=self.score, probability=self.probability, covariance=whole)
        if not self.is_trusted and is_trusted(found.probability, found.score, has_mask=False):
            # It was the overlap with a mask that was too small, and any mask says that there was one.
            found = replace(found, mask_png=encoded_mask(np.ones((1, 1), np.bool_)))
        return found


def read_localized(photo: Path, folder: Path) -> Localized:
    """Returns the answer to a photo, which is known by its content.

    Raises:
        DatasetError: The photo or the folder is not there, there is no answer, or it cannot be read.
    """
    if not photo.is_file():
        raise DatasetError(f"The photo {photo} does not exist.", "Check the path.")
    quoted = shlex.quote(str(photo)), shlex.quote(str(folder))
    hint = f"Localise it first: lodbench localize {quoted[0]} --city FILE --out {quoted[1]}"
    if not folder.is_dir():
        raise DatasetError(f"There are no results of lodbench localize in {folder}.", hint)
    digest = file_digest(photo)
    for file, values in _values_in(folder):
        if values["sha256"] == digest:
            return Localized.read(file, values)
    raise DatasetError(f"{folder} holds no pose of {photo.name}.", hint)


@dataclass(frozen=True, eq=False)
class LocalizedFolder(StoredRun):
    """A folder of answers, in the shape of a run without truth."""

    answers: Mapping[str, Prediction] = field(default_factory=dict)

    @cached_property
    def predictions(self) -> dict[str, Prediction]:
        """Returns what was answered, by ``split/query``."""
        return dict(self.answers)


def is_localized(folder: Path) -> bool:
    """Tells whether `lodbench localize`, and no run, wrote its answers into a folder."""
    if not folder.is_dir() or (folder / "summary.json").exists():
        return False
    return (folder / TABLE_FILE).is_file() or next(_values_in(folder), None) is not None


def read_localized_folder(folder: Path) -> Export:
    """Returns the answers in a folder: poses, cameras as stored, and photos that have no pose.

    Of photos with one name, the folders in the table's paths tell them apart.

    Raises:
        DatasetError: There is no pose, an answer cannot be read or is of an earlier version, photos cannot be
            distinguished, or they are of cities in several reference systems.
    """
    rows = list(_table_rows(folder))
    posed = [photo for photo, failure in rows if not failure]
    failed = {photo: failure for photo, failure in rows if failure}
    # Of a photo that was localised before, and could not be again, the earlier answer is still there.
    lost = {photo.name for photo in failed} - {photo.name for photo in posed}
    read = [Localized.read(file, values) for file, values in _values_in(folder)]
    answers = [answer for answer in read if answer.photo not in lost]
    if not answers:
        raise DatasetError(f"{folder} holds no poses.", f"{TABLE_FILE} says why each photo failed.")
    crs = _one_crs(folder, answers)
    names = names_of([*_paths_of(folder, answers, posed), *failed])
    known = [answer.prediction() for answer in answers]
    known += [Prediction(None, failure) for failure in failed.values()]
    predictions = {f"{_SPLIT}/{name}": each for name, each in zip(names, known, strict=True)}
    run = LocalizedFolder(
        folder=folder,
        summary={"method": {"name": "localize", "variant": ""}, "dataset": {"name": folder.name}},
        provenance={"crs": crs},
        queries=_queries(dict(zip(names, known, strict=True))),
        poses={key: each.pose for key, each in predictions.items() if each.pose is not None},
        strays=(),
        digests={},
        answers=predictions,
    )
    entries = tuple(
        Entry(name, _SPLIT, answer.camera, None, None, None)
        for name, answer in zip(names, answers, strict=False)
    )
    return Export(run, Dataset(folder.name, "", folder, None, None, (_SPLIT,), entries, {}), None, crs)


def _values_in(folder: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    for file in sorted(folder.glob("*.json")):
        try:
            values = parse_json(file.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            continue  # a file of somebody else's
        if isinstance(values, dict) and values.keys() >= _KEYS:
            yield file, values


def _table_rows(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yields the photos in the tables of a folder, and why those without a pose have none."""
    for table in sorted(folder.glob(f"{Path(TABLE_FILE).stem}*.csv")):
        try:
            with table.open(encoding="utf-8", newline="") as stream:
                rows = [(Path(show_formula(row["photo"])), row["failure"]) for row in csv.DictReader(stream)]
        except (OSError, ValueError, KeyError, csv.Error):
            continue  # a file of somebody else's
        yield from rows


def _paths_of(folder: Path, answers: Sequence[Localized], posed: Sequence[Path]) -> list[Path]:
    """Returns the photos' files, by the paths in the tables where several photos have one name."""
    counts = Counter(answer.photo for answer in answers)
    repeated = [photo for photo in posed if counts[photo.name] > 1 and photo.is_file()]
    by_digest = {file_digest(photo): photo for photo in repeated}
    paths = []
    for answer in answers:
        if counts[answer.photo] > 1 and answer.digest not in by_digest:
            raise DatasetError(
                f"{folder} has {counts[answer.photo]} answers for {answer.photo}, and the photos that would "
                "tell these apart are not where they were.",
                "Localize each folder of photos into an own one, with `--out`.",
            )
        paths.append(by_digest[answer.digest] if counts[answer.photo] > 1 else Path(answer.photo))
    return paths


def _one_crs(folder: Path, answers: Sequence[Localized]) -> str | None:
    """Returns the reference system of all answers; None for a local frame."""
    first = answers[0]
    for other in answers[1:]:
        if first.crs != other.crs and (
            first.crs is None or other.crs is None or not is_same_plane(first.crs, other.crs)
        ):
            raise DatasetError(
                f"{folder} has poses in {first.crs or 'a local frame'} ({first.photo}) and in "
                f"{other.crs or 'a local frame'} ({other.photo}).",
                "Localize photos of different cities into different folders, with `--out`.",
            )
    return first.crs


def _queries(predictions: Mapping[str, Prediction]) -> pd.DataFrame:
    rows = [
        {
            "query": name,
            "split": _SPLIT,
            "score": prediction.score,
            "failure": "; ".join(filter(None, [NO_TRUTH, prediction.failure])),
            "tilt": "prior",
            "probability": prediction.probability,
            "covariance": " ".join(map(repr, prediction.covariance)),
        }
        for name, prediction in predictions.items()
    ]
    return queries_frame(rows)
