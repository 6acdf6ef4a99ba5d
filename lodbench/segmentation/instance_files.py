"""``segmenter=instances``: masks of single buildings made beforehand, from the folder ``instances``."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.inputs import Input
from lodbench.datasets.instance_labels import masks_of_labels, read_labels
from lodbench.datasets.query import Entry
from lodbench.errors import QueryFault
from lodbench.storage import digest_of
from lodbench.storage.digest import content_digest

# Masks of buildings are handed over at most this long, pixels: a photo has hundreds.
_LONGER_SIDE = 1024


@dataclass(frozen=True, slots=True)
class InstanceFilesParams:
    """Settings of ``segmenter=instances``: none."""

    name: str = "instances"


class InstanceFiles:
    """Reads each query's labels of buildings from the dataset; the mask is where there is one."""

    params_type = InstanceFilesParams
    name = "instances"
    requires = frozenset({Input.INSTANCES})
    provides = frozenset({Input.MASK, Input.INSTANCES})

    def __init__(self, params: InstanceFilesParams) -> None:
        self.params = params

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Returns the (H, W) float32 mask, 0 or 1.

        Raises:
            QueryFault: There are no labels for this query, or they cannot be read.
        """
        return np.asarray(self._labels(entry) > 0, dtype=np.float32)

    def segment_instances(self, entry: Entry) -> NDArray[np.bool_]:
        """Returns (N, h, w) bool, at most 1024 pixels on the longer side.

        Raises:
            QueryFault: As for ``segment``, or there are more labels than masks of 1 GB together hold.
        """
        labels = self._labels(entry)
        height, width = labels.shape
        scale = _LONGER_SIDE / max(height, width)
        if scale < 1:
            size = (max(1, round(width * scale)), max(1, round(height * scale)))
            labels = np.asarray(cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST_EXACT), np.uint16)
        return masks_of_labels(labels)

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns a digest of the label files' names and contents."""
        return digest_of([[entry.key, content_digest(entry.instances)] for entry in entries])

    def _labels(self, entry: Entry) -> NDArray[np.uint16]:
        if entry.instances is None:
            raise QueryFault("no labels in the instances folder")
        return read_labels(entry.instances)
