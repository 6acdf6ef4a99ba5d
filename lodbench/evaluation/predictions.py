"""What a method answered, as it is stored, and its errors: the one place where they are made."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.pose_files import is_number
from lodbench.datasets.pose_text import FoundPose, inverted
from lodbench.datasets.query import Entry
from lodbench.errors import DatasetError, LodbenchError
from lodbench.evaluation import metrics
from lodbench.evaluation.pose_errors import FAILED, FAILED_PARTS, error_parts, pose_error
from lodbench.geometry import Pose
from lodbench.photos.pictures import decoded, has_too_many_pixels

if TYPE_CHECKING:
    import pandas as pd

    from lodbench.rendering import Scorer
    from lodbench.rendering.surfaces import Surfaces
# A convention is suspected if reading the poses in another way brings them this many times closer.
_SUSPICIOUS = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """A method's answer to one query."""

    pose: Pose | None  # estimate in the dataset's frame, or None
    failure: str = ""  # why there is no estimate, or ""
    score: float | None = None  # the method's own measure of fit, or None
    hypotheses: int | None = None  # poses rendered and compared; None where that is not known
    seconds: dict[str, float] = field(default_factory=dict)  # wall time by stage
    # Best score after each step, by stage; empty where the method states none.
    trace: dict[str, tuple[float, ...]] = field(default_factory=dict, repr=False)
    probability: float | None = None  # what the method said of its being within 2 m and 2 degrees, or None
    # Upper triangle, row by row (21 numbers), of its error's covariance in x, y, z (metres), pitch, roll
    # and yaw (degrees); empty where the method states none.
    covariance: tuple[float, ...] = field(default=(), repr=False)
    # The query mask at 602 pixels' width or less, as a PNG of one bit per pixel in base64; "" where there
    # is none.
    mask_png: str = field(default="", repr=False)
    # Other poses that fit nearly as well, best first, in the dataset's frame.
    alternatives: tuple[Pose, ...] = ()
    alternative_probabilities: tuple[float, ...] = ()  # of each, or empty
    notes: tuple[str, ...] = ()  # what the method would have a reader know of its answer

    @property
    def mask(self) -> NDArray[np.bool_] | None:
        """Returns the query mask, (H, W), or None."""
        return _decoded(self.mask_png) if self.mask_png else None

    def to_json(self) -> dict[str, Any]:
        """Returns the prediction as JSON values."""
        return {
            "pose": pose_numbers(self.pose),
            "failure": self.failure,
            "score": self.score,
            "hypotheses": self.hypotheses,
            "seconds": self.seconds,
            "trace": {stage: list(scores) for stage, scores in self.trace.items()},
            "probability": self.probability,
            "covariance": list(self.covariance),
            "alternatives": [pose_numbers(pose) for pose in self.alternatives],
            "alternative_probabilities": list(self.alternative_probabilities),
            "notes": list(self.notes),
            "mask_png": self.mask_png,
        }

    @classmethod
    def from_json(cls, value: dict[str, Any], where: str = "A stored prediction") -> Prediction:
        """Returns what ``to_json`` made an object of; what an older one lacks is unknown.

        Args:
            value: JSON values.
            where: File and query, for the message.

        Raises:
            DatasetError: It is of something else.
        """
        try:
            return cls(
                pose=None if value["pose"] is None else _pose(value["pose"]),
                failure=_text(value["failure"]),
                score=_number(value["score"]),
                hypotheses=None if value["hypotheses"] is None else int(value["hypotheses"]),
                seconds={str(stage): float(each) for stage, each in value["seconds"].items()},
                trace={stage: tuple(map(float, scores)) for stage, scores in value.get("trace", {}).items()},
                probability=_number(value.get("probability")),
                covariance=tuple(map(float, value.get("covariance", ()))),
                alternatives=tuple(_pose(numbers) for numbers in value.get("alternatives", ())),
                alternative_probabilities=tuple(map(float, value.get("alternative_probabilities", ()))),
                notes=tuple(map(_text, value.get("notes", ()))),
                mask_png=_text(value.get("mask_png", "")),
            )
        except (LookupError, TypeError, ValueError, AttributeError, OverflowError, LodbenchError) as error:
            reason = f"{type(error).__name__}: {error}"
            hint = "Remove its line, and give the run's command again: it asks that query anew."
            raise DatasetError(f"{where} is no prediction ({reason}).", hint) from error


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r:.40} is no text")
    return value


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def pose_numbers(pose: Pose | None) -> list[float] | None:
    """Returns the twelve numbers of a world-to-camera pose by rows: what digests and files keep."""
    return None if pose is None else [float(v) for v in pose.cam_from_world[:3].ravel()]


def _pose(numbers: Sequence[float]) -> Pose:
    """Returns the pose of the twelve numbers."""
    return Pose.from_matrix(np.reshape([*numbers, 0, 0, 0, 1], (4, 4)))


def encoded_mask(mask: NDArray[np.bool_]) -> str:
    """Returns an (H, W) mask as a PNG of one bit per pixel, in base64."""
    import cv2

    content = cv2.imencode(".png", mask.astype(np.uint8) * 255, [cv2.IMWRITE_PNG_BILEVEL, 1])[1]
    return base64.b64encode(content.tobytes()).decode("ascii")


def _decoded(text: str) -> NDArray[np.bool_]:
    try:
        content = base64.b64decode(text)
    except ValueError as error:
        raise DatasetError(f"A stored mask is not a picture ({error}).") from error
    picture = None if has_too_many_pixels(content) else decoded(content, as_stored=True)
    if picture is None or picture.ndim != 2:
        raise DatasetError("A stored mask is not a picture of a size that is read.")
    return np.asarray(picture > 0)


def evaluate(
    entries: Sequence[Entry],
    predictions: Mapping[str, Prediction],
    truth: Mapping[str, Pose],
    priors: Mapping[str, Pose | None],
    scorer: Scorer | None = None,
    tilt: str = "prior",
    columns: Collection[str] = (),
) -> pd.DataFrame:
    """Returns the table of queries (``lodbench.evaluation.metrics``); poses are in the dataset's frame.

    Args:
        entries: The queries.
        predictions: By ``Entry.key``, one for every query.
        truth: True poses by key; a query without one is in no denominator.
        priors: Where the method started, by key.
        scorer: Renders the city, for the IoU of the masks with its silhouette at the truth; None leaves
            it out.
        tilt: ``prior`` or ``truth``: what the priors have, to be written down.
        columns: Further errors, of ``lodbench.evaluation.metrics``.
    """
    from lodbench.rendering.surfaces import Surfaces

    rows = [
        _row(entry, predictions[entry.key], truth.get(entry.key), priors.get(entry.key), scorer)
        for entry in entries
    ]
    surfaces = None if scorer is None or metrics.GROUND not in columns else Surfaces(scorer.scene)
    for row, entry in zip(rows, entries, strict=True):
        errors = _more_errors(entry, predictions[entry.key].pose, truth.get(entry.key), surfaces)
        row |= {"tilt": tilt, **{name: errors[name] for name in columns}}
    return metrics.queries_frame(rows)


def _more_errors(
    entry: Entry, pose: Pose | None, truth: Pose | None, surfaces: Surfaces | None
) -> dict[str, float]:
    """Returns the camera's errors east and north, and the distance in plan of what the photo's centre shows.

    NaN without a truth, or where the centre shows no ground; inf without an answer.
    """
    if truth is None or pose is None:
        return dict.fromkeys((*metrics.EAST_NORTH, metrics.GROUND), math.nan if truth is None else math.inf)
    east, north, _ = map(float, pose.center - truth.center)
    ground = math.nan
    if surfaces is not None and entry.camera is not None:
        camera = entry.camera
        middle = np.array([0.5 * camera.width - camera.cx, 0.5 * camera.height - camera.cy])
        ray = np.array([middle[0] / camera.fx, middle[1] / camera.fy, 1.0])
        places = [
            surfaces.hit(each.center - surfaces.scene.origin, (ray @ each.rotation)[None]).places[0, :2]
            for each in (truth, pose)
        ]
        away = float(np.hypot(*(places[1] - places[0])))
        # An estimate that looks past the ground is wrong without bounds.
        ground = math.inf if math.isnan(away) and not np.isnan(places[0]).any() else away
    return dict(zip((*metrics.EAST_NORTH, metrics.GROUND), (east, north, ground), strict=True))


def mask_iou_at_truth(
    entry: Entry, prediction: Prediction, truth: Pose | None, scorer: Scorer | None
) -> float | None:
    """Returns the IoU of a stored mask with the model's silhouette at the truth (paper, Table 4); or None."""
    mask = prediction.mask
    if mask is None or truth is None or scorer is None or entry.camera is None:
        return None
    height, width = mask.shape
    pose = truth.shifted(-scorer.scene.origin)
    counts = scorer.counts(entry.camera.scaled(width, height), pose.rotation[None], pose.center[None], mask)
    return float(counts.iou()[0])


def _row(
    entry: Entry, prediction: Prediction, truth: Pose | None, prior: Pose | None, scorer: Scorer | None
) -> dict[str, Any]:
    pose = prediction.pose
    row: dict[str, Any] = {
        "query": entry.name,
        "split": entry.split,
        "score": prediction.score,
        "hypotheses": prediction.hypotheses,
        "failure": _reason(prediction.failure, truth is not None),
        "mask_iou": mask_iou_at_truth(entry, prediction, truth, scorer),
        "probability": prediction.probability,
        "covariance": " ".join(map(repr, prediction.covariance)),
    }
    if truth is not None:
        row |= zip(metrics.ERROR, FAILED if pose is None else pose_error(pose, truth), strict=True)
        row |= zip(metrics.PRIOR_ERROR, FAILED if prior is None else pose_error(prior, truth), strict=True)
        row |= zip(metrics.PARTS, FAILED_PARTS if pose is None else error_parts(pose, truth), strict=True)
    return row


def _reason(failure: str, has_truth: bool) -> str:
    """Returns a row's reason: that there is no truth goes before why there is no estimate."""
    # A carriage return by itself would end a row of queries.csv for who reads it.
    failure = failure.replace("\r\n", "\n").replace("\r", "\n")
    if has_truth or metrics.is_without_truth(failure):
        return failure
    return f"{metrics.NO_TRUTH}; {failure}" if failure else metrics.NO_TRUTH


@dataclass(frozen=True, slots=True)
class Matched:
    """Poses by ``Entry.key``, and what the reader should know."""

    poses: dict[str, Pose]
    notes: tuple[str, ...]


def match_poses(listed: Sequence[FoundPose], entries: Sequence[Entry], format_name: str) -> Matched:
    """Returns the poses of some queries.

    A name means ``split/name``, else the image's file name, else, for formats that keep no ending
    (``c2w``, ``tum``), its stem; folders before it are dropped. TUM lines whose timestamps are no names
    are taken in the order of the queries if there are as many of both, which a note says.

    Raises:
        DatasetError: Two poses are for one query, a name may mean several queries, or none is known.
    """
    index = _index(entries, with_stems=format_name in ("c2w", "tum"))
    unknown = [pose for pose in listed if not _candidates(index, pose.name)]
    if len(unknown) == len(listed):
        if format_name == "tum" and len(listed) == len(entries) and all(is_number(p.name) for p in listed):
            return _by_order(listed, entries)
        raise DatasetError(
            f"No name of the pose file is a query: the first is {listed[0].name!r} ({listed[0].where}).",
            f"The dataset's first query is {entries[0].key}." if entries else "The dataset has no queries.",
        )
    places: dict[str, str] = {}
    poses: dict[str, Pose] = {}
    for name, where, pose, *_ in listed:
        keys = _candidates(index, name)
        if len(keys) > 1:
            raise DatasetError(f"{where}: {name} may be any of {', '.join(keys)}.", "Write split/name.")
        for key in keys:
            if key in places:
                raise DatasetError(f"{where}: {key} has a pose already, from {places[key]}.")
            places[key], poses[key] = where, pose
    loose = [pose for pose in listed if pose.name not in index and _candidates(index, pose.name)]
    return Matched(poses, (*_note_loose(loose, index), *_note_unknown(unknown)))


def suspect_convention(
    poses: Mapping[str, Pose], reference: Mapping[str, Pose], has_quaternions: bool
) -> str | None:
    """Returns a sentence if poses read in another convention lie much closer to true poses or priors, by key.

    Nothing is mended: a benchmark that turns poses by itself scores its own guess. With quaternions the order
    of their components may be the fault.
    """
    shared = [key for key in poses if key in reference]
    if not shared:
        return None
    readings: dict[str, Callable[[Pose], Pose]] = {"in the other direction (camera to world)": inverted}
    if has_quaternions:
        readings["with the quaternion's real part last (x y z w)"] = _real_part_last
        readings["in the other direction and with the quaternion's real part last"] = lambda pose: inverted(
            _real_part_last(pose)
        )

    def medians(read: Callable[[Pose], Pose]) -> tuple[float, float]:
        distance_m, angle_deg = np.median(
            [pose_error(read(poses[key]), reference[key]) for key in shared], axis=0
        )
        # Turning a pose around puts the centre in one place whatever its rotation: then the angle decides.
        return round(float(distance_m), 3), float(angle_deg)

    given, _ = medians(lambda pose: pose)
    best = min(readings, key=lambda name: medians(readings[name]))
    other, _ = medians(readings[best])
    if given <= _SUSPICIOUS * other:
        return None
    return (
        f"the poses are {given:.1f} m from where they should be (median), but read {best} they are "
        f"{other:.1f} m from it: is the convention another? They were scored as given"
    )


def _real_part_last(pose: Pose) -> Pose:
    """Returns the pose whose quaternion was written x y z w and has been read w x y z."""
    x, y, z, w = pose.quat_wxyz
    return Pose.from_quaternion([w, x, y, z], pose.translation.tolist())


def _index(entries: Sequence[Entry], with_stems: bool) -> dict[str, list[str]]:
    index: dict[str, list[str]] = {}
    for entry in entries:
        names = [entry.key, entry.name]
        if with_stems:
            names += [str(PurePosixPath(name).with_suffix("")) for name in names]
        for name in dict.fromkeys(names):
            index.setdefault(name, []).append(entry.key)
    return index


def _candidates(index: Mapping[str, list[str]], name: str) -> list[str]:
    return index.get(name) or index.get(PurePosixPath(name).name, [])


def _by_order(listed: Sequence[FoundPose], entries: Sequence[Entry]) -> Matched:
    times = [float(pose.name) for pose in listed]
    if any(b <= a for a, b in pairwise(times)):
        raise DatasetError("The timestamps do not increase, and they are no names of queries.")
    poses = {entry.key: pose.pose for entry, pose in zip(entries, listed, strict=True)}
    return Matched(poses, ("the timestamps are no names: poses were taken in the order of the queries",))


def _note_loose(loose: Sequence[FoundPose], index: Mapping[str, list[str]]) -> tuple[str, ...]:
    if not loose:
        return ()
    first = loose[0].name
    example = f"{first} as {_candidates(index, first)[0]}"
    return (f"{len(loose)} of the file's names were taken by their file name alone: {example}",)


def _note_unknown(unknown: Sequence[FoundPose]) -> tuple[str, ...]:
    if not unknown:
        return ()
    names = ", ".join(pose.name for pose in unknown[:3]) + (", ..." if len(unknown) > 3 else "")
    return (f"{len(unknown)} of the file's names are no query and were left out: {names}",)
