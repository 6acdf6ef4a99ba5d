"""Writing cities: OBJ, PLY and glTF for viewers, CityJSON and CityGML for GIS, a scene for lodbench."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lodbench.citymodel.cache import open_city, store_city
from lodbench.citymodel.cityjson.writer import cityjson_text, cityjsonseq_text
from lodbench.citymodel.crs import require_crs
from lodbench.citymodel.derive import drop_repeats_of_mesh, footprint_boxes, keep_buildings, keep_level
from lodbench.citymodel.gml.writer import CityGmlWriter
from lodbench.citymodel.mesh.reader import MeshFrame
from lodbench.citymodel.mesh.writer import glb_bytes, obj_text, ply_bytes, write_textured
from lodbench.citymodel.model import CityModel, polygon_blocks
from lodbench.citymodel.options import ReadOptions, made_with
from lodbench.citymodel.read import CityMesh, mesh_model
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.source import TILE_INDEX, file_source, own_geojson
from lodbench.citymodel.textured_map import read_textured, textured_model
from lodbench.citymodel.textures import counted_lines, write_pictures
from lodbench.citymodel.triangulate import CHUNK_POLYGONS, triangulate
from lodbench.errors import CityModelError, LodbenchError
from lodbench.findings import Findings
from lodbench.storage import make_folder, write_chunks
from lodbench.storage.disk import disk
from lodbench.storage.json_text import parse_json


@dataclass(frozen=True, slots=True)
class Tile:
    """A square of a city."""

    # Its corner in the city's reference system, metres
    west: float
    south: float
    size_m: float  # its side
    model: CityModel  # the buildings whose middle lies in it

    @property
    def name(self) -> str:
        """Returns its corner in whole metres: ``691000_5335000``."""
        return f"{self.west:.0f}_{self.south:.0f}"


def cut_into_tiles(model: CityModel, size_m: float) -> list[Tile]:
    """Returns the tiles of a city, from south to north and west to east; empty ones are left out.

    A building is in the tile where the middle of its bounding box lies, whole; one without a surface is in
    the first tile.

    Args:
        model: The city.
        size_m: Side of a tile, metres, a whole number.

    Raises:
        CityModelError: The side is no length.
    """
    if not (size_m >= 1 and size_m == int(size_m)):
        raise CityModelError(f"A tile of {size_m} m is none.", "Whole metres, 500 for example.")
    low, high = footprint_boxes(model)
    middle = 0.5 * (low + high) + model.origin[:2]
    has_place = np.isfinite(middle).all(axis=1)
    corner = np.zeros((len(middle), 2))
    corner[has_place] = np.floor(middle[has_place] / size_m) * size_m
    corners, tile_of = np.unique(corner[has_place][:, ::-1], axis=0, return_inverse=True)
    number = np.zeros(len(middle), np.int64)
    number[has_place] = tile_of.reshape(-1)
    return [
        Tile(west, south, size_m, keep_buildings(model, number == n))
        for n, (south, west) in enumerate(corners.tolist())
    ]


def require_no_others(index: Path, files: Collection[str]) -> None:
    """Makes sure that an index replaces none but one of the same tiles.

    Args:
        index: Where it will be written, beside the tiles.
        files: Their names.

    Raises:
        CityModelError: Something else is there, or tiles of an earlier cut, which would be read with these.
    """
    if not index.exists():
        return
    if not index.is_file() or own_geojson(file_source(index)) != TILE_INDEX["lodbench"]:
        raise CityModelError(
            f"{index} is there already, and is no index of tiles.", "Name the tiles otherwise: -o OUT."
        )
    try:
        former = [
            Path(each["properties"]["file"]).name for each in parse_json(index.read_bytes())["features"]
        ]
    except (ValueError, TypeError, LookupError):
        return  # cut off: it names nothing
    others = [name for name in former if name not in files and (index.parent / name).exists()]
    if others:
        raise CityModelError(
            f"{len(others)} tiles of an earlier cut lie beside {index}, {others[0]} for example.",
            "Remove them, which would be read with the new ones, or name the tiles otherwise: -o OUT.",
        )


def tile_index(tiles: list[tuple[Tile, str]], crs: str | None) -> dict[str, Any]:
    """Returns an index of tiles and their files as GeoJSON, longitude and latitude where the system is known.

    Args:
        tiles: Each with the name of its file.
        crs: Reference system of the city, or None: then the squares stand in its own metres.
    """
    features = []
    for tile, file in tiles:
        w, s, e, n = tile.west, tile.south, tile.west + tile.size_m, tile.south + tile.size_m
        ring = np.array([(w, s), (e, s), (e, n), (w, n), (w, s)])
        if crs is not None:
            from pyproj import Transformer

            to_degrees = Transformer.from_crs(require_crs(crs).horizontal, "EPSG:4326", always_xy=True)
            ring = np.round(np.stack(to_degrees.transform(ring[:, 0], ring[:, 1]), axis=1), 8)
        model = tile.model
        features.append(
            {
                "type": "Feature",
                "geometry": {"type": "Polygon", "coordinates": [ring.tolist()]},
                "properties": {
                    "file": file,
                    "buildings": len(model.building_ids),
                    "polygons": len(model.polygons),
                    "bbox": [w, s, e, n],
                    "crs": crs,
                },
            }
        )
    return {**TILE_INDEX, "features": features}


def check_target(target: Path) -> None:
    """Refuses a target whose ending names no format, before a long read is spent on it.

    Raises:
        CityModelError: The ending is unknown, or the folder missing.
    """
    if target.suffix.lower() not in FORMATS:
        raise CityModelError(
            f"No format is known by the ending of {target}.", f"Known: {', '.join(FORMATS)}."
        )
    if not target.parent.is_dir():
        raise CityModelError(
            f"{target} cannot be written: {target.parent} is not a folder.", "Make it first."
        )


@dataclass(frozen=True, slots=True)
class Conversion:
    """What was written."""

    target: Path  # where
    model: CityModel  # the city written: its buildings, levels and polygons
    mesh: CityMesh | None  # the mesh written, with its account of area; None where the polygons are written
    findings: Findings  # what was met on the way, reading included
    left_out: tuple[str, ...] = ()  # a line for each thing the format could not say


def keeps_details(target: Path) -> bool:
    """Returns whether a format has room for attributes and solids, so that they are worth reading."""
    return target.suffix.lower() in (*_CITYJSON_WRITERS, *_CITYGML_SUFFIXES)


def convert_city(
    model: CityModel,
    target: Path,
    *,
    lod: str | None = None,
    roof_height: str | None = None,
    citygml: str = "2.0",
    options: ReadOptions | None = None,
) -> Conversion:
    """Writes a city in the format the target's ending names; a file is written whole or not at all.

    ``.obj``, ``.ply``, ``.glb`` and ``.scene`` hold one level of detail, in the local frame; origin and
    reference system are written beside it. ``.json`` is CityJSON 2.0, ``.jsonl`` CityJSONSeq and ``.gml``
    CityGML, with all levels or the one requested, in the model's reference system, to the millimetre: parts,
    attributes and solids too, where the model was read with ``ReadOptions(has_details=True)``.

    Args:
        model: The city as read.
        target: Where to write.
        lod: Level, as in ``mesh_city``; None is all levels for CityJSON and CityGML, for meshes the
            lowest with walls.
        roof_height: As in ``mesh_city``.
        citygml: Version of CityGML: ``2.0`` or ``3.0``.
        options: What the model was read with: a scene remembers it.

    Raises:
        CityModelError: The ending is unknown, the level absent, or the folder not writable.
    """
    check_target(target)
    suffix = target.suffix.lower()
    findings = Findings(list(model.findings.items))
    mesh: CityMesh | None = None
    left_out: tuple[str, ...] = ()
    lost_pictures: tuple[str, ...] = ()
    chunks: Iterable[bytes] = ()
    writer: CityGmlWriter | None = None
    if keeps_details(target):
        if lod is not None:
            model = keep_level(model, lod, roof_height, findings)
        model = drop_repeats_of_mesh(model, findings)
        check_surfaces(model, findings)
        try:
            pictures = write_pictures(model, target)
        except OSError as error:
            raise _unwritable(target, error) from None
        lost_pictures = pictures.notes
        if suffix in _CITYJSON_WRITERS:
            content, left_out = _CITYJSON_WRITERS[suffix](model, pictures)
            chunks = (content,)
        else:
            writer = CityGmlWriter(model, citygml, pictures)
            chunks = writer.chunks()
    else:
        mesh = mesh_model(model, lod, roof_height=roof_height)
        left_out = (_LOST_NAMES,) if suffix in _NAMELESS_SUFFIXES else ()
        findings.items += mesh.findings.items
        chunks = () if suffix == ".scene" else (_MESH_WRITERS[suffix](mesh.scene),)
    try:
        if suffix == ".scene" and mesh is not None:
            made = None if options is None else made_with(options, roof_height)
            store_city(open_city(model, mesh), target, made=made)
        else:
            write_chunks(target, chunks)
    except OSError as error:
        raise _unwritable(target, error) from None
    left_out = left_out if writer is None else counted_lines(writer.notes)
    return Conversion(target, model, mesh, findings, (*left_out, *lost_pictures))


def _unwritable(target: Path, error: OSError) -> CityModelError:
    return CityModelError(f"{target} cannot be written: {error.strerror}.", "Choose another place or name.")


def has_room_for_pictures(target: Path) -> bool:
    """Returns whether a format can say which picture lies on a surface."""
    return keeps_details(target) or target.suffix.lower() in _TEXTURED_SUFFIXES


def convert_textured(
    model: CityModel, target: Path, source: Path | None = None, options: ReadOptions | None = None
) -> Conversion:
    """Writes the photographed surfaces of a city as ``.glb`` or ``.obj``, each at its finest level.

    Args:
        model: The city as read, with its pictures where there is no ``source``.
        target: Where to write.
        source: Its file, to read it as a textured mesh anew: the way of OBJ, PLY and glTF.
        options: How the file is read then.

    Raises:
        CityModelError: The target is of another format.
        DatasetError: The file has no textures, or their pictures are missing.
    """
    if target.suffix.lower() not in _TEXTURED_SUFFIXES:
        raise CityModelError(f"{target} has no room for pictures.", "Name it .glb or .obj.")
    mesh = textured_model(model) if source is None else read_textured(source, options=options)
    write_textured(mesh, MeshFrame(model.origin, model.crs), target)
    findings = Findings(list(model.findings.items))
    left_out = "names of buildings, and all levels but the finest: triangles stand by picture"
    if source is None and model.pictures is not None and set(model.pictures.wraps) - {"", "wrap"}:
        left_out += "; wrapMode of pictures, which repeat here"
    return Conversion(target, model, None, findings, (left_out, *mesh.notes))


def convert_tiles(
    model: CityModel, target: Path, size_m: float, write: Callable[[CityModel, Path], Conversion]
) -> list[Conversion]:
    """Writes a city as square tiles, ``NAME_EAST_NORTH.SUFFIX``, and their index, ``NAME.geojson``.

    Args:
        model: The city.
        target: Names folder, first part of the names and format; the folder is made where it is not there.
        size_m: Side of a tile, metres.
        write: Writes one of them.

    Raises:
        CityModelError: As for ``convert_city``, or something else than an index of these tiles has its
            name; no new tile and no new folder is left then.
    """
    stem, dot, ending = target.name.partition(".")
    tiles = [(tile, f"{stem}_{tile.name}{dot}{ending}") for tile in cut_into_tiles(model, size_m)]
    index = target.with_name(f"{stem}.geojson")
    require_no_others(index, [file for _, file in tiles])
    with _nothing_left([target.parent, *(target.with_name(file) for _, file in tiles)]):
        make_folder(target.parent)
        done = [write(tile.model, target.with_name(file)) for tile, file in tiles]
    write_chunks(index, (json.dumps(tile_index(tiles, model.crs), indent=1).encode(),))
    return done


@contextmanager
def _nothing_left(paths: Sequence[Path]) -> Iterator[None]:
    """Removes what was not there before where a conversion ends in a fault: a folder and the files in it."""
    new = [path for path in paths if not path.exists()]
    try:
        yield
    except LodbenchError:
        for path in new:
            disk().remove(path)
        raise


def check_surfaces(model: CityModel, findings: Findings) -> None:
    """Adds what meshing would say of polygons: those that are bent, cross themselves or have no area."""
    every = np.arange(len(model.polygons))
    for num_before, block in polygon_blocks(model.polygons, every, CHUNK_POLYGONS):
        triangulate(block, model.building_ids, findings, num_before=num_before)


_CITYJSON_WRITERS = {".json": cityjson_text, ".jsonl": cityjsonseq_text}
_MESH_WRITERS: dict[str, Callable[[Scene], bytes]] = {
    ".obj": lambda scene: obj_text(scene).encode(),
    ".ply": ply_bytes,
    ".glb": glb_bytes,
}
_TEXTURED_SUFFIXES = (".glb", ".obj")
# What is read again from these is a building where it hangs together; OBJ has the names for other programs.
_NAMELESS_SUFFIXES = (".obj", ".ply")
_LOST_NAMES = "names of buildings where lodbench reads it again: what hangs together is one (.glb keeps them)"
_CITYGML_SUFFIXES = (".gml", ".xml", ".citygml")
FORMATS = (*_MESH_WRITERS, *_CITYJSON_WRITERS, *_CITYGML_SUFFIXES, ".scene")
