"""What back ends need of a system: the Debian package of a missing library, and a GL driver that answers."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from lodbench.errors import RenderingError

# Shared library -> Debian and Ubuntu package.
DEBIAN_PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libGLESv2.so.2": "libgles2",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libusb-1.0.so.0": "libusb-1.0-0",
}

# All the packages each back end needs beyond what its wheel brings.
RENDERER_PACKAGES = {
    "pyrender": ("libegl1", "libgl1-mesa-dri", "libgles2"),
    "open3d": ("libgl1", "libgomp1", "libusb-1.0-0", "libx11-6"),
}


def import_fault(renderer: str, error: Exception) -> RenderingError:
    """Returns the fault of a back end that cannot be imported, with what to install as its hint."""
    everything = " ".join(RENDERER_PACKAGES[renderer])
    library = _missing_library(str(error))
    if library is None:
        hint = f"pip install 'lodbench[render]'; Debian: apt-get install {everything}."
        return RenderingError(f"The {renderer} back end cannot be imported ({error}).", hint)
    return RenderingError(
        f"The {renderer} back end needs the system library {library}, which is absent.",
        f"Debian: apt-get install {DEBIAN_PACKAGES.get(library, everything)} (it needs {everything} in all).",
    )


def _missing_library(message: str) -> str | None:
    """Returns the file name of the library that a loader's message complains about."""
    named = re.search(r"lib[\w.+-]+\.so[\w.]*", message)
    if named:
        return named[0]
    # PyOpenGL names what it looked for without its file name.
    return "libEGL.so.1" if "Unable to load EGL library" in message else None


# A first context takes a second or two; a driver that is silent for this long hangs.
_PATIENCE_S = 60.0
_TRIAL = (sys.executable, "-m", "lodbench.rendering.backends")
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
