"""From a file to a model, with the reader that fits; from a model to a scene: which level, and its mesh."""

from __future__ import annotations

import io
import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import FILE_SKIPPED, INTERIOR_SKIPPED, LOD_ABSENT, OPTION_UNUSED
from lodbench.citymodel.formats import Source, city_formats, formats_in_words, identify
from lodbench.citymodel.model import (
    FLAT,
    CityModel,
    SurfaceKind,
    has_lod,
    lod_in_words,
    polygon_blocks,
    tell_flat,
)
from lodbench.citymodel.options import SURFACE_SUFFIXES, ReadOptions
from lodbench.citymodel.polygons import finish_model
from lodbench.citymodel.raw import NotACity, RawCity, merge_cities
from lodbench.citymodel.scene import Scene, SceneBuilder
from lodbench.citymodel.source import count_bytes, open_sources
from lodbench.citymodel.triangulate import CHUNK_POLYGONS, polygons_at, triangulate
from lodbench.errors import CityModelError
from lodbench.findings import Findings
from lodbench.plugins import blaming, load_plugin, of_kind


class NothingToMesh(CityModelError):
    """A level of detail whose polygons make no triangle.

    Attributes:
        area_m2: Newell area of the polygons, all of it lost.
        findings: Why.
    """

    def __init__(self, source: str, lod: str, area_m2: float, findings: Findings) -> None:
        super().__init__(
            f"{source} has no surface to mesh at level of detail {lod}.", "Try lodbench city check."
        )
        self.area_m2, self.findings = area_m2, findings


@dataclass(frozen=True, slots=True)
class CityMesh:
    """A scene and what became of the model's area on the way to it."""

    scene: Scene  # triangles, ready for the renderers
    num_polygons: int  # polygons meshed
    area_m2: float  # their Newell area
    meshed_m2: float  # area of their triangles; larger where polygons are bent
    lost_m2: float  # area no triangle covers
    excess_m2: float  # area triangles cover beyond their polygons
    findings: Findings  # what was met while meshing; the model's own findings are not repeated


def mesh_model(
    model: CityModel, lod: str | None = None, *, roof_height: str | None = None, stands_in: bool = True
) -> CityMesh:
    """Returns the mesh of one level of detail, with its areas and findings.

    Args:
        model: The city as read.
        lod: Level name, ``finest`` or ``coarsest`` for each building's own (see ``polygons_at``), or None
            for the lowest that has walls.
        roof_height: Rule by which level 1 is derived where it is requested and absent; None makes
            that an error.
        stands_in: Whether objects that are no buildings and lack the level come with one of theirs.

    Raises:
        CityModelError: The level is absent, or holds no surface.
        ConfigError: The rule is unknown.
    """
    findings = Findings()
    lod = None if lod is None else str(lod)  # in notebooks levels are numbers
    if roof_height is not None:
        from lodbench.citymodel.derive import AT_EAVES, derive_lod1, require_rule

        require_rule(roof_height)
        if lod is None or lod.lower().removeprefix("lod") != "1":
            findings.add(OPTION_UNUSED, "", "roof_height: only level 1 is derived, with lod=1")
        elif not has_lod(model.lods, lod):
            blocks = derive_lod1(model, roof_height, findings)
            # Blocks that end at eaves are not too high.
            pitched = None if roof_height == AT_EAVES else model.pitched
            counts = (len(blocks),)
            model = replace(model, lods=("1",), polygons=blocks, polygons_read=counts, pitched=pitched)
    name, at_level = polygons_at(model, lod, findings, stands_in)
    if name.startswith(FLAT):
        tell_flat(model, findings)
    polygons = model.polygons
    is_interior = (polygons.kind == SurfaceKind.INTERIOR) & (not model.has_interiors)
    for building, count in sorted(Counter(polygons.building[at_level & is_interior].tolist()).items()):
        findings.add(INTERIOR_SKIPPED, model.building_ids[building], f"{count} polygons")
    return _mesh_level(model, name, np.flatnonzero(at_level & ~is_interior), findings)


def _mesh_level(model: CityModel, lod: str, chosen: NDArray[np.int64], findings: Findings) -> CityMesh:
    """Returns the mesh of some polygons of a model, made a few thousand polygons at a time."""
    has_level = np.zeros(len(model.building_ids), np.bool_)
    has_level[model.polygons.building[chosen]] = True
    for building in np.flatnonzero(~has_level):
        findings.add(LOD_ABSENT, model.building_ids[building], f"no {lod_in_words(lod)}")
    for part in _absent_parts(model, chosen, has_level):
        findings.add(LOD_ABSENT, part, f"a building part, no {lod_in_words(lod)}")
    builder = SceneBuilder(model.building_ids)
    areas = np.zeros(4)
    num_triangles = 0
    for num_before, block in polygon_blocks(model.polygons, chosen, CHUNK_POLYGONS):
        result = triangulate(block, model.building_ids, findings, num_before=num_before)
        builder.add(block.points, result.triangles, block.building[result.polygon])
        areas += result.area_m2.sum(), result.meshed_m2.sum(), result.lost_m2, result.excess_m2
        num_triangles += len(result.triangles)
    if num_triangles == 0:
        raise NothingToMesh(model.source, lod, float(areas[0]), findings)
    area_m2, meshed_m2, lost_m2, excess_m2 = areas.tolist()
    scene = builder.finish(lod=lod, crs=model.crs, origin=model.origin, pitched=model.pitched)
    return CityMesh(scene, len(chosen), area_m2, meshed_m2, lost_m2, excess_m2, findings)


def _absent_parts(model: CityModel, chosen: NDArray[np.int64], has_level: NDArray[np.bool_]) -> list[str]:
    """Returns the ids of parts with walls of which nothing is chosen, nor of their building itself."""
    objects, part = model.objects, model.polygons.part
    if objects is None or part is None:
        return []
    is_chosen, has_walls = np.zeros((2, len(objects)), np.bool_)
    is_chosen[part[chosen]] = True
    is_flat = np.array([name.startswith("0") for name in model.lods], np.bool_)
    has_walls[part[~is_flat[model.polygons.lod]]] = True
    is_whole = np.zeros(len(has_level), np.bool_)
    is_whole[objects.building[is_chosen & (objects.parents < 0)]] = True
    is_open = has_walls & ~is_chosen & (has_level & ~is_whole)[objects.building]
    return [objects.ids[n] for n in np.flatnonzero(is_open) if objects.types[n] == "BuildingPart"]


def mesh_city(model: CityModel, lod: str | None = None, *, roof_height: str | None = None) -> Scene:
    """Returns one level of detail of a city as a scene; see ``mesh_model`` for the account of it.

    Args:
        model: The city as read.
        lod: Level name (``"1"``, ``"2.2"``, ``"finest"``), or None for the lowest that has walls.
        roof_height: Rule by which an absent level 1 is derived: median, max, p70 or eave.

    Raises:
        CityModelError: The level is absent, or holds no surface.
    """
    return mesh_model(model, lod, roof_height=roof_height).scene


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
    for counts in (model.findings.counts(), mesh.findings.counts()):
        for code, count in counts.items():
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
    """Returns the tiles of a folder or archive as one city; files without a building are stated of."""
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
    city_format = identify(source.head(), source.suffix)
    if city_format is None:
        raise NotACity(
            f"{source.name} is no city model that lodbench can read.",
            f"Supported: {formats_in_words()}; most as .gz, in a .zip, and folders of them.",
        )
    return city_format.name
