"""Opening a city model with the reader that fits."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from lodbench.citymodel.codes import FILE_SKIPPED
from lodbench.citymodel.formats import SURFACE_SUFFIXES, city_formats, formats_in_words, identify
from lodbench.citymodel.meshing import mesh_model
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.polygons import finish_model
from lodbench.citymodel.raw import NotACity, RawCity, merge_cities
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.source import Source, count_bytes, open_sources
from lodbench.findings import Findings
from lodbench.plugins import blaming, load_plugin, of_kind

_LOGGER = logging.getLogger(__name__)


def read_city_model(
    path: str | Path | Sequence[Path],
    *,
    crs: str | None = None,
    options: ReadOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> CityModel:
    """Returns a city model in metres, in a local frame.

    Args:
        path: A file, a ``.gz``, a ``.zip``, or a folder of tiles, which become one model; or several of them.
        crs: Reference system of its coordinates, instead of the one it declares.
        options: All else that the source does not say itself; ``crs`` goes before its ``crs``.
        progress: Called with bytes read and their total, 0 where compression hides the total.

    Raises:
        CityModelError: The file is missing, unreadable, empty, damaged or of an unknown kind, or
            has no building.
    """
    options = options or ReadOptions()
    if crs is not None:
        options = replace(options, crs=crs)
    paths = [Path(path)] if isinstance(path, str | Path) else path
    sources = tuple(source for each in paths for source in open_sources(each, options.layers))
    name = " + ".join(map(str, paths))
    if progress is not None:
        sources = count_bytes(sources, progress)
    raw = read_source(sources[0], options) if len(sources) == 1 else _read_tiles(name, sources, options)
    return finish_model(raw, options)


def open_scene(
    path: str | Path,
    *,
    lod: str | None = None,
    crs: str | None = None,
    options: ReadOptions | None = None,
    roof_height: str | None = None,
) -> Scene:
    """Returns one level of detail of a city file as a scene: ``read_city_model`` and ``mesh_city``.

    Findings go to the log; take the two steps yourself to have them as data.

    Args:
        path: The file.
        lod: Level name (``"1"``), ``"finest"``, ``"coarsest"``, or None for the lowest that has walls.
        crs: Reference system of its coordinates, instead of the one it declares.
        options: All else that the source does not say itself.
        roof_height: Rule by which an absent level 1 is derived: median, max, p70 or eave.

    Raises:
        CityModelError: The file cannot be read, or has no building at that level.
    """
    model = read_city_model(path, crs=crs, options=options)
    mesh = mesh_model(model, lod, roof_height=roof_height)
    for found in (model.findings.counts(), mesh.findings.counts()):
        for code, count in found.items():
            _LOGGER.info("%s: %s, %d times", path, code, count)
    return mesh.scene


def parse_city_model(data: bytes, name: str = "city", options: ReadOptions | None = None) -> CityModel:
    """Returns a city model from bytes in memory: CityGML, CityJSON, OBJ or a mesh.

    Args:
        data: The content of a file.
        name: What to call it; its ending decides where the content does not.
        options: All that the source does not say itself.

    Raises:
        CityModelError: The bytes are no city model.
    """
    options = options or ReadOptions()
    source = Source(name, lambda: io.BytesIO(data), Path(name))
    return finish_model(read_source(source, options), options)


def _read_tiles(name: str, sources: tuple[Source, ...], options: ReadOptions) -> RawCity:
    """Returns the tiles of a folder or archive as one city; files without a building are told of."""
    tiles: list[RawCity] = []
    skipped = Findings()
    for source in sources:
        try:
            tiles.append(read_source(source, options))
        except NotACity as error:
            if source is sources[-1] and not tiles:
                raise
            skipped.add(FILE_SKIPPED, source.name, error.message)
    city = merge_cities(name, tiles)
    city.findings.items[:0] = skipped.items
    return city


def read_source(source: Source, options: ReadOptions) -> RawCity:
    """Returns what the reader that is named, or else the one for a file's content, makes of it.

    Raises:
        CityModelError: The file is empty, or of a kind that no reader knows.
    """
    name = options.reader or _reader_of(source)
    part = load_plugin("city_readers", name)
    with blaming("city_readers", name, f"read {source.name}"):
        return of_kind(getattr(part, "read", part)(source, options), RawCity)


def _reader_of(source: Source) -> str:
    """Returns the name of the reader for a file's content, or failing that its ending."""
    if source.vector_path is not None:
        return next(
            each.name for each in city_formats() if each.needs_path and source.suffix in each.suffixes
        )
    if source.path.is_dir() or source.suffix in SURFACE_SUFFIXES:
        return "surface"
    found = identify(source.head(), source.suffix)
    if found is None:
        raise NotACity(
            f"{source.name} is no city model that lodbench can read.",
            f"Supported: {formats_in_words()}; most as .gz, in a .zip, and folders of them.",
        )
    return found.name
