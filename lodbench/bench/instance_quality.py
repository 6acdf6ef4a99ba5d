"""How well are buildings told apart? Panoptic quality over the labelled views of a training set."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.bench.figures import Figure, Progress, Report, no_progress
from lodbench.datasets.inputs import Input, declared_inputs
from lodbench.datasets.instance_labels import read_labels
from lodbench.datasets.query import Entry
from lodbench.errors import ConfigError, DatasetError
from lodbench.evaluation.metrics import InstanceMatches, match_instances
from lodbench.reporting.aligned_text import format_columns
from lodbench.segmentation.protocol import BUILDING_THRESHOLD, InstanceSegmenter, Segmenter
from lodbench.training.samples import INTERIORS, find_samples

_SPLITS = ("train", "val", "test")
# Buildings of less than some 8 x 8 pixels do not count: what is left of one behind another.
_LEAST_PX = 64


def measure_instances(segmenter: Segmenter, data: Path, progress: Progress = no_progress) -> Report:
    """Returns the panoptic quality of a segmenter's buildings, and of the coherent parts of its mask.

    Args:
        segmenter: Provides ``instances`` of the photo alone.
        data: Training set with ``labels``, or a folder of such sets; all splits count.
        progress: Called after each view.

    Raises:
        LodbenchError: The segmenter tells no buildings apart, or a set is missing or has no labels.
    """
    if not isinstance(segmenter, InstanceSegmenter) or declared_inputs(segmenter, "requires") != {
        Input.IMAGE
    }:
        raise ConfigError(
            f"segmenter {segmenter.name} does not separate buildings by the photo alone.",
            "--segmenter compact_instances does, and any other that requires the image alone.",
        )
    samples = [sample for split in _SPLITS for sample in find_samples(data, split, INTERIORS)]
    if not samples:
        raise DatasetError(
            f"{data} holds no views.", "lodbench generate-training-data labels=true makes some."
        )
    apart, parts = InstanceMatches(), InstanceMatches()
    for number, sample in enumerate(samples, start=1):
        labels = read_labels(sample.mask)
        height, width = labels.shape
        entry = Entry(sample.photo.name, sample.key, None, None, sample.photo, None)
        found = np.zeros(labels.shape, np.uint16)
        for k, mask in enumerate(segmenter.segment_instances(entry), start=1):
            found[cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0] = k
        apart += match_instances(found, labels, _LEAST_PX)
        mask = cv2.resize(segmenter.segment(entry), (width, height)) >= BUILDING_THRESHOLD
        parts += match_instances(_coherent(mask), labels, _LEAST_PX)
        progress(number, len(samples))
    return _report(segmenter.name, data, len(samples), {"buildings": apart, "parts of its mask": parts})


def _coherent(mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    return np.asarray(cv2.connectedComponents(mask.astype(np.uint8))[1], np.int32)


def _report(name: str, data: Path, views: int, rows: dict[str, InstanceMatches]) -> Report:
    cells = [["", "PQ", "RQ (F1)", "SQ", "found", "there"]]
    figures = []
    for words, matches in rows.items():
        quality = (matches.panoptic, matches.recognition, matches.segmentation)
        cells.append([words, *(f"{value:.3f}" for value in quality), str(matches.found), str(matches.true)])
        figures += [
            Figure(f"{words.replace(' ', '_')}_{kind}", value, "")
            for kind, value in zip(("pq", "rq", "sq"), quality, strict=True)
        ]
    which = f"{name}: single buildings of {views} views of {data.name}, those of {_LEAST_PX} pixels or more"
    return Report("\n".join([which, format_columns(cells)]), figures)
