"""Sheets of masks on their photos: the worst, the middling and the best views, or all of a few."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.reporting.overlays import draw_outline, png_bytes
from lodbench.segmentation.masks import read_mask
from lodbench.segmentation.photos import read_photo
from lodbench.storage.atomic import writable

if TYPE_CHECKING:
    import pandas as pd

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]
SHEET_FILE = "masks.png"
_PER_GROUP, _TILE = 4, 448
# BGR: told apart with any colour vision, on roofs and on green.
_EXTRA, _MISSED, _OUTLINE = (30, 120, 255), (255, 60, 190), (255, 255, 255)
_INK, _PAPER = (235, 235, 235), (32, 28, 26)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw_sheet(views: pd.DataFrame, title: str) -> dict[str, bytes]:
    """Returns the sheet, ``masks.png``: rows of worst, median and best views.

    The true mask's outline is white; what was found beside it is orange, what was missed violet.
    """
    ious = (views["mask shared"] / views["mask union"].clip(lower=1)).rename("iou")
    ordered = views.join(ious).sort_values(["iou", "key"])
    count = min(_PER_GROUP, len(ordered))
    middle = (len(ordered) - count) // 2
    groups = {"worst": ordered[:count], "median": ordered[middle : middle + count], "best": ordered[-count:]}
    rows = [np.hstack([_tile(name, view) for _, view in mine.iterrows()]) for name, mine in groups.items()]
    return {SHEET_FILE: png_bytes(np.vstack([_legend(title, rows[0].shape[1]), *rows]))}


def draw_all(views: Sequence[tuple[str, Picture, Mask, Mask]], title: str) -> bytes:
    """Returns a sheet of all views as PNG, in their order; colours as in ``draw_sheet``.

    Args:
        views: Caption, (H, W, 3) BGR photo, and (H, W) found and true mask of each.
        title: Whose masks of what.
    """
    tiles = [_captioned(caption, tinted(photo, found, truth, 3)) for caption, photo, found, truth in views]
    blank = np.full_like(tiles[0], _PAPER)
    columns = min(_PER_GROUP, len(tiles))
    tiles += [blank] * (-len(tiles) % columns)
    rows = [np.hstack(tiles[first : first + columns]) for first in range(0, len(tiles), columns)]
    return png_bytes(np.vstack([_legend(title, rows[0].shape[1]), *rows]))


def tinted(photo: Picture, found: NDArray[np.bool_], truth: NDArray[np.bool_], thickness: int) -> Picture:
    """Returns an (H, W, 3) BGR photo with its true outline, and what is wrongly found or missed tinted."""
    canvas = np.ascontiguousarray(photo)
    for wrong, colour in ((found & ~truth, _EXTRA), (truth & ~found, _MISSED)):
        canvas[wrong] = (0.35 * canvas[wrong] + 0.65 * np.array(colour)).astype(np.uint8)
    draw_outline(canvas, truth, _OUTLINE, thickness)
    return canvas


def _tile(group: str, view: pd.Series[Any]) -> Picture:
    """Returns a view's photo with what is wrong tinted, and a line of text below; all of one size."""
    truth = read_mask(view["mask"]) >= 0.5
    height, width = truth.shape
    photo = cv2.resize(read_photo(view["photo"])[..., ::-1], (width, height), interpolation=cv2.INTER_AREA)
    caption = f"{group}: IoU {view['iou']:.3f}  {view['key']}"
    return _captioned(caption, tinted(np.asarray(photo, np.uint8), view["found"], truth, 1))


def _captioned(caption: str, picture: Picture) -> Picture:
    """Returns a picture framed, with a line of text below; all of one size."""
    framed = _framed(picture, _TILE, _TILE * 3 // 4)
    strip = np.full((24, _TILE, 3), _PAPER, np.uint8)
    cv2.putText(strip, writable(caption), (6, 17), _FONT, 0.42, _INK, 1, cv2.LINE_AA)
    return np.pad(np.vstack([framed, strip]), ((2, 2), (2, 2), (0, 0)))


def _framed(picture: Picture, width: int, height: int) -> Picture:
    """Returns a picture in the middle of a frame, as large as it fits."""
    factor = min(width / picture.shape[1], height / picture.shape[0])
    inner = max(1, round(factor * picture.shape[1])), max(1, round(factor * picture.shape[0]))
    small = cv2.resize(picture, inner, interpolation=cv2.INTER_AREA)
    framed = np.full((height, width, 3), _PAPER, np.uint8)
    top, left = (height - inner[1]) // 2, (width - inner[0]) // 2
    framed[top : top + inner[1], left : left + inner[0]] = small
    return framed


def _legend(title: str, width: int) -> Picture:
    strip = np.full((34, width, 3), _PAPER, np.uint8)
    x = 8
    for words, colour in (
        (title, None),
        ("outline of the true mask", _OUTLINE),
        ("found, not in the mask", _EXTRA),
        ("in the mask, not found", _MISSED),
    ):
        if colour is not None:
            cv2.line(strip, (x, 17), (x + 22, 17), colour, 5)
            x += 30
        cv2.putText(strip, words, (x, 22), _FONT, 0.5, _INK, 1, cv2.LINE_AA)
        x += 26 + int(cv2.getTextSize(words, _FONT, 0.5, 1)[0][0])
    return strip
