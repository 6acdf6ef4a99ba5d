"""Cameras on a map as GeoJSON (RFC 7946) and GeoPackage (OGC 12-128r18): place, direction, footprint.

Positions are longitude and latitude, WGS 84. Heights stay in the city's own system and so are a
property, not a third coordinate, which would mean heights above the ellipsoid.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import shape

from lodbench.citymodel.source import OWN_GEOJSON, OWN_GEOPACKAGE
from lodbench.geometry import Camera, Pose
from lodbench.photos.map_frame import MapFrame, survey_row
from lodbench.storage import write_bytes, write_text
from lodbench.storage.disk import writable

if TYPE_CHECKING:
    import sqlite3

# A camera's line ends where the ray through the picture's middle is this much lower, or this far away.
_DROP_M, _REACH_M = 100.0, 150.0
# Points along each side of a footprint, and how far away its far side ends where it meets no ground.
_SIDE, _FURTHEST_M = 8, 600.0
# Latitudes and longitudes to about a millimetre.
_DIGITS = 8


def camera_feature(
    frame: MapFrame,
    pose: Pose,
    properties: Mapping[str, Any],
    covariance: Sequence[float] | NDArray[np.float64] | None = None,
) -> dict[str, Any]:
    """Returns a camera as a point feature, with ``SURVEY_COLUMNS`` that are known among the properties.

    Args:
        frame: The map's coordinates.
        pose: In these.
        properties: More of the feature's.
        covariance: As of ``survey_row``.
    """
    row = survey_row(pose, frame.place_of(pose), covariance)
    stated = {**properties, **{name: value for name, value in row.items() if value is not None}}
    point = [row["longitude_deg"], row["latitude_deg"]]
    return _feature({"type": "Point", "coordinates": point}, {**stated, "crs": frame.crs})


def view_feature(frame: MapFrame, pose: Pose, properties: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a line on the map from below the camera to where the middle of its picture points.

    The ray ends after 100 m of descent or 150 m of way along the ground, whichever is first.
    """
    center, ahead = pose.center, pose.rotation[2]
    along = max(float((ahead[0] ** 2 + ahead[1] ** 2) ** 0.5), 1e-9)
    length = min(_REACH_M / along, _DROP_M / max(-float(ahead[2]), 1e-9))
    ends = [center, center + length * ahead]
    line = []
    for east, north in ((float(point[0]), float(point[1])) for point in ends):
        latitude, longitude = frame.latitude_longitude(east, north)
        line.append([round(longitude, _DIGITS), round(latitude, _DIGITS)])
    return _feature({"type": "LineString", "coordinates": line}, {**properties, "kind": "view"})


def footprint_feature(
    frame: MapFrame, camera: Camera, pose: Pose, ground_m: float, properties: Mapping[str, Any]
) -> dict[str, Any] | None:
    """Returns the part of a level ground that a picture shows, as a polygon; None if it shows none.

    Args:
        frame: The map's coordinates.
        camera: Pinhole of the picture.
        pose: In the map's coordinates.
        ground_m: Height of the ground, in the city's heights.
        properties: Of the feature.

    Beyond 600 m, and above the horizon, it is cut off at 600 m.
    """
    height = float(pose.center[2]) - ground_m
    if height <= 0:
        return None
    steps = np.arange(_SIDE) / _SIDE
    corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], float)
    ends = np.roll(corners, -1, axis=0)
    pixels = (corners[:, None] + steps[None, :, None] * (ends - corners)[:, None]).reshape(-1, 2)
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    rays = np.column_stack([(pixels - middle) / focal, np.ones(len(pixels))]) @ pose.rotation
    if (rays[:, 2] >= 0).all():
        return None
    # Up to the horizon and above it a ray goes on, over the ground, to where it is cut off.
    along = np.linalg.norm(rays[:, :2], axis=1)
    falls = np.minimum(rays[:, 2], -1e-9)
    reach = np.where(rays[:, 2] < 0, height / -falls, np.inf)
    reach = np.minimum(reach, _FURTHEST_M / np.maximum(along, 1e-9))
    ground = pose.center[:2] + rays[:, :2] * reach[:, None]
    ring = []
    # Counter-clockwise, as RFC 7946 wants outer rings.
    for east, north in ground if _area(ground) > 0 else ground[::-1]:
        latitude, longitude = frame.latitude_longitude(float(east), float(north))
        ring.append([round(longitude, _DIGITS), round(latitude, _DIGITS)])
    stated = {**properties, "kind": "footprint", "ground_m": round(ground_m, 3)}
    return _feature({"type": "Polygon", "coordinates": [[*ring, ring[0]]]}, stated)


def _area(ring: NDArray[np.float64]) -> float:
    """Returns the signed area of a polygon, positive if it runs counter-clockwise."""
    x, y = ring.T
    return float(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def nowhere_feature(properties: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a feature without a place: a photo that was not found."""
    return _feature(None, properties)


def write_geojson(features: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Writes a feature collection, which is never taken for a city where it lies among tiles."""
    values = {**OWN_GEOJSON, "features": list(features)}
    write_text(path, json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def _feature(geometry: dict[str, Any] | None, properties: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": dict(properties)}


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
    import sqlite3

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
    names = {column: '"' + column.replace('"', '""') + '"' for column in columns}
    declared = "".join(f", {names[column]} {types[column]}" for column in columns)
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


def _blob(geometry: shapely.Geometry | None) -> bytes | None:
    """Returns a geometry as GeoPackage stores it: magic, version, flags (little endian), system, WKB."""
    if geometry is None:
        return None
    head = struct.pack("<2sBBi", b"GP", 0, 1, _WGS84)
    return head + bytes(shapely.to_wkb(geometry, byte_order=1))
