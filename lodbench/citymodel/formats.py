"""The formats of cities: one table that opening files, folders, archives, messages and help read.

A format is an entry point of the group ``lodbench.city_readers``, lodbench's own and those of other packages
alike: an object with ``label``, ``suffixes``, ``identify`` and ``read``. A function of a source and options
alone reads what a profile or ``reader`` names it for, and is requested nothing else.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from lodbench.errors import ConfigError
from lodbench.plugins import PlugIn, blaming, installed

# What a mesh is called, by the ending of its file.
MESH_FORMATS = {".ply": "PLY", ".stl": "STL", ".glb": "glTF", ".gltf": "glTF"}
# Rasters and laser points, read from a path; in a folder where nothing else is a city.
SURFACE_SUFFIXES = (".tif", ".tiff", ".asc", ".laz", ".las")
_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class CityFormat:
    """A format of cities."""

    name: str  # of its entry point
    label: str  # what people call it
    suffixes: tuple[str, ...]  # endings of its files, in small letters, with the dot
    # Tells from a file's first bytes and its ending whether it is of the format
    identify: Callable[[bytes, str], bool]
    read: Callable[..., Any]  # returns the ``RawCity`` of a ``Source``, with ``ReadOptions``
    needs_path: bool = False  # whether it is read from a path, never from a stream of ours
    is_tile: bool = True  # whether its files are looked for in folders and archives


def city_formats() -> tuple[CityFormat, ...]:
    """Returns the formats of all packages, lodbench's own first; one that is broken is left out."""
    return _formats_of(installed("city_readers"))


@lru_cache(maxsize=8)
def _formats_of(plug_ins: tuple[PlugIn, ...]) -> tuple[CityFormat, ...]:
    formats = []
    for plug_in in plug_ins:
        try:
            part = plug_in.load()
        except ConfigError as error:
            _LOGGER.debug("%s", error)
            continue
        suffixes = getattr(part, "suffixes", ())
        is_whole = all(callable(getattr(part, name, None)) for name in ("identify", "read"))
        if not (is_whole and isinstance(suffixes, tuple) and all(map(_is_suffix, suffixes))):
            continue
        label = str(getattr(part, "label", plug_in.name))
        is_tile, needs_path = bool(getattr(part, "is_tile", True)), bool(getattr(part, "needs_path", False))
        formats.append(
            CityFormat(plug_in.name, label, suffixes, part.identify, part.read, needs_path, is_tile)
        )
    return tuple(formats)


def _is_suffix(text: object) -> bool:
    return isinstance(text, str) and len(text) > 1 and text.startswith(".") and text == text.lower()


def suffixes_of(*, needs_path: bool) -> tuple[str, ...]:
    """Returns the endings of tiles that are read from a path, or of those read from a stream."""
    return tuple(
        dict.fromkeys(
            suffix
            for each in city_formats()
            if each.needs_path == needs_path and each.is_tile
            for suffix in each.suffixes
        )
    )


def identify(head: bytes, suffix: str) -> CityFormat | None:
    """Returns the format of a file, None for none.

    Formats with the file's ending are tried first, then all others, for endings may be wrong.

    Args:
        head: Its first bytes.
        suffix: Its ending, in small letters, that of compression left out.

    Raises:
        ConfigError: Code of another package fails.
    """
    for each in sorted(city_formats(), key=lambda each: suffix not in each.suffixes):
        if not each.needs_path:
            with blaming("city_readers", each.name, "identify a file"):
                if each.identify(head, suffix):
                    return each
    return None


def formats_in_words() -> str:
    """Returns the formats and the endings of their files in a line."""
    return ", ".join(f"{each.label} ({', '.join(each.suffixes)})" for each in city_formats())


def text_of(head: bytes) -> bytes:
    """Returns the first bytes of a text, NUL bytes, a byte order mark and white space left out."""
    return head.replace(b"\0", b"").lstrip(b"\xef\xbb\xbf\xff\xfe \r\n\t")
