"""The page on which a mask is corrected: served to this machine alone, until it is closed."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib.resources import files
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.harness.local_page import LocalServer, saved_or_why
from lodbench.harness.mask.session import Mask, MaskSession, Window

# No stroke has more points or a wider brush, pixels: the page ends one before.
_MOST_POINTS, _MOST_RADIUS = 20_000, 2_000.0
# The mask is shown in squares: after a stroke few of them are drawn again, of a photo of any size.
_TILE_PX = 1024
# Of what is building, and of its rim: blue, green, red, opacity.
_INSIDE, _RIM = (0, 140, 255, 90), (255, 255, 255, 255)
_PAGE = "templates/mask.html.jinja"


class MaskServer(LocalServer):
    """Serves one session.

    Args:
        session: What is corrected.
        name: Of the photo, for the page's title.
        save: Called to keep the mask; returns the message for the reader.
        port: To listen at; 0 for any that is free.
    """

    def __init__(self, session: MaskSession, name: str, save: Callable[[], str], port: int = 0) -> None:
        super().__init__(port)
        self.session, self.name, self.save = session, name, save

    def shown(self, address: str) -> tuple[bytes, str] | None:
        """Returns the page, the photo, the mask, or a square of the mask as it is drawn over the photo."""
        match address:
            case "":
                return _page(self.name, self.session), "text/html; charset=utf-8"
            case "photo.jpg":
                return _encoded(".jpg", self.session.photo[..., ::-1]), "image/jpeg"
            case "mask.png":
                with self.lock:
                    return _encoded(".png", self.session.mask.astype(np.uint8) * 255), "image/png"
        return self._tile(address)

    def _tile(self, address: str) -> tuple[bytes, str] | None:
        """Returns the square "tile/COLUMN/ROW.png"; None where there is none."""
        place = re.fullmatch(r"tile/(\d{1,4})/(\d{1,4})\.png", address)
        if place is None:
            return None
        column, row = (int(number) * _TILE_PX for number in place.groups())
        with self.lock:
            mask = self.session.mask
        if row >= mask.shape[0] or column >= mask.shape[1]:
            return None
        return _encoded(".png", _drawn(mask, row, column), cv2.IMWRITE_PNG_COMPRESSION, 1), "image/png"

    def done(self, address: str, content: dict[str, Any]) -> dict[str, Any] | None:
        """Draws a stroke, takes one back or draws it again, saves, or stops."""
        session = self.session
        match address:
            case "stroke":
                points = np.array(content["points"], np.float64).reshape(-1, 2)
                radius = float(content["radius"])
                if (
                    not 0 < len(points) <= _MOST_POINTS
                    or not np.isfinite(points).all()
                    or np.abs(points).max() > 1e6
                    or not 0 <= radius <= _MOST_RADIUS
                ):
                    raise ValueError
                is_exact = bool(content.get("exact", False))
                return self._changed(session.stroke(points, radius, bool(content["building"]), is_exact))
            case "undo":
                return self._changed(session.undo())
            case "redo":
                return self._changed(session.redo())
            case "save":
                return self._saved()
            case "stop":
                # The session knows; a page that was loaded again knows of no strokes.
                if session.is_changed and content.get("sure") is not True:
                    return {
                        "message": "NOT closed: what was drawn since the last Save is lost.",
                        "closes": False,
                    }
                return {"message": "Closed. This page may be left.", "closes": True}
        return None

    def _changed(self, window: Window | None) -> dict[str, Any]:
        """Returns what the page shows after a change: the share of building, the tiles that may differ."""
        session = self.session
        spans = [] if window is None else [[part.start, part.stop] for part in window]
        return {
            "share": float(session.mask.mean()),
            "rows_columns": spans,
            "can_undo": session.can_undo,
            "can_redo": session.can_redo,
        }

    def _saved(self) -> dict[str, Any]:
        """Returns what was saved, or why nothing was: the page stays, and what was drawn with it."""
        answer = saved_or_why(self.save)
        if answer["saved"]:
            self.session.is_changed = False
        return answer


def _page(name: str, session: MaskSession) -> bytes:
    from jinja2 import Environment

    template = files("lodbench.harness.mask").joinpath(_PAGE).read_text(encoding="utf-8")
    height, width = session.mask.shape
    facts = {"width": width, "height": height, "tile_px": _TILE_PX, "most_points": _MOST_POINTS}
    steps = {"can_undo": session.can_undo, "can_redo": session.can_redo}
    return Environment(autoescape=True).from_string(template).render(name=name, **facts, **steps).encode()


def _drawn(mask: Mask, row: int, column: int) -> NDArray[np.uint8]:
    """Returns a square of a mask as it lies over the photo: BGR and opacity; one pixel where it is empty."""
    square = mask[row : row + _TILE_PX, column : column + _TILE_PX]
    if not square.any():
        return np.zeros((1, 1, 4), np.uint8)
    top, left = max(0, row - 1), max(0, column - 1)
    with_margin = mask[top : row + _TILE_PX + 1, left : column + _TILE_PX + 1].astype(np.uint8)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    is_core = cv2.erode(with_margin, cross)[row - top :, column - left :][: len(square), : square.shape[1]]
    colours = np.array(((0, 0, 0, 0), _RIM, _INSIDE), np.uint8)
    return np.asarray(colours[square.astype(np.uint8) + is_core])


def _encoded(ending: str, picture: Any, *options: int) -> bytes:
    return cv2.imencode(ending, np.ascontiguousarray(picture), options)[1].tobytes()
