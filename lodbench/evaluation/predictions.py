"""What a method answered, as it is stored: everything a number is made of, but no truth."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import DatasetError, LodbenchError
from lodbench.geometry import Pose
from lodbench.photos.pictures import decoded, has_too_many_pixels


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """A method's answer to one query.

    Attributes:
        pose: Estimate in the dataset's frame, or None.
        failure: Why there is no estimate, or "".
        score: The method's own measure of fit, or None.
        hypotheses: Poses rendered and compared; None where that is not known.
        seconds: Wall time by stage.
        trace: Best score after each step, by stage; empty where the method tells none.
        probability: What the method said of its being within 2 m and 2 degrees, or None.
        covariance: Upper triangle, row by row (21 numbers), of its error's covariance in x, y, z (metres),
            pitch, roll and yaw (degrees); empty where the method tells none.
        mask_png: The query mask at 602 pixels' width or less, as a PNG of one bit per pixel in base64; ""
            where there is none.
        alternatives: Other poses that fit nearly as well, best first, in the dataset's frame.
        alternative_probabilities: Of each, or empty.
        notes: What the method would have a reader know of its answer.
    """

    pose: Pose | None
    failure: str = ""
    score: float | None = None
    hypotheses: int | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    trace: dict[str, tuple[float, ...]] = field(default_factory=dict, repr=False)
    probability: float | None = None
    covariance: tuple[float, ...] = field(default=(), repr=False)
    mask_png: str = field(default="", repr=False)
    alternatives: tuple[Pose, ...] = ()
    alternative_probabilities: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()

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
