"""Instance silhouettes: what each building alone would cover in a view, whatever stands before it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lodbench.rendering.bits import Words, count_bits, unpack_mask
from lodbench.rendering.engine_kernel import draw_group
from lodbench.rendering.projection import camera_axes
from lodbench.rendering.raster_rule import NEAR_M


@dataclass(frozen=True, slots=True, eq=False)
class Instances:
    """The silhouettes of the buildings of a view, each cut to the rows and 64-pixel words it covers.

    Silhouettes overlap: buildings do not hide each other. Those that cover no pixel are left out.

    Attributes:
        size: Width and height of the view, pixels.
        buildings: (K,) int64 indices into ``scene.building_ids``, ascending.
        boxes: (K, 4) int64: first row, last row + 1, first word, last word + 1.
        starts: (K + 1,) int64 offsets into ``words``.
        words: uint64, as of ``pack_mask``, box after box, row by row.
    """

    size: tuple[int, int]
    buildings: NDArray[np.int64]
    boxes: NDArray[np.int64]
    starts: NDArray[np.int64]
    words: Words

    def __len__(self) -> int:
        return len(self.buildings)

    def crop(self, k: int) -> tuple[NDArray[np.bool_], int, int]:
        """Returns the k-th silhouette within its box, and the row and column where that begins."""
        top, bottom, left, right = (int(side) for side in self.boxes[k])
        words = self.words[self.starts[k] : self.starts[k + 1]].reshape(bottom - top, right - left)
        return unpack_mask(words, min(64 * right, self.size[0]) - 64 * left), top, 64 * left

    def mask(self, k: int) -> NDArray[np.bool_]:
        """Returns the (H, W) mask of the k-th silhouette."""
        crop, top, left = self.crop(k)
        mask = np.zeros(self.size[::-1], dtype=np.bool_)
        mask[top : top + crop.shape[0], left : left + crop.shape[1]] = crop
        return mask

    def masks(self) -> Iterator[tuple[int, NDArray[np.bool_]]]:
        """Yields each building's index and (H, W) mask."""
        for k, building in enumerate(self.buildings):
            yield int(building), self.mask(k)

    def areas(self) -> NDArray[np.int64]:
        """Returns (K,) int64 pixels of each silhouette."""
        spans = zip(self.starts[:-1], self.starts[1:], strict=True)
        return np.array([count_bits(self.words[a:b]) for a, b in spans], dtype=np.int64)


@njit(cache=True, nogil=True, error_model="numpy")
def _range_of(middle, half, near, far, focal, offset, size):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the first pixel and the last + 1 that a span between two depths may cover."""
    low = focal * min((middle - half) / near, (middle - half) / far) + offset - 1.0
    high = focal * max((middle + half) / near, (middle + half) / far) + offset + 2.0
    limit = np.float64(size)
    return np.int64(min(max(low, 0.0), limit)), np.int64(min(max(high, 0.0), limit))


@njit(cache=True, nogil=True, error_model="numpy")
def _box_of(sphere, rotation, center, view):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns rows and words (first row, last + 1, first word, last + 1) that a sphere may cover."""
    x, y, z = camera_axes(sphere[0], sphere[1], sphere[2], rotation, center)
    radius = sphere[3] + 1e-6 * (abs(x) + abs(y) + abs(z))
    left, right, top, bottom = np.int64(0), np.int64(view.width), np.int64(0), np.int64(view.height)
    if z - radius > NEAR_M:
        f, near, far = view.intrinsics, z - radius, z + radius
        left, right = _range_of(x, radius, near, far, f[0], f[2], view.width)
        top, bottom = _range_of(y, radius, near, far, f[1], f[3], view.height)
    return top, bottom, left >> 6, (right + 63) >> 6


@njit(cache=True, nogil=True, error_model="numpy")
def _trimmed(words, box):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the part of a box of words in which bits are set; an empty one is (0, 0, 0, 0)."""
    top, bottom, left, right = box
    first_row, last_row, first_word, last_word = bottom, -1, right, -1
    for row in range(top, bottom):
        for k in range(left, right):
            if words[row, k] != np.uint64(0):
                first_row, last_row = min(first_row, row), row
                first_word, last_word = min(first_word, k), max(last_word, k)
    if last_row < 0:
        return np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    return first_row, last_row + 1, first_word, last_word + 1


@njit(cache=True, nogil=True, error_model="numpy")
def draw_instances(scene, buildings, rotations, centers, view, scratch, words):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Draws buildings one by one; returns those that cover a pixel, their boxes, offsets and words.

    Args:
        scene: SceneArrays.
        buildings: (N,) int64 indices.
        rotations: (1, 3, 3) float64 cam_from_world.
        centers: (1, 3) float64 camera centre, local metres.
        view: View.
        scratch: Scratch.
        words: (1, H, ceil(W / 64)) uint64, clear; so it is left.
    """
    kept = np.empty(buildings.shape[0], dtype=np.int64)
    boxes = np.empty((buildings.shape[0], 4), dtype=np.int64)
    starts = np.zeros(buildings.shape[0] + 1, dtype=np.int64)
    stored = np.empty(1024, dtype=np.uint64)
    count = 0
    for n in range(buildings.shape[0]):
        b = buildings[n]
        draw_group(scene, buildings[n : n + 1], rotations, centers, view, scratch, words)
        box = _box_of(scene.spheres[b], rotations[0], centers[0], view)
        top, bottom, left, right = _trimmed(words[0], box)
        if bottom == 0:
            continue
        begin = starts[count]
        stop = begin + (bottom - top) * (right - left)
        if stop > stored.shape[0]:
            larger = np.empty(2 * stop, dtype=np.uint64)
            larger[:begin] = stored[:begin]
            stored = larger
        for row in range(top, bottom):
            for k in range(left, right):
                stored[begin] = words[0, row, k]
                words[0, row, k] = np.uint64(0)
                begin += 1
        kept[count], starts[count + 1] = b, stop
        boxes[count, 0], boxes[count, 1], boxes[count, 2], boxes[count, 3] = top, bottom, left, right
        count += 1
    return (
        kept[:count].copy(),
        boxes[:count].copy(),
        starts[: count + 1].copy(),
        stored[: starts[count]].copy(),
    )
