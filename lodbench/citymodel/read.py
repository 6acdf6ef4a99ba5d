"""Opening a city model with the reader that fits."""

from __future__ import annotations

import io
import logging
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import FILE_SKIPPED
from lodbench.citymodel.formats import SURFACE_SUFFIXES, city_formats, formats_in_words, identify
from lodbench.citymodel.lifespans import common_period
from lodbench.citymodel.meshing import NothingToMesh, mesh_model
from lodbench.citymodel.model import CityModel, CityObjects, Solids
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.pictures import merge_pictures
from lodbench.citymodel.polygons import finish_model
from lodbench.citymodel.raw import GrowingArray, NotACity, RawCity, buildings_only, joined, starts_of
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.source import Source, StreamOver, open_sources
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
    found = identify(source.head(), source.suffix)
    if found is None:
        raise NotACity(
            f"{source.name} is no city model that lodbench can read.",
            f"Supported: {formats_in_words()}; most as .gz, in a .zip, and folders of them.",
        )
    return found.name


def city_info(model: CityModel) -> dict[str, Any]:
    """Returns a summary made of plain values, ready for JSON.

    Returns:
        ``format, version, crs, center_lat_lon`` (degrees, or None without a reference system),
        ``buildings, parts, objects`` (of opted-in layers, type to count), ``pitched_roofs`` (buildings that
        the source states to have one), ``extent_m`` (x, y, z lengths), ``lods``: level name to
        ``polygons`` (as in the file), ``triangles``, ``area_m2`` (of the polygons), ``meshed_m2`` and
        ``lost_m2``; and ``findings``: code and name to count, meshing included; ``finding_objects``: to
        how many buildings they were met in.
    """
    points = model.polygons.points
    types = Counter(
        "Building" if own else name for name, own in zip(model.types(), model.is_building(), strict=True)
    )
    extent = np.ptp(points, axis=0) if len(points) else np.zeros(3)
    findings = Findings(list(model.findings.items))
    lods: dict[str, dict[str, float]] = {}
    for name, num_read in zip(model.lods, model.polygons_read, strict=True):
        row: dict[str, float] = {"polygons": num_read, "triangles": 0, "area_m2": 0.0}
        try:
            mesh = mesh_model(model, name, stands_in=False)
        except NothingToMesh as nothing:
            findings.items += nothing.findings.items
            row["lost_m2"] = row["area_m2"] = round(nothing.area_m2, 3)
        else:
            findings.items += mesh.findings.items
            row["triangles"] = len(mesh.scene.triangles)
            row["area_m2"] = round(mesh.area_m2, 3)
            row["meshed_m2"] = round(mesh.meshed_m2, 3)
            row["lost_m2"] = round(mesh.lost_m2, 3)
        lods[name] = row
    return {
        "format": model.format,
        "version": model.version,
        "crs": model.crs,
        "center_lat_lon": _center_lat_lon(model),
        "buildings": types["Building"],
        "parts": model.num_parts,
        "objects": {name: count for name, count in sorted(types.items()) if name != "Building"},
        "pitched_roofs": 0 if model.pitched is None else int(model.pitched.sum()),
        "extent_m": [round(float(length), 3) for length in extent],
        "lods": lods,
        "findings": findings.counts(),
        "finding_objects": findings.objects(),
    }


def _center_lat_lon(model: CityModel) -> list[float] | None:
    """Returns where on Earth the middle of the city is, to a decimetre: the quickest test of a place."""
    points = model.polygons.points
    if model.crs is None or len(points) == 0:
        return None
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    x, y = 0.5 * (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) + model.origin[:2]
    try:
        lon, lat = Transformer.from_crs(model.crs, "EPSG:4326", always_xy=True).transform(x, y)
    except ProjError:
        return None
    return [round(lat, 6), round(lon, 6)] if np.isfinite([lat, lon]).all() else None


def merge_cities(source: str, cities: list[RawCity]) -> RawCity:
    """Returns several tiles as one city; ids that two tiles share stay as they are.

    Args:
        source: Name of the folder or archive.
        cities: One or more tiles, of any format; their points are taken from them.
    """
    first = cities[0]
    systems = tuple(dict.fromkeys(system for city in cities for system in city.systems()))
    lods = tuple(dict.fromkeys(name for city in cities for name in city.lods))
    findings = Findings([item for city in cities for item in city.findings.items])
    building_ids = tuple(name for city in cities for name in city.building_ids)
    pictures, picture, uv = merge_pictures(
        [(city.pictures, city.picture, city.uv, len(city.building), len(city.points)) for city in cities]
    )
    before = starts_of(np.asarray([len(city.building_ids) for city in cities]))
    part, objects, solids, polygon_ids = _merge_objects(cities)
    return RawCity(
        source=source,
        format=first.format,
        version=first.version,
        srs_names=tuple(name for name, _ in systems),
        building_ids=building_ids,
        num_parts=sum(city.num_parts for city in cities),
        lods=lods,
        points=_taken_points(cities),
        ring_starts=starts_of(np.concatenate([np.diff(city.ring_starts) for city in cities])),
        polygon_starts=starts_of(np.concatenate([np.diff(city.polygon_starts) for city in cities])),
        building=_counted_on([city.building for city in cities], before[:-1]),
        lod=np.concatenate([_renamed(c.lod, c.lods, lods) for c in cities]),
        kind=np.concatenate([city.kind for city in cities]),
        srs=np.concatenate([_renamed(c.srs, c.systems(), systems) for c in cities]),
        has_closing_points=np.concatenate(
            [np.broadcast_to(city.has_closing_points, len(city.ring_starts) - 1) for city in cities]
        ),
        findings=findings,
        axis_orders=tuple(order for _, order in systems),
        part=part,
        objects=objects,
        solids=solids,
        polygon_ids=polygon_ids,
        has_textures=any(city.has_textures for city in cities),
        pictures=pictures,
        picture=picture,
        uv=uv,
        pitched=joined([(city.pitched, len(city.building_ids)) for city in cities], False),
        measured_m=joined([(city.measured_m, len(city.building_ids)) for city in cities], np.nan),
        period=common_period(city.period for city in cities),
    )


def _taken_points(cities: list[RawCity]) -> NDArray[np.float64]:
    """Returns the points of all cities, (P, 3), which have none afterwards: they are not held twice."""
    points = GrowingArray(np.float64, (3,))
    for city in cities:
        points.extend(city.points)
        city.points = np.zeros((0, 3))
    return points.finish()


def _counted_on(columns: Sequence[NDArray[np.int32]], firsts: NDArray[np.int64]) -> NDArray[np.int32]:
    """Returns columns of numbers in a row, those of each column counted from its first."""
    return np.concatenate([c + n for c, n in zip(columns, firsts, strict=True)]).astype(np.int32)


def _merge_objects(
    cities: list[RawCity],
) -> tuple[NDArray[np.int32] | None, CityObjects | None, Solids | None, tuple[str, ...]]:
    """Returns parts, objects, solids and polygon ids of several tiles, as far as any has them."""
    if all(city.objects is None for city in cities):
        return None, None, None, ()
    tables = [city.objects or buildings_only(city.building_ids) for city in cities]
    parts = [city.part if city.part is not None else city.building for city in cities]
    buildings = starts_of(np.asarray([len(city.building_ids) for city in cities]))[:-1]
    firsts = starts_of(np.asarray([len(table) for table in tables]))[:-1]
    polygons = starts_of(np.asarray([len(city.building) for city in cities]))[:-1]
    objects = CityObjects(
        tuple(name for table in tables for name in table.ids),
        tuple(name for table in tables for name in table.types),
        np.concatenate(
            [np.where(t.parents < 0, -1, t.parents + n) for t, n in zip(tables, firsts, strict=True)]
        ).astype(np.int32),
        _counted_on([table.building for table in tables], buildings),
        tuple(values for table in tables for values in (table.attributes or ({},) * len(table)))
        if any(table.attributes for table in tables)
        else (),
    )
    part = _counted_on(parts, firsts)
    if all(city.solids is None for city in cities):
        return part, objects, None, ()
    stated = [
        (city.solids, n, f)
        for city, n, f in zip(cities, polygons, firsts, strict=True)
        if city.solids is not None
    ]
    solids = Solids(
        np.concatenate([s.part + f for s, _, f in stated]).astype(np.int32),
        starts_of(np.concatenate([np.diff(s.shell_starts) for s, _, _ in stated])),
        starts_of(np.concatenate([np.diff(s.face_starts) for s, _, _ in stated])),
        np.concatenate([np.where(s.faces < 0, -1, s.faces + n) for s, n, _ in stated]),
        np.concatenate([s.is_flipped for s, _, _ in stated]),
        np.concatenate([np.where(s.composite < 0, -1, s.composite + n) for s, n, _ in stated]).astype(
            np.int32
        ),
    )
    ids = (city.polygon_ids or ("",) * len(city.building) for city in cities)
    return part, objects, solids, tuple(chain.from_iterable(ids))


def _renamed(
    indices: NDArray[np.int16], names: tuple[Hashable, ...], all_names: tuple[Hashable, ...]
) -> NDArray[np.int16]:
    table = np.asarray([all_names.index(name) for name in names], np.int16)
    return table[indices] if len(table) else indices


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
