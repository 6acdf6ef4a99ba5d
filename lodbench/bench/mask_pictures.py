"""A sheet of masks beside their photos: the worst, the middling and the best views."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.bench.mask_quality_report import MaskQualityReport, ViewQuality
from lodbench.reporting.overlays import draw_outline, write_picture
from lodbench.segmentation.masks import read_mask
from lodbench.segmentation.photos import read_photo

Picture = NDArray[np.uint8]
SHEET_FILE = "masks.png"
_PER_GROUP, _TILE = 4, 448
# BGR: told apart with any colour vision, on roofs and on green.
_EXTRA, _MISSED, _OUTLINE = (30, 120, 255), (255, 60, 190), (255, 255, 255)
_INK, _PAPER = (235, 235, 235), (32, 28, 26)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def write_sheet(report: MaskQualityReport, folder: Path) -> Path:
    """Writes the sheet as PNG and returns its file: rows of worst, median and best views.

    The true mask's outline is white; what was found beside it is orange, what was missed violet.
    """
    ordered = sorted(report.views, key=lambda view: (view.with_mask.iou, view.key))
    count = min(_PER_GROUP, len(ordered))
    middle = (len(ordered) - count) // 2
    groups = {
        "worst": ordered[:count],
        "median": ordered[middle : middle + count],
        "best": ordered[-count:],
    }
    rows = [
        np.hstack([_tile(view, f"{name}: IoU {view.with_mask.iou:.3f}  {view.key}") for view in views])
        for name, views in groups.items()
    ]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / SHEET_FILE
    write_picture(path, np.vstack([_legend(report, rows[0].shape[1]), *rows]))
    return path


def _tile(view: ViewQuality, caption: str) -> Picture:
    """Returns a view's photo with what is wrong tinted, and a line of text below; all of one size."""
    truth = read_mask(view.mask) >= 0.5
    height, width = truth.shape
    photo = cv2.resize(read_photo(view.photo)[..., ::-1], (width, height), interpolation=cv2.INTER_AREA)
    canvas = np.ascontiguousarray(photo, np.uint8)
    for wrong, colour in ((view.found & ~truth, _EXTRA), (truth & ~view.found, _MISSED)):
        canvas[wrong] = (0.35 * canvas[wrong] + 0.65 * np.array(colour)).astype(np.uint8)
    draw_outline(canvas, truth, _OUTLINE, 1)
    framed = _framed(canvas, _TILE, _TILE * 3 // 4)
    strip = np.full((24, _TILE, 3), _PAPER, np.uint8)
    cv2.putText(strip, caption, (6, 17), _FONT, 0.42, _INK, 1, cv2.LINE_AA)
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


def _legend(report: MaskQualityReport, width: int) -> Picture:
    strip = np.full((34, width, 3), _PAPER, np.uint8)
    x = 8
    for words, colour in (
        (f"{report.segmenter} on {len(report.views)} views of {report.data}", None),
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
