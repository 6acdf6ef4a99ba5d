"""One raw GNSS fix per photo, by its name: a CSV with a head, or the points of a GPX file."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from lodbench.citymodel.gml.xml import XmlMembers, local_name
from lodbench.datasets.exchange.posed import LayoutGuard, content
from lodbench.errors import CityModelError, DatasetError, LodbenchError
from lodbench.findings import Findings

_LAYOUT = "a head `name,latitude,longitude,height,sigma_east,sigma_north,sigma_up`: degrees, metres"
_GPX_LAYOUT = 'points <wpt lat="..." lon="..."><ele>...</ele><name>PHOTO</name></wpt>'
_SIGMAS = ("sigma_east", "sigma_north", "sigma_up")
# Least and most of each column: a deviation is above 0.
_LIMITS = {"latitude": (-90.0, 90.0), "longitude": (-180.0, 180.0), "height": (-1e5, 1e5)}
_TINY, _MOST_SIGMA_M = 1e-9, 1e3


class Fix(NamedTuple):
    """Where a receiver was.

    Attributes:
        latitude_deg: WGS 84.
        longitude_deg: WGS 84.
        height_m: As the file has it; None where it has none.
        sigmas: (3,) standard deviations east, north and up, metres; None where the file has none.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float | None
    sigmas: tuple[float | None, ...]


def read_fixes(path: Path) -> dict[str, Fix]:
    """Returns the fixes of a file by the photos' names.

    Raises:
        DatasetError: It cannot be read, names a photo twice, or a value is missing, none or out of range.
    """
    found: dict[str, Fix] = {}
    for where, row in (_gpx_rows if path.suffix.lower() == ".gpx" else _csv_rows)(path):
        with LayoutGuard(where, _GPX_LAYOUT if path.suffix.lower() == ".gpx" else _LAYOUT):
            name = row.get("name", "")
            if not name:
                raise LodbenchError("name is missing")
            if name in found:
                raise LodbenchError(f"the name {name} occurs twice")
            latitude, longitude = (_number(row, axis) for axis in ("latitude", "longitude"))
            if latitude is None or longitude is None:
                raise LodbenchError("latitude or longitude is missing")
            sigmas = tuple(_number(row, axis) for axis in _SIGMAS)
            found[name] = Fix(latitude, longitude, _number(row, "height"), sigmas)
    if not found:
        raise DatasetError(f"{path} holds no fixes.", f"It is {_LAYOUT}; or GPX: {_GPX_LAYOUT}.")
    return found


def _csv_rows(path: Path) -> Iterator[tuple[str, dict[str, str]]]:
    lines = content(path)
    where, head = next(lines, (str(path), ""))
    names = [cell.strip().lower() for cell in head.split(",")]
    with LayoutGuard(where, _LAYOUT):
        missing = [name for name in ("name", "latitude", "longitude") if names.count(name) != 1]
        if missing:
            raise LodbenchError(f"there is not one column {', '.join(missing)}")
    for where, line in lines:
        cells = [cell.strip() for cell in next(csv.reader([line.rstrip("\r")]))]
        yield where, dict(zip(names, cells, strict=False))


def _gpx_rows(path: Path) -> Iterator[tuple[str, dict[str, str]]]:
    names = {"name": "name", "ele": "height"}
    try:
        with path.open("rb") as stream:
            for member in XmlMembers(stream, str(path), ("wpt", "trk"), Findings()):
                for point in member.iter("{*}wpt", "{*}trkpt"):
                    children = {local_name(child.tag): (child.text or "").strip() for child in point}
                    row = {names[tag]: text for tag, text in children.items() if tag in names}
                    place = {"latitude": point.get("lat", ""), "longitude": point.get("lon", "")}
                    yield f"{path}, point {children.get('name') or '?'}", row | place
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}.", "Check the path.") from error
    except CityModelError as error:
        raise DatasetError(error.message, "Export the GPX file again.") from error


def _number(row: Mapping[str, str], name: str) -> float | None:
    text = row.get(name, "")
    if not text:
        return None
    low, high = _LIMITS.get(name, (_TINY, _MOST_SIGMA_M))
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not low <= number <= high:
        raise LodbenchError(f"{name} {text} is not within {low:g} to {high:g}")
    return number
