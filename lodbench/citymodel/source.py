"""Where the bytes come from: a file, a compressed file, an archive or a folder of tiles.

Nothing is ever unpacked to disk: members of an archive are read in place, within limits, so neither
a path in an archive nor a bomb of zeros can do harm.
"""

from __future__ import annotations

import gzip
import io
import re
import sqlite3
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import lru_cache
from pathlib import Path, PurePath, PurePosixPath
from typing import BinaryIO, TypeVar

from lodbench.citymodel.formats import HEAD_BYTES, Source, suffixes_of
from lodbench.citymodel.options import SURFACE_SUFFIXES, folders_of
from lodbench.citymodel.raw import NotACity
from lodbench.errors import CityModelError

# City models compress 8 to 30 times. Beyond this ratio a stream is taken for a bomb.
_MAX_RATIO = 250
_RATIO_STARTS_AT_BYTES = 1 << 24


class StreamOver(io.RawIOBase):
    """A stream to be read that closes the one below it."""

    def __init__(self, stream: BinaryIO) -> None:
        super().__init__()
        self._stream = stream

    def readable(self) -> bool:
        """Returns True: the stream can be read."""
        return True

    def close(self) -> None:
        """Closes the stream below."""
        if not self.closed:
            self._stream.close()
        super().close()


class BoundedStream(StreamOver):
    """A decompressed stream that stops at a bomb and speaks of damage in words.

    Args:
        stream: Decompressed bytes.
        name: For messages.
        packed_bytes: Size of the compressed data, to tell a bomb by its ratio.
    """

    def __init__(self, stream: BinaryIO, name: str, packed_bytes: int) -> None:
        super().__init__(stream)
        self._name = name
        self._limit = max(_RATIO_STARTS_AT_BYTES, packed_bytes * _MAX_RATIO)
        self._done = 0

    def read(self, size: int = -1) -> bytes:
        """Returns up to ``size`` bytes, all that is left where it is negative.

        Raises:
            CityModelError: The data is damaged or cut off, or expands beyond all reason.
        """
        wanted = self._limit + 1 - self._done if size < 0 else size
        try:
            data = self._stream.read(wanted)
        except (EOFError, zlib.error, gzip.BadGzipFile, zipfile.BadZipFile, OSError) as error:
            raise CityModelError(
                f"{self._name} is damaged or cut off ({error}).", "Download the file again."
            ) from None
        except (RuntimeError, NotImplementedError) as error:
            raise CityModelError(
                f"{self._name} cannot be unpacked: {error}.", "Download the file again."
            ) from None
        self._done += len(data)
        if self._done > self._limit:
            raise CityModelError(
                f"{self._name} expands more than {_MAX_RATIO} times, which no city model does.",
                "If you trust it, unpack it yourself and name the result.",
            )
        return data


Item = TypeVar("Item")

_ARCHIVE_SUFFIXES = (".gz", ".zip")
# Beside the tiles, PLATEAU and others deliver these; none holds a building.
_OTHER_FOLDERS = frozenset({"codelists", "metadata", "schemas", "specification"})
_MAX_MEMBERS = 100_000
_NO_NESTING = "Archives inside an archive are not read"
# How GeoJSON begins that lodbench writes, which is no footprints: the index beside tiles cut by
# ``city convert --tiles``, findings, and what was found of photos.
OWN_GEOJSON = {"type": "FeatureCollection", "lodbench": "result"}
TILE_INDEX = {**OWN_GEOJSON, "lodbench": "tile index"}
# What a GeoPackage of lodbench's own has as the description of its layers.
OWN_GEOPACKAGE = "lodbench result"
_OWN = re.compile(rb'\s*\{\s*"type"\s*:\s*"FeatureCollection"\s*,\s*"lodbench"\s*:\s*"([^"]*)"')


def open_sources(path: Path, layers: Sequence[str] = ()) -> tuple[Source, ...]:
    """Returns the city files at a path: one for a file, several for an archive or a folder.

    Args:
        path: A file, a ``.gz``, a ``.zip``, or a folder of any of these (read recursively). In a
            folder with parts for buildings, roads and so on (``udx/bldg``), the buildings' part.
        layers: Names of ``LAYERS``, whose parts of such a folder are taken too.

    Raises:
        CityModelError: Nothing is there, it cannot be read, or it holds no city file.
    """
    # A pipe would be waited for, a device read without an end.
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise CityModelError(f"{path} is neither a file nor a folder.", "Check the path.")
    if path.suffix.lower() in suffixes_of(needs_path=True) and path.exists():
        return (Source(str(path), lambda: path.open("rb"), path, str(path)),)
    if path.is_dir():
        return _folder_sources(path, layers)
    try:
        with path.open("rb") as stream:
            magic = stream.read(4)
    except FileNotFoundError:
        raise CityModelError(f"There is no city model at {path}.", "Check the path.") from None
    except OSError as error:
        raise CityModelError(f"{path} cannot be read: {error.strerror}.", "Check its permissions.") from None
    if magic[:2] == b"\x1f\x8b":
        return (_gzip_source(path),)
    if magic == b"PK\x03\x04":
        return _zip_sources(path, layers)
    return (file_source(path),)


def is_surface(path: Path) -> bool:
    """Returns whether a path is called as surface models are, or is a folder of nothing but such files."""
    if path.is_dir():
        kinds = {file.suffix.lower() for file in path.iterdir() if file.is_file()}
        return bool(kinds) and kinds <= set(SURFACE_SUFFIXES)
    return path.suffix.lower() in SURFACE_SUFFIXES


def _suffixes() -> tuple[str, ...]:
    return suffixes_of(needs_path=False) + suffixes_of(needs_path=True)


def is_city_file(path: Path) -> bool:
    """Returns whether a file is called as city models are; archives may hold anything."""
    return path.suffix.lower() in _suffixes() and path.is_file()


def _folder_sources(folder: Path, layers: Sequence[str]) -> tuple[Source, ...]:
    from lodbench.citymodel.scene_file import is_scene

    # Its scene.json would pass for a city file by its ending.
    if is_scene(folder):
        raise CityModelError(
            f"{folder} is a scene, which holds triangles only.",
            "run and render take it; look into the file it was made from.",
        )
    suffixes = _suffixes() + _ARCHIVE_SUFFIXES
    files = [
        file
        for file in sorted(folder.rglob("*"))
        if file.suffix.lower() in suffixes
        and file.is_file()
        and _may_hold_buildings(file.relative_to(folder))
        and own_geojson(file_source(file)) is None
        and not is_own_geopackage(file)
    ]
    chosen = _of_layers([(file.relative_to(folder), file) for file in files], layers)
    sources = tuple(source for file in chosen for source in _sources_among(file, layers))
    if not sources and any(file.suffix.lower() in SURFACE_SUFFIXES for file in folder.rglob("*")):
        return (Source(str(folder), lambda: _not_a_stream(folder), folder),)
    if not sources:
        raise CityModelError(
            f"The folder {folder} holds no city file.",
            f"Looked for {', '.join(suffixes)}, in all its folders.",
        )
    return sources


def _not_a_stream(folder: Path) -> BinaryIO:
    raise CityModelError(f"{folder} is a folder of tiles, which are read together.", "Name one of them.")


def _sources_among(file: Path, layers: Sequence[str]) -> tuple[Source, ...]:
    """Returns the city files at a file of a folder; for an archive without one, what refuses to open."""
    try:
        return open_sources(file, layers)
    except NotACity as error:
        return (_refused(str(file), file, error),)


def _refused(name: str, path: Path, fault: NotACity, stamp: tuple[int, ...] = ()) -> Source:
    """Returns what is passed over among tiles, and reported."""

    def refuse() -> BinaryIO:
        raise fault

    return Source(name, refuse, path, stamp=stamp)


def _of_layers(files: Sequence[tuple[PurePath, Item]], layers: Sequence[str]) -> list[Item]:
    """Returns the files in the folders of buildings and layers, all where there is no such folder."""
    folders = folders_of(layers)
    return [item for path, item in files if folders.intersection(path.parts)] or [item for _, item in files]


def _may_hold_buildings(path: Path | PurePosixPath) -> bool:
    if path.name.startswith("._"):
        return False  # what macOS keeps of a file of this name, in the same ending
    return not _OTHER_FOLDERS.intersection(part.lower() for part in path.parts)


def file_source(path: Path) -> Source:
    """Returns the source of a file that is neither compressed nor an archive."""
    return Source(str(path), lambda: path.open("rb"), path)


def own_geojson(source: Source) -> str | None:
    """Returns what GeoJSON of lodbench's own says it is, ``tile index`` or ``result``; None of others."""
    if not source.name.lower().endswith(".geojson"):
        return None
    try:
        with source.open() as stream:
            match = _OWN.match(stream.read(HEAD_BYTES))
    except (OSError, CityModelError):
        return None  # whoever reads it says what is wrong with it
    return None if match is None else match[1].decode("utf-8", "replace")


def is_own_geopackage(path: Path) -> bool:
    """Returns whether a file is a GeoPackage of poses that lodbench wrote."""
    if path.suffix.lower() != ".gpkg":
        return False
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            rows = database.execute("SELECT description FROM gpkg_contents LIMIT 1").fetchall()
    except sqlite3.Error:
        return False  # whoever reads it says what is wrong with it
    return rows == [(OWN_GEOPACKAGE,)]


def _gzip_source(path: Path) -> Source:
    def open_stream() -> BinaryIO:
        return BoundedStream(gzip.open(path, "rb"), str(path), path.stat().st_size)  # type: ignore[return-value, arg-type]

    return Source(str(path), open_stream, path)


def _zip_sources(path: Path, layers: Sequence[str]) -> tuple[Source, ...]:
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise CityModelError(f"{path} is no readable zip ({error}).", "Download the file again.") from None
    if len(members) > _MAX_MEMBERS:
        raise CityModelError(f"{path} holds more than {_MAX_MEMBERS} files.", "Unpack the tiles you need.")
    sources = tuple(_zip_members(path, members, layers))
    packed = tuple(_packed_members(path, members))
    if not sources:
        names = ", ".join(member.filename for member in members[:5])
        hint = f"It holds: {names}." if names else "It is empty."
        if packed:
            # These may well hold tiles: no folder passes over them.
            raise CityModelError(f"{path} holds no city file.", f"{_NO_NESTING}: unpack the outer one.")
        raise NotACity(f"{path} holds no city file.", hint)
    return sources + packed


def _packed_members(path: Path, members: list[zipfile.ZipInfo]) -> Iterator[Source]:
    """Yields the archives inside an archive, which are not read."""
    for member in members:
        if member.filename.lower().endswith(_ARCHIVE_SUFFIXES) and _may_hold_buildings(
            PurePosixPath(member.filename)
        ):
            name = f"{path}!{member.filename}"
            fault = NotACity(f"{name}: {_NO_NESTING}.", "Unpack the outer one.")
            yield _refused(name, path, fault, (member.CRC, member.file_size))


def _zip_members(path: Path, members: list[zipfile.ZipInfo], layers: Sequence[str]) -> Iterator[Source]:
    chosen = []
    suffixes, by_path = _suffixes(), suffixes_of(needs_path=True)
    for member in members:
        name = PurePosixPath(member.filename.replace("\\", "/"))
        if name.is_absolute() or ".." in name.parts or ":" in name.parts[0] if name.parts else False:
            raise CityModelError(
                f"{path} has a member with the unsafe path {member.filename!r}.", "Do not trust this file."
            )
        if (
            not member.is_dir()
            and name.suffix.lower() in suffixes
            and _may_hold_buildings(name)
            and own_geojson(_zip_source(path, member)) is None
        ):
            chosen.append((name, member))
    for member in _of_layers(sorted(chosen, key=lambda pair: str(pair[0])), layers):
        if member.filename.lower().endswith(by_path):
            inside = f"/vsizip/{path}/{member.filename}"
            stamp = (member.CRC, member.file_size)
            yield Source(f"{path}!{member.filename}", lambda: path.open("rb"), path, inside, stamp)
        else:
            yield _zip_source(path, member)


def _zip_source(path: Path, member: zipfile.ZipInfo) -> Source:
    name = f"{path}!{member.filename}"

    def open_stream() -> BinaryIO:
        try:
            stream = _archive(path, path.stat().st_mtime_ns).open(member)
        except (zipfile.BadZipFile, OSError, RuntimeError, NotImplementedError) as error:
            hint = "Take the password off." if member.flag_bits & 1 else "Download the file again."
            raise CityModelError(f"{name} cannot be unpacked ({error}).", hint) from None
        return BoundedStream(stream, name, member.compress_size)  # type: ignore[return-value, arg-type]

    return Source(name, open_stream, path, stamp=(member.CRC, member.file_size))


@lru_cache(maxsize=4)
def _archive(path: Path, modified_ns: int) -> zipfile.ZipFile:
    """Returns an archive that stays open: its list of members is long where it has thousands of tiles."""
    return zipfile.ZipFile(path)


class CountedStream(StreamOver):
    """A stream that tells how many bytes have been read from it.

    Args:
        stream: Where the bytes come from.
        report: Called with the number of bytes after each read.
    """

    def __init__(self, stream: BinaryIO, report: Callable[[int], None]) -> None:
        super().__init__(stream)
        self._report = report

    def read(self, size: int = -1) -> bytes:
        """Returns up to ``size`` bytes, all that is left where it is negative."""
        return self._counted(self._stream.read(size))

    def readline(self, size: int | None = -1) -> bytes:
        """Returns the next line, or its first ``size`` bytes."""
        return self._counted(self._stream.readline(-1 if size is None else size))

    def _counted(self, data: bytes) -> bytes:
        self._report(len(data))
        return data


def count_bytes(sources: tuple[Source, ...], progress: Callable[[int, int], None]) -> tuple[Source, ...]:
    """Returns the sources with every read counted towards one progress.

    Args:
        sources: What will be read.
        progress: Called with the bytes read and their total, 0 where compression hides it.
    """
    is_packed = any("!" in source.name or source.name.endswith(".gz") for source in sources)
    paths = {source.path for source in sources if source.path.is_file()}
    total = 0 if is_packed else sum(path.stat().st_size for path in paths)
    done = 0

    def report(num_bytes: int) -> None:
        nonlocal done
        done += num_bytes
        progress(min(done, total) if total else done, total)

    def counted(source: Source) -> Source:
        def open_stream() -> BinaryIO:
            return CountedStream(source.open(), report)  # type: ignore[return-value]

        return replace(source, open=open_stream)

    return tuple(counted(source) for source in sources)
