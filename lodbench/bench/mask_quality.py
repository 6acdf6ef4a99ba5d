"""How good are a segmenter's masks? IoU over the views of a training set, and of what can be seen at best."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.bench.figures import Progress, Report, no_progress
from lodbench.bench.mask_quality_report import report_masks
from lodbench.errors import DatasetError, LodbenchError, require_within
from lodbench.segmentation import Segmenter, binary_mask, notes_of
from lodbench.segmentation.masks import read_mask
from lodbench.segmentation.photo_segmenter import photo_probability
from lodbench.training.samples import Sample, find_samples

Mask = NDArray[np.bool_]
_SPLITS = ("train", "val", "test")
# A visible part may lie outside its mask by this share of the view: none but for a file's rounding.
_STRAY_SHARE = 1e-3


@dataclass(frozen=True, slots=True)
class MaskQualityOptions:
    """What to measure.

    Attributes:
        data: Training set with photos and masks, or a folder of such sets; all splits count.
        visible: The same set with ``occluders_in_mask=true``: masks of what trees and cars leave
            visible; None to leave the ceiling out.
        least_share: Views with fewer buildings in them do not count: one wrong shed halves their IoU.
    """

    data: Path
    visible: Path | None = None
    least_share: float = 0.05

    def __post_init__(self) -> None:
        require_within("least_share", self.least_share, 0, 1)


class _Truth(NamedTuple):
    mask: Mask
    visible: Mask | None


def measure_masks(
    segmenter: Segmenter, options: MaskQualityOptions, progress: Progress = no_progress
) -> Report:
    """Returns how well a segmenter's masks agree with those of a training set, and how long one takes.

    Masks are compared at their own size, thresholded as a run does. Nothing is taken from the cache.

    Raises:
        LodbenchError: A set is missing or broken, or the two sets do not show the same views.
    """
    import pandas as pd

    samples = [sample for split in _SPLITS for sample in find_samples(options.data, split)]
    if not samples:
        raise DatasetError(f"{options.data} holds no views.", "lodbench generate-training-data makes some.")
    views = []
    with one_core():
        for number, sample in enumerate(samples, start=1):
            truth = _truth(sample, options)
            if truth.mask.mean() >= options.least_share:
                views.append(_measured(segmenter, sample, truth))
            progress(number, len(samples))
    if not views:
        raise DatasetError(
            f"None of the {len(samples)} views of {options.data} shows "
            f"{100 * options.least_share:g} % buildings or more."
        )
    height, width = views[0]["found"].shape
    which = (
        f"{name_and_weights(segmenter)}: {len(views)} of the {len(samples)} "
        f"views of {options.data.name}, those with {100 * options.least_share:g} % buildings or more, "
        f"{width} x {height}"
    )
    return report_masks(pd.DataFrame(views), which, segmenter.name, notes_of(segmenter))


@contextmanager
def one_core() -> Iterator[None]:
    """Lets OpenCV, and torch if it is loaded, compute on one core."""
    torch, threads = sys.modules.get("torch"), cv2.getNumThreads()
    torch_threads = torch.get_num_threads() if torch else 0
    cv2.setNumThreads(1)
    if torch:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
        if torch:
            torch.set_num_threads(torch_threads)


def name_and_weights(segmenter: Segmenter) -> str:
    """Returns a segmenter's name with the first digits of its weights' digest; a plug-in may tell none."""
    digest = getattr(segmenter, "weights_digest", "")
    return f"{segmenter.name}, weights {digest[:12]}" if digest else segmenter.name


def found_mask(segmenter: Segmenter, photo: Path, shape: Sequence[int]) -> Mask:
    """Returns the (H, W) mask that a segmenter makes of a photo, at the size of its true mask."""
    return binary_mask(photo_probability(segmenter, photo), shape[1], shape[0])


def _measured(segmenter: Segmenter, sample: Sample, truth: _Truth) -> dict[str, Any]:
    """Returns a row as ``report_masks`` wants it."""
    started = time.process_time()
    found = found_mask(segmenter, sample.photo, truth.mask.shape)
    seconds = time.process_time() - started
    row = {"key": sample.key, "photo": sample.photo, "mask": sample.mask, "found": found, "seconds": seconds}
    row |= _overlap("mask", found, truth.mask)
    if truth.visible is not None:
        row |= _overlap("ceiling", truth.visible, truth.mask) | _overlap("visible", found, truth.visible)
    return row


def _truth(sample: Sample, options: MaskQualityOptions) -> _Truth:
    mask = _read(sample.mask)
    if options.visible is None:
        return _Truth(mask, None)
    path = options.visible / sample.mask.relative_to(options.data)
    if not path.is_file():
        raise DatasetError(f"{options.visible} has no mask of {sample.key}.", _SAME_VIEWS)
    visible = _read(path)
    if visible.shape != mask.shape or (visible & ~mask).mean() > _STRAY_SHARE:
        raise DatasetError(f"{path} is not the visible part of {sample.mask}.", _SAME_VIEWS)
    return _Truth(mask, visible)


_SAME_VIEWS = "Make it with the same settings and seed, and occluders_in_mask=true images=false."


def _read(path: Path) -> Mask:
    try:
        return np.asarray(read_mask(path) >= 0.5)
    except LodbenchError as fault:
        raise DatasetError(f"{path}: {fault.message}", "Delete it and generate the set again.") from fault


def _overlap(kind: str, first: Mask, second: Mask) -> dict[str, int]:
    return {f"{kind} shared": int((first & second).sum()), f"{kind} union": int((first | second).sum())}
