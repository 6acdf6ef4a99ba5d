"""Tables of vector files: reference system, geometries and columns, through GDAL or pyarrow."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.codes import READER_WARNING
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.vector.gdal import read_vector
from lodbench.citymodel.vector.osm import building_columns, resolve_parts
from lodbench.errors import CityModelError
from lodbench.findings import Findings
from lodbench.storage.json_text import parse_json

_EXTRA_HINT = "Install it: pip install 'lodbench[vector]'."


def read_table(
    path: str, source: str, options: ReadOptions, findings: Findings
) -> tuple[str | None, list[bytes | None], dict[str, NDArray[np.generic]]]:
    """Returns the reference system of a vector file, its geometries as WKB, and its columns.

    Args:
        path: What GDAL opens.
        source: Name for messages.
        options: ``layer``.
        findings: Receives what GDAL warns of.

    Raises:
        CityModelError: It cannot be read.
    """
    if path.lower().endswith((".parquet", ".geoparquet")):
        return _read_parquet(path, source)
    try:
        (meta, _, geometries, values), stated = read_vector(path, source, options.layer)
    except CityModelError:
        raise
    except Exception as error:  # pyogrio has a dozen kinds, and GDAL's messages are the useful part
        raise CityModelError(
            f"{source} cannot be read as a vector file: {str(error).rstrip('.')}.",
            "Try to open it in a GIS, or export it again as GeoPackage.",
        ) from None
    for text in stated:
        findings.add(READER_WARNING, source, text)
    table = {str(name): np.asarray(column) for name, column in zip(meta["fields"], values, strict=True)}
    if path.lower().endswith((".pbf", ".osm")):
        named = building_columns(table, len(geometries))
        geometries, table = resolve_parts(geometries, named, table)
    return meta["crs"], list(geometries), table


def _read_parquet(
    path: str, source: str
) -> tuple[str | None, list[bytes | None], dict[str, NDArray[np.generic]]]:
    """Reads GeoParquet through pyarrow, since the GDAL inside pyogrio has no Parquet driver."""
    try:
        import pyarrow.parquet as parquet
    except ImportError:
        raise CityModelError(f"Reading {source} needs pyarrow.", _EXTRA_HINT) from None
    try:
        content = parquet.read_table(Path(path))
        geo: dict[str, Any] = parse_json((content.schema.metadata or {})[b"geo"])
        primary = geo["primary_column"]
        column = dict(geo["columns"][primary])
        geometries = content.column(primary).to_pylist()
    except KeyError:
        raise CityModelError(
            f"{source} is Parquet, but not GeoParquet: it has no geo metadata.",
            "Export it as GeoParquet or GeoPackage.",
        ) from None
    except (OSError, ValueError, TypeError) as error:
        raise CityModelError(f"{source} cannot be read as GeoParquet: {error}.", "Export it again.") from None
    if str(column.get("encoding", "WKB")).upper() != "WKB":
        raise CityModelError(f"{source} stores geometry as {column['encoding']}.", "Only WKB is read.")
    # GeoParquet: a crs left out is longitude and latitude; null is unknown.
    crs = column.get("crs", "OGC:CRS84")
    names = [name for name in content.column_names if name != primary]
    table = {name: np.asarray(content.column(name).to_pylist()) for name in names}
    return (json.dumps(crs) if isinstance(crs, dict) else crs), geometries, table
