"""The readers of city formats, each an entry point under ``lodbench.city_readers``."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any

from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.pictures import PictureTable
from lodbench.citymodel.raw import NotACity, RawCity
from lodbench.citymodel.source import MESH_SUFFIXES, Source
from lodbench.citymodel.texture_pictures import TextureFolder


def citygml(source: Source, options: ReadOptions) -> RawCity:
    """Returns the buildings of CityGML 1.0 to 3.0, and what ``options.layers`` names."""
    from lodbench.citymodel.citygml import read_citygml

    return read_citygml(source.open, source.name, **_asked(source, options))


def cityjson(source: Source, options: ReadOptions) -> RawCity:
    """Returns the buildings of CityJSON or CityJSONSeq, and what ``options.layers`` names."""
    from lodbench.citymodel.cityjson import read_cityjson

    return read_cityjson(source.open, source.name, **_asked(source, options))


def _asked(source: Source, options: ReadOptions) -> dict[str, Any]:
    """Returns what readers of details are told of the options."""
    folder = TextureFolder(source.path.parent, source.path.parent)
    has_pictures = options.has_textures and options.has_details
    return {
        "is_strict": options.is_strict,
        "has_details": options.has_details,
        "layers": options.layers,
        "day": options.date,
        "pictures": PictureTable(folder, is_packed="!" in source.name) if has_pictures else None,
    }


def obj(source: Source, options: ReadOptions) -> RawCity:
    """Returns the buildings of a Wavefront OBJ."""
    from lodbench.citymodel.obj import read_obj

    with source.open() as stream:
        return read_obj(stream, source.name, options.up_axis)


def mesh(source: Source, options: ReadOptions) -> RawCity:
    """Returns the buildings of a PLY, STL or glTF."""
    from lodbench.citymodel.mesh_reader import read_mesh

    with source.open() as stream:
        return read_mesh(stream, source.name, suffix_of(source), options)


def footprints(source: Source, options: ReadOptions) -> RawCity:
    """Returns footprints with heights, as blocks.

    Raises:
        CityModelError: The file is none that GDAL reads, or the extra is not installed.
    """
    from lodbench.citymodel.footprints import read_footprints

    return read_footprints(source.vector_path or str(source.path), source.name, options)


def reader_of(source: Source) -> str:
    """Returns the name of the reader for a file's content, or failing that its ending.

    Raises:
        CityModelError: The file is empty, or of a kind that no reader of ours knows.
    """
    if source.vector_path is not None:
        return "footprints"
    head = source.head()
    text = head.replace(b"\0", b"").lstrip(b"\xef\xbb\xbf\xff\xfe \r\n\t")
    if suffix_of(source) in MESH_SUFFIXES:
        return "mesh"
    if text.startswith(b"<"):
        return "citygml"
    if text.startswith((b"{", b"[")):
        return "cityjson"
    first_words = {line.split(None, 1)[0] for line in text.splitlines() if line.strip()}
    if suffix_of(source) == ".obj" or first_words & {b"v", b"f", b"o", b"mtllib"}:
        return "obj"
    raise NotACity(
        f"{source.name} is no city model that lodbench can read.",
        "Supported: CityGML (.gml, .xml, .citygml), CityJSON (.json, .jsonl), meshes (.obj, .ply, .stl, "
        ".glb), these as .gz, footprints (.gpkg, .shp, .geojson, .fgb, .parquet), all of them in a .zip, "
        "and folders of them.",
    )


def suffix_of(source: Source) -> str:
    """Returns the ending of a file's name, in small letters, that of compression left out."""
    return PurePath(source.name.removesuffix(".gz")).suffix.lower()
