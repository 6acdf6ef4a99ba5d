"""Pages served to this machine alone: what each of them shares."""

from __future__ import annotations

import json
import secrets
import sys
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Lock, Thread
from typing import Any, cast

from lodbench.errors import LodbenchError
from lodbench.storage.atomic import final_name
from lodbench.storage.json_text import parse_json

# Nothing that a page sends is larger, bytes.
_MOST_BYTES = 1 << 20


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
        found = None if address is None else self._server.shown(address)
        if found is None:
            self.send_error(HTTPStatus.NOT_FOUND)
        else:
            self._send(*found)

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
        return cast(LocalServer, self.server)

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
