"""A GL driver that crashes or hangs: found out in a process of its own, and never waited for without end.

A process that is about to use the driver first lets another one draw a triangle (``gl_trial``); its own
draws are watched, and end it if there is no answer.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from lodbench.errors import RenderingError

# A first context takes a second or two; a driver that is silent for this long hangs.
_PATIENCE_S = 60.0
_TRIAL = (sys.executable, "-m", "lodbench.rendering.gl_trial")
_OTHER_WAYS = "See lodbench doctor --thorough; renderer=open3d and renderer=raster need no GL."

_is_tried = threading.Event()


def require_driver(patience_s: float = _PATIENCE_S) -> None:
    """Makes sure, once per process, that the GL driver draws and does not hang.

    Raises:
        RenderingError: It cannot be opened, crashes or gives no answer in time.
    """
    if _is_tried.is_set():
        return
    try:
        done = subprocess.run(_TRIAL, capture_output=True, text=True, timeout=patience_s)  # noqa: S603
    except subprocess.TimeoutExpired:
        raise RenderingError(
            f"The GL driver gave no answer within {patience_s:.0f} s.", _OTHER_WAYS
        ) from None
    if done.returncode < 0:
        name = signal.Signals(-done.returncode).name
        raise RenderingError(f"The GL driver crashes ({name}).", _OTHER_WAYS)
    if done.returncode != 0:
        said = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise RenderingError(f"The GL driver cannot draw: {said}", _OTHER_WAYS)
    _is_tried.set()


def trust_driver() -> None:
    """Spares this process the trial, because it is one itself."""
    _is_tried.set()


class Watch:
    """Ends the process, saying why, if what it watches takes too long.

    A driver that hangs cannot be interrupted; all that was finished before is on disk by then.
    """

    def __init__(self, patience_s: float = _PATIENCE_S, step_s: float = 1.0) -> None:
        self._patience_s = patience_s
        self._step_s = step_s
        self._since: float | None = None
        self._thread: threading.Thread | None = None

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Watches the block."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._look, daemon=True)
            self._thread.start()
        self._since = time.monotonic()
        try:
            yield
        finally:
            self._since = None

    def _look(self) -> None:
        while True:
            time.sleep(self._step_s)
            since = self._since
            if since is not None and time.monotonic() - since > self._patience_s:
                sys.stderr.write(
                    f"Error: The GL driver has not answered for {self._patience_s:g} s; giving up.\n"
                    f"{_OTHER_WAYS}\n"
                )
                sys.stderr.flush()
                os._exit(2)
