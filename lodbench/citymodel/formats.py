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
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, BinaryIO

from lodbench.citymodel.options import MESH_FORMATS, SURFACE_SUFFIXES
from lodbench.errors import CityModelError, ConfigError
from lodbench.plugins import PlugIn, blaming, installed

if TYPE_CHECKING:
    from lodbench.citymodel.options import ReadOptions
    from lodbench.citymodel.raw import RawCity
    from lodbench.citymodel.textures import SurfaceTextures

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


def _text_of(head: bytes) -> bytes:
    """Returns the first bytes of a text, NUL bytes, a byte order mark and white space left out."""
    return head.replace(b"\0", b"").lstrip(b"\xef\xbb\xbf\xff\xfe \r\n\t")


class CityGml:
    """CityGML 1.0 to 3.0 (a ``CityFormat``)."""

    label = "CityGML"
    suffixes = (".gml", ".xml", ".citygml")

    @staticmethod
    def identify(head: bytes, suffix: str) -> bool:
        """Returns whether a file begins as XML does."""
        return _text_of(head).startswith(b"<")

    @staticmethod
    def read(source: Source, options: ReadOptions) -> RawCity:
        """Returns the buildings, and what ``options.layers`` names."""
        from lodbench.citymodel.gml.reader import read_citygml

        return read_citygml(source.open, source.name, options, _textures_of(source, options))


class CityJson:
    """CityJSON and CityJSONSeq (a ``CityFormat``)."""

    label = "CityJSON"
    suffixes = (".json", ".jsonl")

    @staticmethod
    def identify(head: bytes, suffix: str) -> bool:
        """Returns whether a file begins as JSON does."""
        return _text_of(head).startswith((b"{", b"["))

    @staticmethod
    def read(source: Source, options: ReadOptions) -> RawCity:
        """Returns the buildings, and what ``options.layers`` names."""
        from lodbench.citymodel.cityjson.reader import read_cityjson

        return read_cityjson(source.open, source.name, options, _textures_of(source, options))


class Obj:
    """Wavefront OBJ (a ``CityFormat``)."""

    label = "OBJ"
    suffixes = (".obj",)

    @staticmethod
    def identify(head: bytes, suffix: str) -> bool:
        """Returns whether a file is called so, or its lines begin as points and faces do."""
        text = _text_of(head)
        if text.startswith((b"<", b"{", b"[")):
            return False
        first_words = {line.split(None, 1)[0] for line in text.splitlines() if line.strip()}
        return suffix == ".obj" or bool(first_words & {b"v", b"f", b"o", b"mtllib"})

    @staticmethod
    def read(source: Source, options: ReadOptions) -> RawCity:
        """Returns the buildings."""
        from lodbench.citymodel.mesh.reader import read_obj

        with source.open() as stream:
            return read_obj(stream, source.name, options.up_axis)


class Mesh:
    """PLY, STL and glTF (a ``CityFormat``)."""

    label = "meshes"
    suffixes = tuple(MESH_FORMATS)

    @staticmethod
    def identify(head: bytes, suffix: str) -> bool:
        """Returns whether a file is called as these are."""
        return suffix in MESH_FORMATS

    @staticmethod
    def read(source: Source, options: ReadOptions) -> RawCity:
        """Returns the buildings."""
        from lodbench.citymodel.mesh.reader import read_mesh

        with source.open() as stream:
            return read_mesh(stream, source.name, source.suffix, options)


class Footprints:
    """Footprints with heights, as blocks, through GDAL (a ``CityFormat``)."""

    label = "footprints with heights"
    suffixes = (".gpkg", ".shp", ".geojson", ".fgb", ".gdb", ".parquet", ".geoparquet", ".pbf", ".osm")
    needs_path = True

    @staticmethod
    def identify(head: bytes, suffix: str) -> bool:
        """Returns whether a file is called as those that GDAL reads."""
        return suffix in Footprints.suffixes

    @staticmethod
    def read(source: Source, options: ReadOptions) -> RawCity:
        """Returns footprints with heights, as blocks."""
        from lodbench.citymodel.vector.footprints import read_footprints

        return read_footprints(source.vector_path or str(source.path), source.name, options)


class Surface:
    """What rises above the ground of a raster, of laser points, of a folder of tiles (a ``CityFormat``)."""

    label = "surface models"
    suffixes = SURFACE_SUFFIXES
    is_tile = False

    @staticmethod
    def identify(head: bytes, suffix: str) -> bool:
        """Returns whether a file is called as these are."""
        return suffix in SURFACE_SUFFIXES

    @staticmethod
    def read(source: Source, options: ReadOptions) -> RawCity:
        """Returns what rises above the ground."""
        from lodbench.citymodel.surface.reader import read_surface

        return read_surface(source.path, source.name, options)


def _textures_of(source: Source, options: ReadOptions) -> SurfaceTextures | None:
    """Returns what receives the pictures of a file's surfaces, None where they are not kept."""
    if not (options.has_textures and options.has_details):
        return None
    from lodbench.citymodel.textures import SurfaceTextures, TextureFolder

    return SurfaceTextures(TextureFolder(source.path.parent, source.path.parent), "!" in source.name)


HEAD_BYTES = 4096


@dataclass(frozen=True, slots=True)
class Source:
    """One city file, wherever it lies."""

    name: str  # for messages: the path, with the member of an archive after an exclamation mark
    open: Callable[[], BinaryIO]  # opens a fresh stream of its bytes; the caller closes it
    path: Path  # the file on disk that holds it
    vector_path: str | None = None  # what GDAL opens, for a vector file; None for all others
    stamp: tuple[int, ...] = ()  # checksum and size of a member of an archive; empty for files

    @property
    def suffix(self) -> str:
        """Returns the ending of its name, in small letters, that of compression left out."""
        return PurePath(self.name.removesuffix(".gz")).suffix.lower()

    def head(self) -> bytes:
        """Returns the first bytes.

        Raises:
            CityModelError: They cannot be read, or there is nothing but white space.
        """
        with self.open() as stream:
            head = stream.read(HEAD_BYTES)
        if not head.strip(b"\0 \r\n\t"):
            raise CityModelError(f"{self.name} is empty.", "Download or export the file again.")
        return head
