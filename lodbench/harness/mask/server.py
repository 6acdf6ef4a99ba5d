"""The page on which a mask is corrected: served to this machine alone, until it is closed."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from typing import Any

import cv2
import numpy as np

from lodbench.harness.local_page import LocalServer, saved_or_why
from lodbench.harness.mask.session import MaskSession

# No stroke has more points or a wider brush, pixels.
_MOST_POINTS, _MOST_RADIUS = 20_000, 2_000.0
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

    def shown(self, asked: str) -> tuple[bytes, str] | None:
        """Returns the page, the photo or the mask."""
        match asked:
            case "":
                return _page(self.name, self.session), "text/html; charset=utf-8"
            case "photo.jpg":
                return _encoded(".jpg", self.session.photo[..., ::-1]), "image/jpeg"
            case "mask.png":
                with self.lock:
                    return _encoded(".png", self.session.mask.astype(np.uint8) * 255), "image/png"
        return None

    def done(self, asked: str, content: dict[str, Any]) -> dict[str, Any] | None:
        """Draws a stroke, takes one back, saves, or stops."""
        session = self.session
        match asked:
            case "stroke":
                points = np.array(content["points"], np.float64).reshape(-1, 2)[:_MOST_POINTS]
                radius = float(content["radius"])
                if (
                    not np.isfinite(points).all()
                    or np.abs(points).max() > 1e6
                    or not 0 <= radius <= _MOST_RADIUS
                ):
                    raise ValueError
                session.stroke(points, radius, bool(content["building"]), bool(content.get("exact", False)))
                return {"share": float(session.mask.mean())}
            case "undo":
                return {"undone": session.undo(), "share": float(session.mask.mean())}
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
    page = Environment(autoescape=True).from_string(template).render(name=name, width=width, height=height)
    return page.encode()


def _encoded(ending: str, picture: Any) -> bytes:
    return cv2.imencode(ending, np.ascontiguousarray(picture))[1].tobytes()
