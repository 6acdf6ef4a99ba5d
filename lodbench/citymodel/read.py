"""Opening a city model: what kind of file it is, and the reader that fits."""

from __future__ import annotations

from pathlib import Path, PurePath

from lodbench.citymodel.codes import FILE_SKIPPED
from lodbench.citymodel.mesh import mesh_city
from lodbench.citymodel.model import CityModel
from lodbench.citymodel.polygons import finish_model
from lodbench.citymodel.raw import NotACity, RawCity, merge_cities
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.source import Source, open_sources
from lodbench.findings import Findings

_SUPPORTED = (
    "Supported: CityGML (.gml, .xml, .citygml), CityJSON (.json, .jsonl), Wavefront OBJ (.obj), "
    "these as .gz or in a .zip, and folders of them."
)


def read_city_model(path: str | Path, *, crs: str | None = None, is_strict: bool = True) -> CityModel:
    """Returns a city model in metres, in a local frame.

    Args:
        path: A file, a ``.gz``, a ``.zip``, or a folder of tiles, which become one model.
        crs: Reference system of its coordinates, instead of the one it declares.
        is_strict: Whether a coordinate that is no finite number is an error; if not, its polygon
            is dropped with a finding.

    Raises:
        CityModelError: The file is missing, unreadable, empty, damaged or of an unknown kind, or
            has no building.
    """
    sources = open_sources(Path(path))
    if len(sources) == 1:
        raw = _read_raw(sources[0], is_strict)
    else:
        raw = _read_tiles(str(path), sources, is_strict)
    return finish_model(raw, crs=crs)


def open_scene(path: str | Path, *, lod: str | None = None, crs: str | None = None) -> Scene:
    """Returns one level of detail of a city file as a scene: ``read_city_model`` and ``mesh_city``.

    Args:
        path: The file.
        lod: Level name (``"1"``), or None for the lowest that has walls.
        crs: Reference system of its coordinates, instead of the one it declares.

    Raises:
        CityModelError: The file cannot be read, or has no building at that level.
    """
    return mesh_city(read_city_model(path, crs=crs), lod)


def _read_tiles(name: str, sources: tuple[Source, ...], is_strict: bool) -> RawCity:
    """Returns the tiles of a folder or archive as one city; files without a building are told of."""
    tiles: list[RawCity] = []
    skipped = Findings()
    for source in sources:
        try:
            tiles.append(_read_raw(source, is_strict))
        except NotACity as error:
            if source is sources[-1] and not tiles:
                raise
            skipped.add(FILE_SKIPPED, source.name, error.message)
    city = merge_cities(name, tiles)
    city.findings.items[:0] = skipped.items
    return city


def _read_raw(source: Source, is_strict: bool) -> RawCity:
    head = source.head()
    text = head.replace(b"\0", b"").lstrip(b"\xef\xbb\xbf\xff\xfe \r\n\t")
    suffixes = [suffix.lower() for suffix in PurePath(source.name).suffixes[-2:]]
    if text.startswith(b"<"):
        from lodbench.citymodel.citygml import read_citygml

        return read_citygml(source.open, source.name, is_strict=is_strict)
    if text.startswith((b"{", b"[")):
        from lodbench.citymodel.cityjson import read_cityjson

        return read_cityjson(source.open, source.name, is_strict=is_strict)
    first_words = {line.split(None, 1)[0] for line in text.splitlines() if line.strip()}
    if ".obj" in suffixes or first_words & {b"v", b"f", b"o", b"mtllib"}:
        from lodbench.citymodel.obj import read_obj

        with source.open() as stream:
            return read_obj(stream, source.name)
    raise NotACity(f"{source.name} is no city model that lodbench can read.", _SUPPORTED)
