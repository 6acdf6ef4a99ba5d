"""Masks corrected by people: strokes, a page, and polygons for other programs."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.errors import DatasetError
from lodbench.harness.tracebacks import reported_as_fault
from lodbench.photos.metadata import read_photo_metadata
from lodbench.reporting.overlays import write_picture
from lodbench.segmentation import Segmenter, binary_mask
from lodbench.segmentation.masks import read_mask, read_photo
from lodbench.segmentation.photo_segmenter import photo_probability
from lodbench.segmentation.polygon_files import polygon_file, polygon_text, read_polygons
from lodbench.storage import write_text

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]
Window = tuple[slice, slice]

# A stroke is seen in its surroundings: so much more than its brush on all sides, of at most this many pixels.
_MARGIN_BRUSHES, _MARGIN_PX, _WORKING_PX, _ROUNDS = 4.0, 40.0, 320, 3
_UNDO_STEPS = 50


class _State(NamedTuple):
    mask: Mask
    strokes: NDArray[np.int8]

    def of(self, window: Window) -> _State:
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
        # Windows that strokes changed, as they were before, and those that Undo changed, as they were before
        # it: whole photos would take gigabytes.
        self._before: list[tuple[Window, _State]] = []
        self._undone: list[tuple[Window, _State]] = []

    @property
    def mask(self) -> Mask:
        """Returns the (H, W) mask as it stands."""
        return self._state.mask

    @property
    def can_undo(self) -> bool:
        """Returns whether there is a stroke to take back."""
        return bool(self._before)

    @property
    def can_redo(self) -> bool:
        """Returns whether there is a stroke to draw again."""
        return bool(self._undone)

    def stroke(
        self, points: Points, radius_px: float, is_building: bool, is_exact: bool = False
    ) -> Window | None:
        """Adds to the mask or removes from it along a stroke; similar pixels nearby are included.

        OpenCV's GrabCut is solved in the stroke's surroundings only: the mask elsewhere, and all that strokes
        said before, stays.

        Args:
            points: (N, 2) pixels of the photo, column and row; a pixel's centre has whole numbers.
            radius_px: Of the brush: it covers the pixels that are no further from the stroke's own.
            is_building: Whether what is under it is building.
            is_exact: Whether the mask changes under the brush alone.

        Returns:
            Rows and columns outside which the mask is as before; None for a stroke beside the photo.
        """
        brushed = _under_brush(points, radius_px, self.mask.shape)
        if brushed is None:
            return None
        box, under = brushed
        window = box if is_exact else _surroundings(box, radius_px, self.mask.shape)
        self._before = [*self._before[1 - _UNDO_STEPS :], (window, self._state.of(window))]
        self._undone = []
        strokes, mask = self._state.strokes.copy(), self.mask.copy()
        strokes[box][under] = 1 if is_building else -1
        mask[box][under] = is_building
        if not is_exact:
            mask[window] = _followed(self.photo[window], mask[window], strokes[window])
        self._state, self.is_changed = _State(mask, strokes), True
        return window

    def undo(self) -> Window | None:
        """Takes the last stroke back; returns what changes (see stroke), None without a stroke."""
        return self._moved(self._before, self._undone)

    def redo(self) -> Window | None:
        """Draws the stroke again that was taken back last; returns what changes, None without one."""
        return self._moved(self._undone, self._before)

    def _moved(
        self, source: list[tuple[Window, _State]], target: list[tuple[Window, _State]]
    ) -> Window | None:
        """Puts the last window of one list back, and what it replaces on the other."""
        if not source:
            return None
        window, kept = source.pop()
        target.append((window, self._state.of(window)))
        state = _State(self._state.mask.copy(), self._state.strokes.copy())
        state.mask[window], state.strokes[window] = kept
        self._state, self.is_changed = state, True
        return window


def _under_brush(points: Points, radius_px: float, shape: tuple[int, ...]) -> tuple[Window, Mask] | None:
    """Returns the window that a brush may touch, and which of its pixels it does; None for none."""
    path = np.rint(points).astype(np.int32).reshape(-1, 2)
    reach = int(radius_px)
    # Parts of the path that lie beside the photo are within the brush's reach of it, or do not matter.
    low = np.maximum(path.min(axis=0) - reach, -reach)
    high = np.minimum(path.max(axis=0) + reach, np.array(shape[1::-1]) - 1 + reach)
    if (low > high).any():
        return None
    off_path = np.ones((high - low + 1)[::-1], np.uint8)
    # A line of a single point would not be drawn.
    cv2.polylines(off_path, [np.concatenate((path[:1], path)) - low], False, 0)
    if off_path.all():
        return None
    under = cv2.distanceTransform(off_path, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= radius_px
    first, last = np.maximum(low, 0), np.minimum(high + 1, shape[1::-1])
    inside = under[first[1] - low[1] : last[1] - low[1], first[0] - low[0] : last[0] - low[0]]
    box = slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0]))
    return (box, inside) if inside.any() else None


def _surroundings(box: Window, radius_px: float, shape: tuple[int, ...]) -> Window:
    reach = round(_MARGIN_BRUSHES * radius_px + _MARGIN_PX)
    rows, columns = (
        slice(max(0, part.start - reach), min(size, part.stop + reach))
        for part, size in zip(box, shape, strict=True)
    )
    return rows, columns


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
    foreground = np.isin(small, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.float32)
    followed = cv2.resize(foreground, (width, height), interpolation=cv2.INTER_LINEAR) >= 0.5
    followed[strokes > 0], followed[strokes < 0] = True, False
    return np.asarray(np.where(rim, mask, followed))


def opened_session(
    photo: Path, mask: Path | None, polygons: Path | None, segmenter: Segmenter | None
) -> MaskSession:
    """Returns the session of a photo, started from the first that is given; from an empty mask without any.

    Raises:
        LodbenchError: The photo, the mask or the polygons cannot be read, or do not fit each other, or the
            segmenter's own code raised: where is kept beside the photo.
    """
    pixels = read_photo(photo)
    height, width = pixels.shape[:2]
    if polygons is not None:
        return MaskSession(pixels, read_polygons(polygons, photo.name, height, width))
    if mask is not None:
        given = read_mask(mask)
        if given.shape != (height, width):
            size = f"{given.shape[1]} x {given.shape[0]}"
            raise DatasetError(
                f"{mask.name} has {size} pixels, the photo {width} x {height}.",
                "A mask to correct has the size of its photo.",
            )
        return MaskSession(pixels, np.asarray(given >= 0.5))
    if segmenter is not None:
        with reported_as_fault(f"segmenter {segmenter.name}", photo.parent, photo.name):
            probability = photo_probability(segmenter, photo)
        return MaskSession(pixels, binary_mask(probability, width, height))
    return MaskSession(pixels, np.zeros((height, width), bool))


def require_unturned(photo: Path, formats: tuple[str, ...], polygons: Path | None) -> None:
    """Makes sure that other programs see a photo's pixels where the mask has them.

    LabelMe and most others turn a photo for display as EXIF says; masks are of the stored pixels. Of a photo
    that stands on its head nothing else would tell: its size is the same.

    Raises:
        DatasetError: The photo is turned, and polygons come or go.
    """
    if polygons is None and not {"labelme", "coco"}.intersection(formats):
        return
    try:
        orientation = read_photo_metadata(photo).orientation
    except DatasetError:  # a format without such a tag, or a header that nobody can read
        return
    if orientation > 1:
        raise DatasetError(
            f"Other programs turn {photo.name} for display (EXIF orientation {orientation}), so polygons "
            "would lie elsewhere.",
            "Draw on the page: lodbench mask PHOTO; or take a copy of the photo without that tag.",
        )


def require_untouched(out: Path, photo: Path, formats: tuple[str, ...], polygons: Path | None) -> None:
    """Makes sure that no polygons are replaced that another program has written since the mask was saved.

    Raises:
        DatasetError: Some would be.
        QueryFault: The mask cannot be read.
    """
    for name in formats:
        file = polygon_file(out, name)
        if not file.exists() or (polygons is not None and polygons.exists() and polygons.samefile(file)):
            continue
        before = np.asarray(read_mask(out) >= 0.5) if out.exists() else None
        if before is None or file.read_bytes() != polygon_text(name, before, photo.name).encode():
            back = (
                "move it away" if name == "geojson" else f"bring it back: --import {shlex.quote(str(file))}"
            )
            raise DatasetError(
                f"{file} is not as it was exported, and would be replaced.",
                f"Save elsewhere: `--out OTHER.png`; or {back}",
            )


class Untouched:
    """Files that a page will replace: as they were when it began, or when it last saved.

    Another program, or another page of the same photo, may write them while the page is open.
    """

    def __init__(self, out: Path, formats: tuple[str, ...]) -> None:
        self._files = (out, *(polygon_file(out, name) for name in formats))
        self.remember()

    def remember(self) -> None:
        """Takes the files as they are now."""
        self._contents = [_content(file) for file in self._files]

    def require(self, hint: str) -> None:
        """Makes sure that nobody else has written a file since; tried again, they may be replaced.

        Raises:
            DatasetError: Somebody has.
        """
        before = self._contents
        self.remember()
        for file, old, new in zip(self._files, before, self._contents, strict=True):
            if new is not None and new != old:
                raise DatasetError(
                    f"{file.name} was written by another program since it was read or saved here.", hint
                )


def _content(file: Path) -> bytes | None:
    try:
        return file.read_bytes()
    except OSError:
        return None  # not there, or nothing that could be replaced: writing tells


def saved(mask: Mask, photo: Path, out: Path, formats: tuple[str, ...]) -> tuple[Path, ...]:
    """Writes a mask as PNG, and as polygons beside it; returns the files."""
    out.parent.mkdir(parents=True, exist_ok=True)
    white = mask.astype(np.uint8) * np.uint8(255)
    write_picture(out, np.repeat(white[..., None], 3, axis=2))
    written = [out]
    for name in formats:
        written.append(polygon_file(out, name))
        write_text(written[-1], polygon_text(name, mask, photo.name))
    return tuple(written)
