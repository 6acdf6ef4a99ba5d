"""OpenStreetMap extracts: buildings and their parts, as its wiki's Simple 3D Buildings has them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

LAYER = "multipolygons"
_PART = "building:part"
IS_BUILDING = " OR ".join(f'("{tag}" IS NOT NULL AND "{tag}" <> \'no\')' for tag in ("building", _PART))
# GDAL's own configuration takes closed ways that are nothing but parts of buildings for lines.
OSM_CONFIG = f"""\
closed_ways_are_polygons=building,{_PART}
attribute_name_laundering=no
[points]
[lines]
[multipolygons]
osm_id=yes
attributes=building,{_PART}
other_tags=yes
[multilinestrings]
[other_relations]
"""
# Of an outline less than this share that no part covers is what drawing leaves.
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
    buildings, parts = (columns.get(name, np.full(len(geometries), None)) for name in ("building", _PART))
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
