"""Columns of vector files: which one holds heights, storeys or the ground, whatever it is called.

At the end those of OpenStreetMap extracts: buildings and parts, as its wiki's Simple 3D Buildings has them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.attributes import word_of
from lodbench.citymodel.codes import READER_WARNING
from lodbench.citymodel.extrude import SHAPES
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.vector.gdal import OSM_PART, read_vector
from lodbench.errors import CityModelError, nearest_names
from lodbench.findings import Findings
from lodbench.storage.json_text import parse_json

# Best first. Names are compared in lower case without separators; Shapefile cuts them at ten letters.
_HEIGHTS = (
    "height", "hgt", "buildingheight", "bldgheight", "bldheight", "measuredheight", "heightmedian",
    "heightmean", "heightmea", "heightmax", "meanheight", "hoehe", "hauteur", "altura", "h",
)  # fmt: skip
# Of houses in some sources, and of the ground in others: taken where nothing else decides.
_HEIGHTS_PERHAPS = ("elevation",)
_ROOFS = ("b3hdak70p", "b3hdak50p", "b3hdakmax", "hdak70p", "hdak50p", "roof", "rooftop", "zroof", "hroof")
_GROUNDS = ("b3hmaaiveld", "hmaaiveld", "ground", "groundheight", "groundz", "groundelev", "base", "zground")
_STOREYS = (
    "storeys", "stories", "floors", "floor", "numfloors", "nfloors", "levels", "buildinglevels",
    "storeysaboveground", "nbetages",
)  # fmt: skip
# Where a footprint begins above the ground: a bridge between houses, a roof on columns.
_MIN_HEIGHTS = ("minheight", "buildingminheight")
_MIN_LEVELS = ("minlevel", "buildingminlevel", "minfloor")
_UNDERGROUND = ("underground", "isunderground")
_LOCATIONS = ("location",)
_ROOF_TYPES = ("rooftype", "b3daktype", "b3daktyp", "daktype", "roofshape", "dachform")
_IDS = ("gmlid", "identificatie", "buildingid", "bldgid", "ubid", "uuid", "osmid", "id", "fid", "objectid")


def find_column(names: Sequence[str], known: Sequence[str]) -> str | None:
    """Returns the best of the known names that is there, or None.

    Example:
        >>> find_column(["ID", "Bldg_Height"], ("height", "bldgheight"))
        'Bldg_Height'
    """
    plain = {re.sub(r"[^a-z0-9]", "", name.lower()): name for name in reversed(names)}
    return next((plain[name] for name in known if name in plain), None)


class Columns:
    """The attribute columns of a vector file.

    Args:
        table: Column name to values, one per footprint.
        count: Number of footprints.
        source: Name of the file, for messages.
    """

    def __init__(self, table: dict[str, NDArray[np.generic]], count: int, source: str) -> None:
        self._table, self._count, self._source = table, count, source

    def heights(self, options: ReadOptions, unit_m: float = 1.0) -> tuple[NDArray[np.float64], list[str]]:
        """Returns (N,) heights above ground in the columns' unit, NaN where there is none, and the columns.

        Args:
            options: Which columns; the height of a storey, metres.
            unit_m: Metres per unit.

        Raises:
            CityModelError: A column requested is not there, or none holds heights or storeys.
        """
        parted = self._roof_and_ground(options)
        if parted is not None:
            return self._numbers(parted[0]) - self._numbers(parted[1]), list(parted)
        height, storeys = self._height_and_storeys(options)
        if height is None and storeys is None:
            if options.default_height_m is not None:
                return np.full(self._count, np.nan), []
            listed = ", ".join(self._table) or "none at all"
            raise CityModelError(
                f"{self._source} has no column of heights or storeys among: {listed}.",
                "Name it: `height_column=...`, `storeys_column=...` or `default_height_m=...`",
            )
        values = self._numbers(height) if height is not None else np.full(self._count, np.nan)
        if storeys is not None:
            from_storeys = self._numbers(storeys) * (options.storey_height_m / unit_m)
            values = np.where(
                np.isfinite(values) & (values > 0), values, from_storeys + self._roof_rise(options, unit_m)
            )
        return values, [name for name in (height, storeys) if name is not None]

    def height_sources(self, options: ReadOptions) -> NDArray[np.str_]:
        """Returns (N,) names of the columns that ``heights`` takes the heights from."""
        parted = self._roof_and_ground(options)
        if parted is not None:
            return np.full(self._count, f"columns {parted[0]} and {parted[1]}")
        height, storeys = self._height_and_storeys(options)
        by_storeys = np.full(self._count, f"column {storeys}" if storeys else "nothing")
        if height is None:
            return by_storeys
        values = self._numbers(height)
        return np.where(
            np.isfinite(values) & ((values > 0) | (storeys is None)), f"column {height}", by_storeys
        )

    def _roof_and_ground(self, options: ReadOptions) -> tuple[str, str] | None:
        """Returns the columns whose difference is the height, where nobody named others."""
        if options.height_column is not None or options.storeys_column is not None:
            return None
        roof, ground = (find_column(list(self._table), known) for known in (_ROOFS, _GROUNDS))
        return None if roof is None or ground is None else (roof, ground)

    def _height_and_storeys(self, options: ReadOptions) -> tuple[str | None, str | None]:
        """Returns the columns of heights and of storeys, named by the user or known."""
        height = None
        if options.height_column is not None or options.storeys_column is None:
            height = self._asked_or_known(options.height_column, _HEIGHTS)
        storeys = self._asked_or_known(options.storeys_column, _STOREYS)
        return height or (None if storeys else find_column(list(self._table), _HEIGHTS_PERHAPS)), storeys

    def _roof_rise(self, options: ReadOptions, unit_m: float) -> NDArray[np.float64]:
        """Returns (N,) how far roofs rise above the storeys by ``roof:height``, else ``roof:levels``; else 0.

        In OpenStreetMap's Simple 3D Buildings ``building:levels`` does not count storeys within the roof.
        """
        rise = np.zeros(self._count)
        for known, factor in (
            ("rooflevels", options.storey_height_m / unit_m),
            ("roofheight", 1.0 / unit_m),
        ):
            name = find_column(list(self._table), (known,))
            if name is not None:
                values = factor * self._numbers(name)
                rise = np.where(np.isfinite(values) & (values >= 0), values, rise)
        return rise

    def bottoms(self, options: ReadOptions, unit_m: float = 1.0) -> tuple[NDArray[np.float64], list[str]]:
        """Returns (N,) heights above ground at which footprints begin, 0 by default, and the columns.

        Args:
            options: The height of a storey, metres.
            unit_m: Metres per unit of the heights.
        """
        names = list(self._table)
        height, level = find_column(names, _MIN_HEIGHTS), find_column(names, _MIN_LEVELS)
        values = np.full(self._count, np.nan) if height is None else self._numbers(height)
        if level is not None:
            from_levels = self._numbers(level) * (options.storey_height_m / unit_m)
            values = np.where(np.isfinite(values), values, from_levels)
        named = [name for name in (height, level) if name is not None]
        return np.where(np.isfinite(values) & (values > 0), values, 0.0), named

    def underground(self) -> NDArray[np.bool_]:
        """Returns (N,) which footprints lie below the ground, as a column says; one of numbers does not."""
        is_below = np.zeros(self._count, np.bool_)
        for known, words in ((_UNDERGROUND, ("true", "yes", "1", "t")), (_LOCATIONS, ("underground",))):
            name = find_column(list(self._table), known)
            if name is None:
                continue
            texts = [str(value).strip().lower().removesuffix(".0") for value in self._table[name].tolist()]
            if not any(text.isdigit() and text not in "01" for text in texts):
                is_below |= np.isin(texts, words)
        return is_below

    def written(self, names: Sequence[str], row: int) -> str:
        """Returns what stands in some columns of a footprint: ``height is '33 ft'``."""
        values = [self._table[name][row : row + 1].tolist()[0] for name in names]
        return ", ".join(
            f"{name} is {'empty' if value is None else repr(value)}"
            for name, value in zip(names, values, strict=True)
        )

    def has_heights(self, options: ReadOptions) -> bool:
        """Returns whether ``heights`` finds any."""
        try:
            self.heights(options)
        except CityModelError:
            return options.height_column is not None or options.storeys_column is not None
        return True

    def ground(self, options: ReadOptions) -> NDArray[np.float64] | None:
        """Returns (N,) ground heights in the columns' unit, or None where no column has them."""
        name = self._asked_or_known(options.ground_column, _GROUNDS)
        return None if name is None else self._numbers(name)

    def roof_types(self) -> list[tuple[int, str]]:
        """Returns footprints, counted from 0, and what columns of roofs say of them, where they do."""
        names = [find_column(list(self._table), (known,)) for known in _ROOF_TYPES]
        columns = [self._table[name].tolist() for name in names if name is not None]
        words = (next(filter(None, map(word_of, row)), "") for row in zip(*columns, strict=True))
        return [(row, word) for row, word in enumerate(words) if word]

    def stated_roofs(self, options: ReadOptions, unit_m: float = 1.0) -> dict[int, tuple[str, float, bool]]:
        """Returns shape, rise and whether the ridge runs across of the roofs whose columns say them.

        Rises are in the columns' unit, 0 of flat roofs; those of others that no column states are left out.
        """
        names = list(self._table)
        shape, turn = (find_column(names, (known,)) for known in ("roofshape", "rooforientation"))
        if shape is None:
            return {}
        rise = self._roof_rise(options, unit_m)
        across = np.full(self._count, "") if turn is None else self._table[turn]
        words = [word_of(value).lower() for value in self._table[shape].tolist()]
        return {
            n: (word, 0.0 if word == "flat" else float(rise[n]), str(across[n]).lower() == "across")
            for n, word in enumerate(words)
            if word == "flat" or (word in SHAPES and rise[n] > 0)
        }

    def parents(self) -> dict[int, str]:
        """Returns the building that footprints are parts of, by its id, where a column says so."""
        values = self._table.get("part_of")
        return {} if values is None else {n: str(name) for n, name in enumerate(values.tolist()) if name}

    def ids(self) -> list[str]:
        """Returns one id per footprint: the id column where it is one, else numbers from 1."""
        name = find_column(list(self._table), _IDS)
        if name is not None:
            values = [str(value) for value in self._table[name].tolist()]
            if len(set(values)) == len(values):
                return values
        width = len(str(self._count))
        return [f"footprint-{i + 1:0{width}d}" for i in range(self._count)]

    def _asked_or_known(self, wanted: str | None, known: Sequence[str]) -> str | None:
        names = list(self._table)
        if wanted is not None and wanted not in names:
            raise CityModelError(f"{self._source} has no column {wanted!r}.", nearest_names(wanted, names))
        return wanted or find_column(names, known)

    def _numbers(self, name: str) -> NDArray[np.float64]:
        values = self._table[name]
        if values.dtype.kind in "iufb":
            return values.astype(np.float64)
        return np.asarray([_number(value) for value in values.tolist()], np.float64)


def _number(value: object) -> float:
    """Returns a number written as text (``"12,5 m"``), NaN for anything else."""
    match = re.fullmatch(r"\s*(-?\d+(?:[.,]\d+)?)\s*m?\s*", str(value))
    return float(match[1].replace(",", ".")) if match else float("nan")


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


# Parts that leave less than this share of an outline cover it: outlines are drawn no more precisely.
_LEAST_REST = 0.02
# Tags that columns of heights, undersides, roofs and places are made of.
_TAGS = (
    "height", "building:levels", "min_height", "building:min_level", "roof:height", "roof:levels",
    "roof:shape", "roof:orientation", "location",
)  # fmt: skip
# GDAL hands over tags without a column of their own as one text: "key"=>"value","key"=>"value".
_PAIR = re.compile(r'"((?:[^"\\]|\\.)*)"=>"((?:[^"\\]|\\.)*)"')
_METRES = re.compile(r"\s*(\d+(?:[.,]\d+)?)\s*(m|metres?|meters?)?\s*$", re.IGNORECASE)
_FEET = re.compile(r"\s*(?:(\d+(?:\.\d+)?)\s*(?:'|ft|feet))?\s*(?:(\d+(?:\.\d+)?)\s*(?:\"|in))?\s*$")
_IN_METRES = frozenset({"height", "min_height", "roof:height"})


def building_columns(columns: dict[str, NDArray[Any]], count: int) -> dict[str, NDArray[Any]]:
    """Returns the columns of buildings: ``osm_id`` (``way/1``, ``relation/1``), and tags by their names.

    Heights are numbers in metres, whatever unit they are tagged in; text that is no height stays as it is.

    Args:
        columns: Of GDAL's layer of multipolygons.
        count: Rows.
    """
    tags = [dict(_PAIR.findall(str(text or ""))) for text in columns.get("other_tags", [""] * count)]
    table: dict[str, NDArray[Any]] = {"osm_id": np.array(_ids(columns, count), object)}
    for tag in _TAGS:
        values = [_value(tag, own.get(tag)) for own in tags]
        if any(value is not None for value in values):
            table[tag] = np.array(values, object)
    return table


def resolve_parts(
    geometries: Sequence[bytes | None], table: dict[str, NDArray[Any]], columns: dict[str, NDArray[Any]]
) -> tuple[list[bytes | None], dict[str, NDArray[Any]]]:
    """Returns outlines without what their parts cover, the parts, and the rows of the table that are left.

    Parts replace the outline's block where they lie on it if they have a height, or storeys; others are left
    out. The column ``part_of`` is the id of the outline that holds a part, or "".

    Args:
        geometries: Of all polygons, WKB.
        table: ``building_columns`` of them.
        columns: Of GDAL's layer.
    """
    buildings, parts = (columns.get(name, np.full(len(geometries), None)) for name in ("building", OSM_PART))
    is_part = np.array([b in (None, "", "no") for b in buildings], np.bool_)
    is_part &= np.array([p not in (None, "", "no") for p in parts], np.bool_)
    if not is_part.any():
        return list(geometries), table
    import shapely

    heights = [table[name] for name in ("height", "building:levels") if name in table]
    has_height = np.array([any(_is_positive(each[n]) for each in heights) for n in range(len(geometries))])
    shapes = shapely.make_valid(shapely.from_wkb(np.array(list(geometries), object), on_invalid="ignore"))
    used, outlines = np.flatnonzero(is_part & has_height), np.flatnonzero(~is_part)
    part_of = np.full(len(geometries), "", object)
    kept = list(geometries)
    # Of both: the pairs of an outline and a part with a place inside it.
    inside = shapely.point_on_surface(shapes[used])
    first, second = shapely.STRtree(inside).query(shapes[outlines], predicate="covers")
    for outline in np.unique(first).tolist():
        row, own = int(outlines[outline]), used[second[first == outline]]
        part_of[own] = table["osm_id"][row]
        rest = shapely.difference(shapes[row], shapely.union_all(shapes[own]))
        faces = [face for face in shapely.get_parts(rest) if shapely.get_dimensions(face) == 2]
        is_left = sum(face.area for face in faces) > _LEAST_REST * shapes[row].area
        kept[row] = shapely.to_wkb(shapely.multipolygons(faces)) if is_left else None
    rows = [n for n, kind in enumerate(is_part) if (has_height[n] if kind else kept[n] is not None)]
    table = {name: values[rows] for name, values in {**table, "part_of": part_of}.items()}
    return [kept[n] for n in rows], table


def _is_positive(value: object) -> bool:
    try:
        return float(str(value).replace(",", ".")) > 0
    except ValueError:
        return False


def _ids(columns: dict[str, NDArray[Any]], count: int) -> list[str]:
    none = [None] * count
    ways, relations = (columns.get(name, none) for name in ("osm_way_id", "osm_id"))
    return [
        f"way/{way}" if way not in (None, "") else f"relation/{other}"
        for way, other in zip(ways, relations, strict=True)
    ]


def _value(tag: str, text: str | None) -> object:
    return text if text is None or tag not in _IN_METRES else _length_m(text)


def _length_m(text: str) -> object:
    """Returns a length (``12``, ``12.5 m``, ``40'``, ``12'6"``) in metres; the text where it is none."""
    plain = text.replace('\\"', '"')
    metres = _METRES.match(plain)
    if metres:
        return float(metres[1].replace(",", "."))
    feet = _FEET.match(plain)
    if feet is None or (feet[1] is None and feet[2] is None):
        return text
    return 0.3048 * float(feet[1] or 0) + 0.0254 * float(feet[2] or 0)
