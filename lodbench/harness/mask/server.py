"""The page on which a mask is corrected: served to this machine alone, until it is told to stop."""

from __future__ import annotations

import json
import secrets
import sys
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from threading import Lock, Thread
from typing import Any

import cv2
import numpy as np

from lodbench.errors import LodbenchError
from lodbench.harness.mask.session import MaskSession
from lodbench.storage.atomic import final_name
from lodbench.storage.json_text import parse_json

# No stroke is larger, bytes; and none has more points or a wider brush, pixels.
_MOST_BYTES, _MOST_POINTS, _MOST_RADIUS = 1 << 20, 20_000, 2_000.0
_PAGE = "templates/mask.html.jinja"


class MaskServer(ThreadingHTTPServer):
    """Serves one session on 127.0.0.1; other pages that the browser has open cannot reach it.

    Every address begins with a token that nobody else knows, and requests must name this machine as host.

    Args:
        session: What is corrected.
        name: Of the photo, for the page's title.
        save: Called to keep the mask; returns what the reader is told.
        port: To listen at; 0 for any that is free.
    """

    daemon_threads = True

    def __init__(self, session: MaskSession, name: str, save: Callable[[], str], port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.session, self.name, self.save = session, name, save
        self.token = secrets.token_urlsafe(16)
        self.lock = Lock()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Says nothing of a browser that left before its answer, as one does that is closed or reloaded."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)

    @property
    def address(self) -> str:
        """Returns the page's address."""
        return f"http://127.0.0.1:{self.server_address[1]}/{self.token}/"


class _Handler(BaseHTTPRequestHandler):
    server: MaskServer

    def do_GET(self) -> None:
        """Answers with the page, the photo or the mask."""
        session = self.server.session
        match self._asked():
            case "":
                self._send(_page(self.server.name, session), "text/html; charset=utf-8")
            case "photo.jpg":
                self._send(_encoded(".jpg", session.photo[..., ::-1]), "image/jpeg")
            case "mask.png":
                with self.server.lock:
                    self._send(_encoded(".png", session.mask.astype(np.uint8) * 255), "image/png")
            case _:
                self.send_error(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        """Draws a stroke, takes one back, saves, or stops."""
        asked = self._asked()
        try:
            length = int(self.headers.get("Content-Length", "0"))
            if not 0 <= length <= _MOST_BYTES:
                raise ValueError
            content = parse_json(self.rfile.read(length) or b"{}")
            if not isinstance(content, dict):
                raise ValueError
            with self.server.lock:
                told = self._done(asked, content)
        except (ValueError, KeyError, TypeError, OverflowError):
            self.send_error(HTTPStatus.BAD_REQUEST)
            return
        if told is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self._send(json.dumps(told).encode(), "application/json")
        if told.get("closes"):
            Thread(target=self.server.shutdown).start()

    def _done(self, asked: str | None, content: dict[str, Any]) -> dict[str, Any] | None:
        session = self.server.session
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
                        "told": "NOT closed: what was drawn since the last Save is lost.",
                        "closes": False,
                    }
                return {"told": "Closed. This page may be left.", "closes": True}
        return None

    def _saved(self) -> dict[str, Any]:
        """Returns what was saved, or why nothing was: the page stays, and what was drawn with it."""
        try:
            told = self.server.save()
            self.server.session.is_changed = False
            return {"told": told, "saved": True}
        except OSError as error:
            reason = f"{final_name(error.filename) or 'a file'}: {error.strerror or error}"
            return {"told": f"NOT saved: {reason}", "saved": False}
        except LodbenchError as fault:
            return {"told": f"NOT saved: {fault.message} {fault.hint}".rstrip(), "saved": False}

    def _asked(self) -> str | None:
        """Returns what is asked for below the token; None for what is not meant for this page."""
        host = self.headers.get("Host", "").partition(":")[0]  # without a port where it is 80
        start = f"/{self.server.token}/"
        if host not in ("127.0.0.1", "localhost") or not self.path.startswith(start):
            return None
        return self.path.removeprefix(start).partition("?")[0]

    def _send(self, content: bytes, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(content))),
            ("Cache-Control", "no-store"),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "no-referrer"),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: Any) -> None:
        """Says nothing: the terminal is for people."""


def _page(name: str, session: MaskSession) -> bytes:
    from jinja2 import Environment

    template = files("lodbench.harness.mask").joinpath(_PAGE).read_text(encoding="utf-8")
    height, width = session.mask.shape
    page = Environment(autoescape=True).from_string(template).render(name=name, width=width, height=height)
    return page.encode()


def _encoded(ending: str, picture: Any) -> bytes:
    return cv2.imencode(ending, np.ascontiguousarray(picture))[1].tobytes()
