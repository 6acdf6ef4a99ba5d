"""The contact sheet: picture, mask and overlay of a few views, to see at a glance what was made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.pictures import encoded
from lodbench.errors import DatasetError
from lodbench.storage import write_bytes
from lodbench.synthesis.training_data.params import GenerateParams
from lodbench.synthesis.training_data.plan_views import PlannedView
from lodbench.synthesis.training_data.view_writer import files_of

SHEET_FILE = "overview.png"
_VIEWS, _PER_ROW = 8, 2
_MASK_BGR = np.array([60.0, 170.0, 255.0])

Picture = NDArray[np.uint8]


def write_sheet(params: GenerateParams, views: Sequence[PlannedView], path: Path) -> None:
    """Writes picture, mask and overlay of eight views, evenly chosen, side by side."""
    chosen = [views[k] for k in np.unique(np.linspace(0, len(views) - 1, _VIEWS).round().astype(int))]
    strips = [_strip(params, view, path.parent, params.sheet) for view in chosen]
    strips += [np.full_like(strips[0], 255)] * (-len(strips) % _PER_ROW)
    rows = [np.hstack(strips[k : k + _PER_ROW]) for k in range(0, len(strips), _PER_ROW)]
    write_bytes(path, encoded(np.vstack(rows), ".png", [cv2.IMWRITE_PNG_COMPRESSION, 9]))


def _strip(params: GenerateParams, view: PlannedView, folder: Path, tile: int) -> Picture:
    """Returns the picture (or grey), the mask, and the mask's outline and tint over the picture."""
    files = {path.parent.name: path for path in files_of(params, view, folder)}
    size = (tile, max(1, round(tile * params.size[1] / params.size[0])))
    mask = _read(files["masks"], cv2.IMREAD_GRAYSCALE, size)
    photo = np.full((size[1], size[0], 3), 128, dtype=np.uint8)
    if "images" in files:
        photo = _read(files["images"], cv2.IMREAD_COLOR, size)
    share = (mask.astype(np.float64) / 255.0)[:, :, None] * 0.45
    overlay = (photo * (1.0 - share) + _MASK_BGR * share).astype(np.uint8)
    outlines, _ = cv2.findContours((mask > 127).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(overlay, outlines, -1, (255, 255, 255), 1, cv2.LINE_AA)
    strip = np.hstack([photo, cv2.cvtColor(mask, cv2.COLOR_GRAY2BGR), overlay])
    return np.pad(strip, ((2, 2), (2, 2), (0, 0)), constant_values=255)


def _read(path: Path, flags: int, size: tuple[int, int]) -> Picture:
    picture = cv2.imdecode(np.frombuffer(path.read_bytes(), dtype=np.uint8), flags)
    if picture is None:
        raise DatasetError(f"{path} is no picture.", "Delete it and give the same command again.")
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
