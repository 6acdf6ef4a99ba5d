"""GDAL with its doors shut: one driver per ending, chosen by us and never by what a file says of itself.

GDAL asks some sixty drivers whether they know a file's first bytes. A few of them read a description
of other data, fetch it from the network, or run the SQL it holds, and a file named ``.geojson`` may be one.
"""

from __future__ import annotations

import os
import struct
import sys
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import CityModelError, nearest_names

VECTOR_DRIVERS = {
    ".gpkg": "GPKG",
    ".shp": "ESRI Shapefile",
    ".geojson": "GeoJSON",
    ".fgb": "FlatGeobuf",
    ".gdb": "OpenFileGDB",
    ".pbf": "OSM",
    ".osm": "OSM",
}
_LAYERED = (".gpkg", ".gdb")
RASTER_DRIVERS = {".tif": "GTiff", ".tiff": "GTiff", ".img": "HFA", ".hgt": "SRTMHGT", ".dt2": "DTED"}
# What else pyogrio's GDAL has been built with, up to 3.12.
_OTHER_DRIVERS = (
    "MEM", "PCIDSK", "PDS4", "VICAR", "PDF", "MBTiles", "EEDA", "OGCAPI", "GDALG", "MapInfo File",
    "LVBAG", "S57", "DGN", "OGR_VRT", "VRT", "CSV", "GML", "GPX", "LIBKML", "KML", "GeoJSONSeq",
    "ESRIJSON", "TopoJSON", "OGR_GMT", "SQLite", "WAsP", "DXF", "GeoRSS", "VFK", "PGDUMP",
    "GPSBabel", "OGR_PDS", "WFS", "OAPIF", "EDIGEO", "Idrisi", "ODS", "XLSX", "XLS",
    "Elasticsearch", "Carto", "AmigoCloud", "SXF", "Selafin", "JML", "PLSCENES", "CSW", "VDV",
    "MVT", "NGW", "MapML", "GTFS", "PMTiles", "JSONFG", "MiraMonVector", "ADBC", "AVCBin", "AVCE00",
    "AIVector", "HTTP", "Memory", "TIGER", "UK .NTF", "Geoconcept", "GMLAS", "NAS", "CAD",
)  # fmt: skip
_HEADS: dict[str, Callable[[bytes], bool]] = {
    ".gpkg": lambda head: head.startswith(b"SQLite format 3\0") and head[68:70] == b"GP",
    ".shp": lambda head: head.startswith(b"\0\0\x27\x0a"),
    ".fgb": lambda head: head.startswith(b"fgb"),
    ".pbf": lambda head: head[4:15] == b"\n\tOSMHeader",
    ".osm": lambda head: b"<osm" in head,
    # No other driver reads a file that begins so, but those whose name the path below leaves out.
    ".geojson": lambda head: head.lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"{"),
}
_OSM_LAYER = "multipolygons"
OSM_PART = "building:part"
_IS_BUILDING = " OR ".join(f'("{tag}" IS NOT NULL AND "{tag}" <> \'no\')' for tag in ("building", OSM_PART))
# GDAL's own configuration takes closed ways that are nothing but parts of buildings for lines.
_OSM_CONFIG = f"""\
closed_ways_are_polygons=building,{OSM_PART}
attribute_name_laundering=no
[points]
[lines]
[multipolygons]
osm_id=yes
attributes=building,{OSM_PART}
other_tags=yes
[multilinestrings]
[other_relations]
"""
_HEAD_BYTES = 4096
_PREFIXED_SINCE = (3, 10)


def read_vector(path: str, source: str, layer: str | None) -> tuple[Any, list[str]]:
    """Returns what ``pyogrio.raw.read`` does, by the driver of the file's ending, and what GDAL warns of.

    Args:
        path: A file, a FileGDB folder, or ``/vsizip/...``.
        source: Name for messages.
        layer: Layer to read, or None for the first that has geometries; of OpenStreetMap the buildings.

    Raises:
        CityModelError: pyogrio is not installed, the file is of another kind than its ending says, or
            has no such layer.
        Exception: Whatever pyogrio raises.
    """
    suffix = PurePosixPath(path).suffix.lower()
    is_known = _HEADS.get(suffix)
    head, _ = peek(path)
    if is_known is not None and not is_known(head):
        raise CityModelError(
            f"{source} is no {VECTOR_DRIVERS[suffix]} file, although its ending says so.",
            "Name it by what it is, or export it again as GeoPackage.",
        )
    pyogrio = _import_pyogrio(source)
    # Absolute: a relative name could look like the connection string of a driver.
    place = path if path.startswith("/vsizip/") else str(Path(path).resolve())
    if suffix == ".geojson" and tuple(pyogrio.__gdal_version__[:2]) >= _PREFIXED_SINCE:
        place = f"GeoJSON:{place}"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        stated: list[str] = []
        if layer is not None or suffix in _LAYERED:
            layer, stated = _choose_layer(pyogrio, place, source, layer)
        if VECTOR_DRIVERS.get(suffix) == "OSM":
            with tempfile.NamedTemporaryFile("w", suffix=".ini") as config:
                config.write(_OSM_CONFIG)
                config.flush()
                # Interleaved: else what belongs to other layers is kept in memory.
                settings = {"OGR_INTERLEAVED_READING": "YES", "OSM_CONFIG_FILE": config.name}
                pyogrio.set_gdal_config_options(settings)
                table = pyogrio.raw.read(place, layer=layer or _OSM_LAYER, where=_IS_BUILDING)
                pyogrio.set_gdal_config_options({"OSM_CONFIG_FILE": None})
        else:
            table = pyogrio.raw.read(place, layer=layer)
    return table, stated + list(dict.fromkeys(str(item.message) for item in caught))


def _choose_layer(
    pyogrio: ModuleType, place: str, source: str, wanted: str | None
) -> tuple[str | None, list[str]]:
    """Returns the layer to read, and that there are others; tables without geometries are none."""
    layers = pyogrio.list_layers(place)
    names = [str(name) for name, kind in layers if kind is not None] or [str(name) for name, _ in layers]
    if wanted is not None and wanted not in names:
        raise CityModelError(f"{source} has no layer {wanted!r}.", nearest_names(wanted, names))
    if wanted is not None or len(names) < 2:
        return wanted or next(iter(names), None), []
    return names[0], [f"of its layers {', '.join(names)} the first is read"]


def _import_pyogrio(source: str) -> ModuleType:
    try:
        with _only_drivers():
            import pyogrio
    except ImportError:
        raise CityModelError(
            f"Reading {source} needs pyogrio.", "Install it: pip install 'lodbench[vector]'."
        ) from None
    pyogrio.set_gdal_config_options({"CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "{none}"})
    return pyogrio  # type: ignore[no-any-return]


@contextmanager
def _only_drivers() -> Iterator[None]:
    """Keeps all other drivers from being registered, where pyogrio has not been imported before."""
    # Unknown names would be complained of on standard error.
    settings = {"GDAL_SKIP": ",".join(_OTHER_DRIVERS), "GDAL_DRIVER_PATH": "disable", "CPL_LOG": os.devnull}
    if "pyogrio" in sys.modules:
        settings = {}
    before = {name: os.environ.get(name) for name in settings}
    os.environ.update(settings)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def opened_raster(path: Path, driver: str, instead: str = "") -> Iterator[Any]:
    """Opens a raster with rasterio, by one driver, without a look at the files beside it.

    Args:
        path: The raster.
        driver: The only one that may read it.
        instead: What a user without rasterio can do, a sentence.

    Raises:
        CityModelError: rasterio is not there, or the raster cannot be opened or read.
    """
    try:
        import rasterio
    except ImportError:
        hint = f"Install it: pip install 'lodbench[vector]'. {instead}".strip()
        raise CityModelError(f"Reading {path} needs rasterio.", hint) from None
    # Without a look into the folder no file beside it is opened, whose driver nobody chose.
    shut = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": "{none}"}
    try:
        with (
            warnings.catch_warnings(action="ignore", category=rasterio.errors.NotGeoreferencedWarning),
            rasterio.Env(**shut),
            rasterio.open(path.resolve(), driver=driver) as raster,
        ):
            yield raster
    except rasterio.errors.RasterioError as error:
        raise CityModelError(
            f"{path} cannot be read as a raster: {error}.",
            "Try to open it in a GIS, or convert it to GeoTIFF.",
        ) from None


def raster_driver(path: Path) -> str:
    """Returns the one driver that may read a raster.

    Raises:
        CityModelError: Its ending names none.
    """
    driver = RASTER_DRIVERS.get(path.suffix.lower())
    if driver is None:
        raise CityModelError(
            f"{path} is no terrain model by its ending.", f"Known: .asc, {', '.join(RASTER_DRIVERS)}."
        )
    return driver


def peek(path: str, suffix: str | None = None) -> tuple[bytes, int]:
    """Returns the first bytes of a vector file and its size; nothing and 0 where it is absent or a folder.

    Args:
        path: As for ``read_vector``.
        suffix: Ending of a sidecar to look at instead (``.dbf``), as long as its own.
    """
    if suffix is not None:
        stem, own = path[: -len(suffix)], path[-len(suffix) :]
        path = stem + (suffix.upper() if own.isupper() else suffix)
    if not path.startswith("/vsizip/"):
        file = Path(path)
        if not file.is_file():
            return b"", 0
        with file.open("rb") as stream:
            return stream.read(_HEAD_BYTES), file.stat().st_size
    archive, _, member = path.removeprefix("/vsizip/").partition(".zip/")
    try:
        with zipfile.ZipFile(f"{archive}.zip") as opened, opened.open(member) as stream:
            return stream.read(_HEAD_BYTES), opened.getinfo(member).file_size
    except (KeyError, OSError, zipfile.BadZipFile, RuntimeError, NotImplementedError):
        return b"", 0


def missing_bytes(path: str) -> list[str]:
    """Returns what of a Shapefile is cut off: one line for each of its files that is too short.

    GDAL reads what is left without a word. The header of ``.shp`` and ``.shx`` says how long each is, that of
    ``.dbf`` how many rows it has.
    """
    if not path.lower().endswith(".shp") or not _HEADS[".shp"](peek(path)[0]):
        return []
    lines = []
    for suffix in (".shp", ".shx", ".dbf"):
        head, size = peek(path, suffix)
        if len(head) < 32:
            lines += [f"its {suffix} has {size} bytes, no header"] if size else []
            continue
        if suffix == ".dbf":
            rows, start, width = struct.unpack_from("<IHH", head, 4)
            wanted = start + rows * width
        else:
            wanted = 2 * struct.unpack_from(">I", head, 24)[0]
        if size < wanted:
            lines.append(f"its {suffix} has {size} of {wanted} bytes")
    return lines


_POINT, _LINE, _POLYGON, _TRIANGLE = 1, 2, 3, 17
# Multi-polygons, collections, multi-surfaces, polyhedral surfaces and TINs nest other geometries.
_COLLECTIONS = frozenset({6, 7, 12, 15, 16})
_WITHOUT_AREA = frozenset({4, 5})  # multi-points and multi-lines
_Z_FLAG, _M_FLAG, _SRID_FLAG = 0x80000000, 0x40000000, 0x20000000
_MAX_DEPTH = 16
# Footprints draped over the ground by rounding stay footprints.
_LEVEL_TOLERANCE_M = 0.01
# A wall viewed from above: less of a square of its outline's length than any footprint.
_THIN = 1e-2


@dataclass(slots=True)
class WkbPolygons:
    """Polygons of many geometries, flat."""

    # (n, 3) points of each ring as written; z is 0 where there is none
    rings: list[NDArray[np.float64]] = field(default_factory=list)
    ring_counts: list[int] = field(default_factory=list)  # rings of each polygon
    owner: list[int] = field(default_factory=list)  # which geometry each polygon belongs to
    has_z: bool = False  # whether any geometry has heights
    ignored: set[int] = field(default_factory=set)  # kinds of geometry met that hold no area

    def has_uneven_rings(self) -> bool:
        """Returns whether some ring leaves the horizontal: surfaces, or footprints draped over the ground."""
        return any(_is_uneven(ring) for ring in self.rings)

    def has_upright_rings(self) -> bool:
        """Returns whether some ring stands upright: the polygons are surfaces, no footprints."""
        return any(_is_uneven(ring) and _is_thin(ring[:, :2]) for ring in self.rings)

    def add(self, data: bytes, owner: int) -> None:
        """Adds the polygons of one geometry.

        Raises:
            ValueError: The bytes are cut off or malformed.
        """
        try:
            self._geometry(data, 0, owner, 0)
        except struct.error as error:
            raise ValueError(f"the geometry is cut off ({error})") from None

    def _geometry(self, data: bytes, offset: int, owner: int, depth: int) -> int:
        if depth > _MAX_DEPTH:
            raise ValueError("geometries are nested too deeply")
        order = "<" if data[offset : offset + 1] == b"\x01" else ">"
        (code,) = struct.unpack_from(order + "I", data, offset + 1)
        offset += 5
        if code & _SRID_FLAG:
            offset += 4
        iso = code & 0x0FFFFFFF
        has_z = bool(code & _Z_FLAG) or iso // 1000 in (1, 3)
        has_m = bool(code & _M_FLAG) or iso // 1000 in (2, 3)
        kind = iso % 1000
        if kind in (_POLYGON, _TRIANGLE):
            return self._polygon(data, offset, order, 2 + has_z + has_m, has_z, owner)
        if kind in _COLLECTIONS or kind in _WITHOUT_AREA:
            (count,) = struct.unpack_from(order + "I", data, offset)
            offset += 4
            for _ in range(count):
                offset = self._geometry(data, offset, owner, depth + 1)
            return offset
        self.ignored.add(kind)
        if kind not in (_POINT, _LINE):
            return len(data)  # nothing is known of its length
        count = 1
        if kind == _LINE:
            (count,) = struct.unpack_from(order + "I", data, offset)
            offset += 4
        return int(offset + 8 * count * (2 + has_z + has_m))

    def _polygon(self, data: bytes, offset: int, order: str, width: int, has_z: bool, owner: int) -> int:
        (num_rings,) = struct.unpack_from(order + "I", data, offset)
        offset += 4
        for _ in range(num_rings):
            (count,) = struct.unpack_from(order + "I", data, offset)
            offset += 4
            size = count * width
            if offset + 8 * size > len(data):
                raise ValueError("a ring is cut off")
            values = np.frombuffer(data, np.dtype(order + "f8"), size, offset).reshape(count, width)
            offset += 8 * size
            ring = np.zeros((count, 3))
            ring[:, : 2 + has_z] = values[:, : 2 + has_z]
            self.rings.append(ring)
        self.has_z = self.has_z or has_z
        if num_rings:
            self.ring_counts.append(num_rings)
            self.owner.append(owner)
        return offset


def _is_uneven(ring: NDArray[np.float64]) -> bool:
    return len(ring) > 0 and bool(np.ptp(ring[:, 2]) > _LEVEL_TOLERANCE_M)


def _is_thin(ring: NDArray[np.float64]) -> bool:
    """Returns whether a ring has no area as viewed from above, in metres or in degrees."""
    x, y = (ring - ring[0]).T
    area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))
    length = float(np.sum(np.hypot(*(np.roll(ring, -1, axis=0) - ring).T)))
    return area <= _THIN * (0.25 * length) ** 2
