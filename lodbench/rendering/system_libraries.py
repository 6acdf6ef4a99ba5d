"""Which Debian package holds the system library that a renderer misses."""

from __future__ import annotations

import re

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
