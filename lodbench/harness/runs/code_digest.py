"""A digest of the code a result depends on: no version number has to be remembered."""

from __future__ import annotations

import inspect
from functools import cache
from importlib.metadata import version
from pathlib import Path

from lodbench.storage import digest_of, file_digest

# Layers whose code decides an estimate; readers are covered by the scene's digest.
_LAYERS = (
    "geometry", "rendering", "citymap", "segmentation", "synthesis", "matching", "methods", "harness",
)  # fmt: skip
_LIBRARIES = ("numpy", "numba", "opencv-python-headless")


def code_digest(*parts: object) -> str:
    """Returns a digest of lodbench's own code, of the libraries that compute, and of some parts' packages.

    Args:
        parts: A method, a segmenter: the Python files beside the one that defines them count in; and what
            one that runs elsewhere says of its code there, ``remote_code``.
    """
    elsewhere = [list(getattr(part, "remote_code", ())) for part in parts if hasattr(part, "remote_code")]
    folders = sorted({Path(inspect.getfile(type(part))).parent for part in parts})
    files = [file for folder in folders for file in sorted(folder.glob("*.py"))]
    return digest_of([_own_digest(), [file_digest(file) for file in files], *elsewhere])


@cache
def _own_digest() -> str:
    package = Path(__file__).parents[2]
    files = [file for layer in _LAYERS for file in sorted((package / layer).rglob("*.py"))]
    files.append(package / "storage" / "streams.py")
    return digest_of([[file_digest(file) for file in files], [version(name) for name in _LIBRARIES]])
