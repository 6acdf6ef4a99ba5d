"""``segmenter=fastsam``: FastSAM's instances as a building mask, from an ONNX export; AGPL-3.0 weights."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, QueryFault, require_numbers
from lodbench.segmentation.masks import read_photo
from lodbench.segmentation.onnx_file import read_onnx
from lodbench.segmentation.photo_segmenter import PhotoSegmenter
from lodbench.segmentation.probability import resized_photo, working_size
from lodbench.segmentation.weight_files import weights_file

Floats = NDArray[np.float32]
# Never more instances of a photo than this, the likeliest first.
_MOST = 300
# Prototypes are a quarter as long and as wide as the input.
STRIDE = 4


@dataclass(frozen=True, slots=True, eq=False)
class Instances:
    """What a network found in a photo, likeliest first."""

    masks: NDArray[np.bool_]  # (N, H, W) bool, at the size of the network's input
    scores: Floats  # (N,) in [0, 1]
    classes: NDArray[np.int64]  # (N,) numbers of their classes


def decode(rows: Floats, prototypes: Floats, least_score: float, most_overlap: float) -> Instances:
    """Returns the instances behind a network's outputs for one photo.

    A row is an anchor: the centre, width and height of its box in input pixels, a score per class,
    and what its mask takes of each prototype. Of boxes of one class that overlap the likeliest stays.

    Args:
        rows: (4 + classes + P, anchors).
        prototypes: (P, H / 4, W / 4), logits.
        least_score: Anchors less likely than this are nothing.
        most_overlap: IoU of boxes from which on the less likely goes.
    """
    num_classes = len(rows) - 4 - len(prototypes)
    scores, classes = rows[4 : 4 + num_classes].max(axis=0), rows[4 : 4 + num_classes].argmax(axis=0)
    likely = np.flatnonzero(scores >= least_score)
    likely = likely[np.argsort(-scores[likely], kind="stable")]
    corners = _corners(rows[:4, likely])
    kept = likely_apart(corners, scores[likely], classes[likely], most_overlap)
    chosen, corners = likely[kept], corners[kept]
    coefficients = rows[4 + num_classes :, chosen].T
    return Instances(_masks(coefficients, prototypes, corners), scores[chosen], classes[chosen])


def likely_apart(
    corners: Floats, scores: Floats, classes: NDArray[np.int64], most_overlap: float
) -> NDArray[np.int64]:
    """Returns which of (N, 4) boxes stay, at most 300: non-maximum suppression within each class."""
    import cv2

    if not len(scores):
        return np.zeros(0, np.int64)
    boxes = np.concatenate([corners[:, :2], corners[:, 2:] - corners[:, :2]], axis=1)
    kept: Any = cv2.dnn.NMSBoxesBatched(
        boxes.tolist(), scores.tolist(), classes.tolist(), 0.0, most_overlap, top_k=0
    )
    return np.sort(np.asarray(kept, np.int64).ravel())[:_MOST]


def counted(
    instances: Instances, classes: list[int], most_share: float, shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """Returns the (N, H, W) masks of the instances that count.

    Args:
        instances: All instances.
        classes: Numbers of the classes that count; empty for all.
        most_share: Instances that cover more of the photo do not count: ground, sky, a whole quarter.
        shape: Height and width, where nothing was found.
    """
    if not len(instances.masks):
        return np.zeros((0, *shape), np.bool_)
    counts = instances.masks.mean(axis=(1, 2)) <= most_share
    if classes:
        counts &= np.isin(instances.classes, classes)
    return np.asarray(instances.masks[counts])


def _corners(boxes: Floats) -> Floats:
    """Returns (N, 4) left, top, right, bottom of (4, N) centres and sizes."""
    centre, half = boxes[:2].T, boxes[2:].T / 2
    return np.asarray(np.concatenate([centre - half, centre + half], axis=1), np.float32)


def _masks(coefficients: Floats, prototypes: Floats, corners: Floats) -> NDArray[np.bool_]:
    """Returns (N, H, W): positive logits at the size of the input, inside each one's box."""
    import cv2

    count, height, width = prototypes.shape
    size = (width * STRIDE, height * STRIDE)
    logits = (coefficients @ prototypes.reshape(count, -1)).reshape(-1, height, width)
    masks = np.zeros((len(coefficients), size[1], size[0]), np.bool_)
    for mask, small, (left, top, right, bottom) in zip(
        masks, logits, corners.round().astype(int), strict=True
    ):
        rows, columns = slice(max(0, top), max(0, bottom)), slice(max(0, left), max(0, right))
        large = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)
        mask[rows, columns] = large[rows, columns] > 0
    return masks


_LICENCE = "ultralytics and weights trained with it are under AGPL-3.0"
_EXPORT = (
    "Where ultralytics is installed, outside this environment: "
    "yolo export model=FastSAM-x.pt format=onnx imgsz={size} (without nms); "
    "then segmenter.weights=FastSAM-x.onnx"
)
# What YOLO networks see beside a photo that is not square.
_GREY = 114
# Boxes are pixels, coefficients and prototypes of a few tens.
_MOST_ANSWER = 1e6
_ROUNDING = 1e-3


@dataclass(frozen=True, slots=True)
class FastSamParams:
    """Settings of ``segmenter=fastsam``.

    Attributes:
        name: Name to report.
        weights: ONNX export of a FastSAM or YOLOv8 segmentation checkpoint.
        accept_agpl: Whether its licence, AGPL-3.0, is accepted.
        size: Side of the square that the export was made for, pixels.
        classes: Numbers of the classes that count as building; empty for all, as for a checkpoint that
            was fine-tuned on buildings alone.
        confidence: Least score of an instance.
        overlap: IoU of boxes from which on the less likely goes.
        most_share: Instances that cover more of the photo do not count.

    Raises:
        ConfigError: A setting is out of range.
    """

    name: str = "fastsam"
    weights: str | None = None
    accept_agpl: bool = False
    size: int = 1024
    classes: list[int] = field(default_factory=list)
    confidence: float = 0.4
    overlap: float = 0.9
    most_share: float = 1.0

    def __post_init__(self) -> None:
        if not 32 <= self.size <= 4096 or self.size % 32:
            raise ConfigError(f"segmenter.size={self.size} is no multiple of 32 within 32 to 4096.")
        require_numbers(self, "segmenter", ("confidence", "overlap", "most_share"), 0, 1, "(]")

    @property
    def normalise(self) -> str:
        """Returns ``none``: masks are 0 or 1 already."""
        return "none"


class FastSam(PhotoSegmenter):
    """The union of the instances that a FastSAM network finds, run by OpenCV.

    Args:
        params: Its settings.

    Raises:
        ConfigError: The licence is not accepted, or the weights are missing or of another kind.
    """

    params_type = FastSamParams
    provides = frozenset({Input.MASK, Input.INSTANCES})

    def __init__(self, params: FastSamParams) -> None:
        super().__init__(params)
        if not params.accept_agpl:
            raise ConfigError(
                f"segmenter=fastsam: {_LICENCE}; whoever offers it to others, over a network too, owes them "
                "the source of the whole.",
                "If that suits you: `segmenter.accept_agpl=true`",
            )
        export = _EXPORT.format(size=params.size)
        if params.weights is None:
            raise ConfigError("segmenter=fastsam comes without weights.", export)
        if params.weights.endswith((".pt", ".pth")):
            raise ConfigError(f"{params.weights} is a pickle, which lodbench does not open.", export)
        self._path = weights_file(params.weights, export, ".onnx")

    def notes(self) -> tuple[str, ...]:
        """Returns the licence, and that all classes count, where they do."""
        which = "" if self.params.classes else "; every instance counts as building, whatever it is"
        return (f"segmenter {self.name}: {_LICENCE}{which}",)

    def logits(self, photo: NDArray[np.uint8]) -> Floats:
        """Returns (h, w): infinite where there is building, minus infinity elsewhere."""
        mask = self._instances(photo).any(axis=0)
        return np.where(mask, np.float32(np.inf), np.float32(-np.inf))

    def segment_instances(self, entry: Entry) -> NDArray[np.bool_]:
        """Returns (N, h, w) bool, the instances that count as building, likeliest first.

        Raises:
            QueryFault: The query has no photo, or it cannot be read.
        """
        if entry.image is None:
            raise QueryFault("no photo to segment")
        return self._instances(read_photo(entry.image))

    def _instances(self, photo: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Returns (N, h, w) bool at the working size, likeliest first."""
        params = self.params
        height, width = photo.shape[:2]
        width, height = working_size(width, height, params.size)
        square = np.full((params.size, params.size, 3), _GREY, np.uint8)
        square[:height, :width] = resized_photo(photo, width, height)
        instances = decode(*self._outputs(square), params.confidence, params.overlap)
        return counted(instances, params.classes, params.most_share, square.shape[:2])[:, :height, :width]

    def _outputs(self, square: NDArray[np.uint8]) -> tuple[Floats, Floats]:
        """Returns the anchors' rows (4 + classes + P, anchors) and the prototypes (P, h, w)."""
        import cv2

        blob = np.ascontiguousarray(square.transpose(2, 0, 1)[None], np.float32) / np.float32(255)
        try:
            self._net.setInput(blob)
            outputs = self._net.forward(self._net.getUnconnectedOutLayersNames())
        except cv2.error as error:
            raise ConfigError(
                f"{self._path} does not take a photo of {square.shape[:2]}.",
                "segmenter.size is the imgsz of the export.",
            ) from error
        shapes = [tuple(output.shape) for output in outputs]
        rows = next((output[0] for output in outputs if output.ndim == 3), None)
        prototypes = next((output[0] for output in outputs if output.ndim == 4), None)
        side = self.params.size // STRIDE
        if (
            rows is None
            or prototypes is None
            or prototypes.shape[1:] != (side, side)
            or len(rows) < 5 + len(prototypes)
            # An export with nms=True answers the other way round: few instances, and what is known of each.
            or len(rows) >= rows.shape[1]
        ):
            raise ConfigError(
                f"{self._path} answers {shapes}, not the rows and the prototypes of a segmentation network.",
                _EXPORT.format(size=self.params.size),
            )
        _require_sound(rows[4 : len(rows) - len(prototypes)], [rows, prototypes], self._path)
        return np.asarray(rows, np.float32), np.asarray(prototypes, np.float32)

    @cached_property
    def _net(self) -> Any:
        """Returns OpenCV's network; read on first use."""
        return read_onnx(self._path, _EXPORT.format(size=self.params.size), digest=self.weights_digest)


def _require_sound(scores: Floats, outputs: list[Floats], path: Path) -> None:
    """Makes sure that a network's answers are numbers, and its scores probabilities."""
    hint = "Export it anew, as published: yolo export ... format=onnx."
    if any(not np.abs(output).max() < _MOST_ANSWER for output in outputs):
        raise ConfigError(f"{path} answers NaN, or values beyond {_MOST_ANSWER:g}: it is damaged.", hint)
    low, high = float(scores.min()), float(scores.max())
    if low < -_ROUNDING or high > 1 + _ROUNDING:
        raise ConfigError(f"{path} answers scores of {low:g} to {high:g}, which are no probabilities.", hint)
