"""A mask being corrected: strokes that say what is building and what is not, and what follows from them."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

# A stroke is seen in its surroundings: so much more than its brush on all sides, of at most this many pixels.
_AROUND_BRUSHES, _AROUND_PX, _WORKING_PX, _ROUNDS = 4.0, 40.0, 320, 3
_UNDO_STEPS = 50


class _State(NamedTuple):
    mask: Mask
    strokes: NDArray[np.int8]

    def of(self, window: tuple[slice, slice]) -> _State:
        """Returns a copy of a part."""
        return _State(self.mask[window].copy(), self.strokes[window].copy())


class MaskSession:
    """A photo's mask and the strokes drawn so far.

    Args:
        photo: (H, W, 3) RGB.
        mask: (H, W) to start from.
    """

    def __init__(self, photo: NDArray[np.uint8], mask: Mask) -> None:
        self.photo = photo
        self.is_changed = False  # since it began, or since whoever kept the mask said so
        self._state = _State(mask.copy(), np.zeros(mask.shape, np.int8))
        # Windows that strokes changed, as they were before: whole photos would take gigabytes.
        self._before: list[tuple[tuple[slice, slice], _State]] = []

    @property
    def mask(self) -> Mask:
        """Returns the (H, W) mask as it stands."""
        return self._state.mask

    def stroke(self, points: Points, radius_px: float, is_building: bool, is_exact: bool = False) -> None:
        """Adds to the mask or takes from it along a stroke; what looks alike nearby follows.

        OpenCV's GrabCut is solved in the stroke's surroundings only: the mask elsewhere, and all that strokes
        said before, stays.

        Args:
            points: (N, 2) pixels of the photo, column and row.
            radius_px: Of the brush.
            is_building: Whether what is under it is building.
            is_exact: Whether the mask changes under the brush alone.
        """
        painted = np.zeros(self.mask.shape, np.uint8)
        path = np.rint(points).astype(np.int32).reshape(-1, 1, 2)
        width = max(1, round(2 * radius_px))
        cv2.polylines(painted, [path], False, 1, width)
        for x, y in path[:, 0]:
            cv2.circle(painted, (int(x), int(y)), max(0, round(radius_px)), 1, -1)
        under = painted > 0
        if not under.any():
            return
        window = _surroundings(under, radius_px)
        self._before = [*self._before[1 - _UNDO_STEPS :], (window, self._state.of(window))]
        strokes, mask = self._state.strokes.copy(), self.mask.copy()
        strokes[under] = 1 if is_building else -1
        mask[under] = is_building
        if not is_exact:
            mask[window] = _followed(self.photo[window], mask[window], strokes[window])
        self._state, self.is_changed = _State(mask, strokes), True

    def undo(self) -> bool:
        """Takes the last stroke back; tells whether there was one."""
        if not self._before:
            return False
        window, before = self._before.pop()
        state = _State(self._state.mask.copy(), self._state.strokes.copy())
        state.mask[window], state.strokes[window] = before
        self._state, self.is_changed = state, True
        return True


def _surroundings(under: Mask, radius_px: float) -> tuple[slice, slice]:
    rows, columns = np.nonzero(under)
    reach = round(_AROUND_BRUSHES * radius_px + _AROUND_PX)
    return (
        slice(max(0, int(rows.min()) - reach), int(rows.max()) + reach + 1),
        slice(max(0, int(columns.min()) - reach), int(columns.max()) + reach + 1),
    )


def _followed(photo: NDArray[np.uint8], mask: Mask, strokes: NDArray[np.int8]) -> Mask:
    """Returns a window's mask after GrabCut; its rim and the strokes are certain."""
    height, width = mask.shape
    scale = min(1.0, _WORKING_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    labels = np.where(mask, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    rim = np.ones(mask.shape, bool)
    rim[2:-2, 2:-2] = False
    labels[rim] = np.where(mask[rim], cv2.GC_FGD, cv2.GC_BGD)
    labels[strokes > 0], labels[strokes < 0] = cv2.GC_FGD, cv2.GC_BGD
    small = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)
    is_inside = np.isin(small, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if is_inside.all() or not is_inside.any():
        return mask
    picture = np.ascontiguousarray(cv2.resize(photo[..., ::-1], size, interpolation=cv2.INTER_AREA))
    outside, inside = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.setRNGSeed(0)
    cv2.grabCut(picture, small, (0, 0, 0, 0), outside, inside, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    found = np.isin(small, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.float32)
    followed = cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR) >= 0.5
    followed[strokes > 0], followed[strokes < 0] = True, False
    return np.asarray(np.where(rim, mask, followed))
