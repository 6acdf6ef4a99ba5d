"""How well the buildings of a view fit those of a photo: Dice, building by building."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from lodbench.errors import QueryFault
from lodbench.geometry import Camera

Floats = NDArray[np.float64]
Labels = NDArray[np.int32]


class InstanceFit:
    """The mean over a photo's buildings of the Dice coefficient with the best fitting building of a view.

    Args:
        masks: (N, H, W) bool, the photo's buildings, at any size of its aspect.
        camera: Of the size at which views are compared.
        weights: How much each counts: ``box``, ``area`` or ``equal``.

    Raises:
        QueryFault: There is no building.
    """

    def __init__(self, masks: NDArray[np.bool_], camera: Camera, weights: str = "box") -> None:
        self.labels = label_image(masks, camera.width, camera.height)
        self._areas = np.bincount(self.labels[self.labels >= 0])
        if not len(self._areas):
            raise QueryFault("no building is told apart in the photo")
        sizes = {"box": box_areas(self.labels), "area": self._areas, "equal": self._areas > 0}[weights]
        self._weights = np.asarray(sizes / sizes.sum(), dtype=np.float64)

    def __call__(self, buildings: NDArray[np.int32]) -> Floats:
        """Returns the (V,) fit, in [0, 1], of V views: (V, H, W) indices of buildings, -1 for none."""
        return np.asarray(best_dice(self.labels, self._areas, buildings) @ self._weights, dtype=np.float64)


def label_image(masks: NDArray[np.bool_], width: int, height: int) -> Labels:
    """Returns (height, width) int32, which mask covers most of a pixel, -1 where less than half is covered.

    The labels 0, 1, ... are those of masks that have a pixel, in their order.
    """
    most = np.zeros((height, width), np.float32)
    total = np.zeros((height, width), np.float32)
    labels = np.full((height, width), -1, np.int32)
    for number, mask in enumerate(masks):
        covered = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        total += covered
        labels[covered > most] = number
        np.maximum(most, covered, out=most)
    labels[total < 0.5] = -1
    _, numbered = np.unique(labels[labels >= 0], return_inverse=True)
    labels[labels >= 0] = numbered
    return labels


def box_areas(labels: Labels) -> NDArray[np.int64]:
    """Returns the pixels of each label's bounding box."""
    areas = []
    for number in range(int(labels.max(initial=-1)) + 1):
        rows, columns = np.nonzero(labels == number)
        areas.append((np.ptp(rows) + 1) * (np.ptp(columns) + 1))
    return np.array(areas, dtype=np.int64)


@njit(cache=True, nogil=True, error_model="numpy")
def _numbered(view, number_of):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the (K,) buildings of a view as they are met, and writes their numbers 0 .. K - 1."""
    met: list[int] = []
    for row in range(view.shape[0]):
        for building in view[row]:
            if building >= 0 and number_of[building] < 0:
                number_of[building] = len(met)
                met.append(building)
    return met


@njit(cache=True, nogil=True, error_model="numpy")
def best_dice(labels, areas, buildings):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns (V, N) float64, per view and label the highest Dice coefficient with a building.

    Args:
        labels: (H, W) int32 of the photo, -1 for none.
        areas: (N,) int64 pixels of each label.
        buildings: (V, H, W) int32 of the views, -1 for none.
    """
    highest = np.zeros((buildings.shape[0], areas.shape[0]), dtype=np.float64)
    number_of = np.full(max(buildings.max(), 0) + 1, -1, dtype=np.int64)
    for v in range(buildings.shape[0]):
        # Numbered anew in each view: a city has many buildings, a view few.
        met = _numbered(buildings[v], number_of)
        drawn = np.zeros(len(met), dtype=np.int64)
        shared = np.zeros((areas.shape[0], len(met)), dtype=np.int64)
        for row in range(labels.shape[0]):
            for label, building in zip(labels[row], buildings[v, row]):  # noqa: B905 - not in numba
                if building >= 0:
                    drawn[number_of[building]] += 1
                    if label >= 0:
                        shared[label, number_of[building]] += 1
        for k in range(len(met)):
            for label in range(areas.shape[0]):
                dice = 2.0 * shared[label, k] / (areas[label] + drawn[k])
                highest[v, label] = max(highest[v, label], dice)
            number_of[met[k]] = -1
    return highest
