"""Pages served to this machine alone, and the one on which a mask is corrected."""

from __future__ import annotations

import json
import re
import secrets
import sys
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from threading import Lock, Thread
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.errors import LodbenchError
from lodbench.harness.mask import Mask, MaskSession, Window
from lodbench.storage.disk import final_name
from lodbench.storage.json_text import parse_json

# Nothing that a page sends is larger, bytes.
_MOST_BYTES = 1 << 20
# No stroke has more points or a wider brush, pixels: the page ends one before.
_MOST_POINTS, _MOST_RADIUS = 20_000, 2_000.0
# The mask is shown in squares: after a stroke few of them are drawn again, of a photo of any size.
_TILE_PX = 1024
# Of what is building, and of its rim: blue, green, red, opacity.
_INSIDE, _RIM = (0, 140, 255, 90), (255, 255, 255, 255)
_PAGE = "templates/mask.html.jinja"


class LocalServer(ThreadingHTTPServer):
    """Serves a page on 127.0.0.1; other pages that the browser has open cannot reach it.

    Every address begins with a token that nobody else knows, and requests must name this machine as host.
    Subclasses answer: ``shown`` and ``done``.

    Args:
        port: To listen at; 0 for any that is free.
    """

    daemon_threads = True

    def __init__(self, port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.token = secrets.token_urlsafe(16)
        self.lock = Lock()

    def shown(self, address: str) -> tuple[bytes, str] | None:
        """Returns what is at an address below the token, and its media type; None for nothing."""
        raise NotImplementedError

    def done(self, address: str, content: dict[str, Any]) -> dict[str, Any] | None:
        """Does what is requested, under the lock, and returns the answer; None for nothing known.

        An answer whose ``closes`` is true ends the server. ValueError, KeyError, TypeError and OverflowError
        mean a malformed request.
        """
        raise NotImplementedError

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Says nothing of a browser that left before its answer, as one does that is closed or reloaded."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)

    @property
    def address(self) -> str:
        """Returns the page's address."""
        return f"http://127.0.0.1:{self.server_address[1]}/{self.token}/"


def saved_or_why(save: Callable[[], str]) -> dict[str, Any]:
    """Returns what a page says of a save: ``message`` and ``saved``."""
    try:
        return {"message": save(), "saved": True}
    except OSError as error:
        reason = f"{final_name(error.filename) or 'a file'}: {error.strerror or error}"
        return {"message": f"NOT saved: {reason}", "saved": False}
    except LodbenchError as fault:
        return {"message": f"NOT saved: {fault.message} {fault.hint}".rstrip(), "saved": False}


class _Handler(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        """Answers with the page, or what it shows."""
        address = self._address()
        response = None if address is None else self._server.shown(address)
        if response is None:
            self.send_error(HTTPStatus.NOT_FOUND)
        else:
            self._send(*response)

    def do_POST(self) -> None:
        """Does what the page asks for."""
        address = self._address()
        try:
            length = int(self.headers.get("Content-Length", "0"))
            if not 0 <= length <= _MOST_BYTES:
                raise ValueError
            content = parse_json(self.rfile.read(length) or b"{}")
            if not isinstance(content, dict):
                raise ValueError
            with self._server.lock:
                answer = None if address is None else self._server.done(address, content)
        except (ValueError, KeyError, TypeError, OverflowError):
            self.send_error(HTTPStatus.BAD_REQUEST)
            return
        if answer is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self._send(json.dumps(answer).encode(), "application/json")
        if answer.get("closes"):
            Thread(target=self.server.shutdown).start()

    @property
    def _server(self) -> LocalServer:
        return cast("LocalServer", self.server)

    def _address(self) -> str | None:
        """Returns what is requested below the token; None for what is not meant for this page."""
        host = self.headers.get("Host", "").partition(":")[0]  # without a port where it is 80
        start = f"/{self._server.token}/"
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


class MaskServer(LocalServer):
    """Serves one session; ``save`` keeps the mask and returns the message for the reader."""

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
        answer = saved_or_why(self.save)
        if answer["saved"]:
            self.session.is_changed = False
        return answer


def _page(name: str, session: MaskSession) -> bytes:
    from jinja2 import Environment

    template = files("lodbench.harness").joinpath(_PAGE).read_text(encoding="utf-8")
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
