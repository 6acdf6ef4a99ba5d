"""OpenStreetMap extracts: tags of buildings as columns, as its wiki's Simple 3D Buildings names them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

LAYER = "multipolygons"
IS_BUILDING = "building IS NOT NULL AND building <> 'no'"
# Tags that columns of heights, undersides, roofs and places are made of.
_TAGS = (
    "height", "building:levels", "min_height", "building:min_level", "roof:height", "roof:levels",
    "roof:shape", "location",
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
