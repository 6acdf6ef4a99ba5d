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
    library = re.search(r"lib[\w.+-]+\.so[\w.]*", str(error))
    everything = " ".join(RENDERER_PACKAGES[renderer])
    if library is None:
        hint = f"pip install 'lodbench[render]'; Debian: apt-get install {everything}."
        return RenderingError(f"The {renderer} back end cannot be imported ({error}).", hint)
    package = DEBIAN_PACKAGES.get(library[0])
    hint = f"Debian: apt-get install {package}" if package else f"Debian: apt-get install {everything}"
    return RenderingError(
        f"The {renderer} back end needs the system library {library[0]}, which is absent.",
        f"{hint} (the back end needs {everything} in all).",
    )
