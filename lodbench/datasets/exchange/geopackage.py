"""GeoPackage (OGC 12-128r18) of features on a map: those of GeoJSON, a layer per kind of geometry.

Written without GDAL: a GeoPackage is an SQLite file with some tables of fixed names.
"""

from __future__ import annotations

import json
import sqlite3
import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import shapely
from shapely.geometry import shape

from lodbench.citymodel.source import OWN_GEOPACKAGE
from lodbench.storage import write_bytes
from lodbench.storage.atomic import writable

_WGS84 = 4326
# "GPKG", version 1.3.0.
_PRAGMAS = "PRAGMA application_id = 1196444487; PRAGMA user_version = 10300;"
_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL,
  description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL,
  identifier TEXT UNIQUE, description TEXT DEFAULT '', last_change DATETIME NOT NULL, min_x DOUBLE,
  min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
"""
# The same for the same content: when it was written is not part of it.
_LAST_CHANGE = "2000-01-01T00:00:00.000Z"
_LAYERS = {"Point": "cameras", "LineString": "views", "Polygon": "footprints"}


def write_geopackage(features: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Writes features of GeoJSON, WGS 84, as layers ``cameras``, ``views`` and ``footprints``.

    Features without a geometry are rows of ``cameras`` without one. Columns are the properties; lists and
    dictionaries become JSON. The file is never taken for a city where it lies among tiles.
    """
    layers: dict[str, list[Mapping[str, Any]]] = {"Point": []}
    for feature in features:
        geometry = feature["geometry"]
        layers.setdefault("Point" if geometry is None else geometry["type"], []).append(feature)
    database = sqlite3.connect(":memory:")
    try:
        database.executescript(_PRAGMAS + _TABLES)
        _add_systems(database)
        for kind, rows in layers.items():
            _add_layer(database, kind, rows)
        database.commit()
        write_bytes(path, database.serialize())
    finally:
        database.close()


def _add_systems(database: sqlite3.Connection) -> None:
    """Adds the reference systems that every GeoPackage must have."""
    from pyproj import CRS

    wkt = CRS.from_epsg(_WGS84).to_wkt("WKT1_GDAL")
    rows = [
        ("WGS 84", _WGS84, "EPSG", _WGS84, wkt),
        ("Undefined cartesian SRS", -1, "NONE", -1, "undefined"),
        ("Undefined geographic SRS", 0, "NONE", 0, "undefined"),
    ]
    database.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)", rows)


def _add_layer(database: sqlite3.Connection, kind: str, features: Sequence[Mapping[str, Any]]) -> None:
    name = _LAYERS[kind]
    columns = list(dict.fromkeys(key for each in features for key in each["properties"]))
    types = {column: _type_of([each["properties"].get(column) for each in features]) for column in columns}
    declared = "".join(f", {_quoted(column)} {types[column]}" for column in columns)
    database.execute(
        f"CREATE TABLE {name} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom {kind.upper()}{declared})"
    )
    shapes = [None if each["geometry"] is None else shape(each["geometry"]) for each in features]
    known = [each for each in shapes if each is not None]
    bounds = shapely.total_bounds(known).tolist() if known else [None] * 4
    database.execute(
        "INSERT INTO gpkg_contents VALUES (?, 'features', ?, ?, ?, ?, ?, ?, ?, ?)",
        (name, name, OWN_GEOPACKAGE, _LAST_CHANGE, *bounds, _WGS84),
    )
    database.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 0, 0)", (name, kind.upper(), _WGS84)
    )
    marks = ", ".join("?" * (len(columns) + 2))
    database.executemany(
        f"INSERT INTO {name} VALUES ({marks})",  # noqa: S608 - a name of _LAYERS, and marks  # nosec
        [
            (number, _blob(geometry), *(_cell(each["properties"].get(column)) for column in columns))
            for number, (each, geometry) in enumerate(zip(features, shapes, strict=True), start=1)
        ],
    )


def _type_of(values: Iterable[Any]) -> str:
    """Returns the type of a column: DOUBLE if all that is there are numbers."""
    kinds = {type(value) for value in values if value is not None}
    if kinds <= {bool} and kinds:
        return "BOOLEAN"
    return "DOUBLE" if kinds <= {int, float} and kinds else "TEXT"


def _cell(value: Any) -> Any:
    if isinstance(value, list | dict):
        return json.dumps(value, ensure_ascii=False)
    return writable(value) if isinstance(value, str) else value


def _quoted(column: str) -> str:
    return '"' + column.replace('"', '""') + '"'


def _blob(geometry: shapely.Geometry | None) -> bytes | None:
    """Returns a geometry as GeoPackage stores it: magic, version, flags (little endian), system, WKB."""
    if geometry is None:
        return None
    head = struct.pack("<2sBBi", b"GP", 0, 1, _WGS84)
    return head + bytes(shapely.to_wkb(geometry, byte_order=1))
