"""Poses as lines: LoD-Loc's and visuallocalization.net's, TUM's, tables; 4 x 4 matrices; raw GNSS fixes.

Fixes are one per photo, by its name: a CSV with a head, or the points of a GPX file.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lodbench.citymodel.gml.xml import XmlMembers, local_name
from lodbench.datasets.pose_text import (
    DEGREES_CRS,
    FoundPose,
    LayoutGuard,
    content,
    format_pose,
    inverted,
    lines_to_text,
    parse_pose,
    read_text,
    require_plain_names,
)
from lodbench.errors import CityModelError, DatasetError, LodbenchError
from lodbench.findings import Findings
from lodbench.geometry import Pose
from lodbench.geometry.angles import rotation_from_look
from lodbench.storage import show_formula, write_text


def read_lines(path: Path) -> Iterator[FoundPose]:
    """Yields poses of lines ``name qw qx qy qz tx ty tz``, world to camera.

    Raises:
        DatasetError: A line is malformed.
    """
    for where, line in content(path):
        with LayoutGuard(where, "name qw qx qy qz tx ty tz"):
            # From the right: a name may hold spaces.
            name, *numbers = line.rsplit(maxsplit=7)
            pose = parse_pose(numbers)
        yield FoundPose(name, where, pose)


def write_lines(images: Sequence[FoundPose], path: Path) -> None:
    """Writes such lines; reading them gives the same translations to the bit, and rotations to rounding.

    Raises:
        DatasetError: A name has a space or occurs twice.
    """
    require_plain_names([image.name for image in images], " \t\r\n", "pose lines")
    write_text(path, lines_to_text(format_pose(image.name, image.pose) for image in images))


def read_matrices(path: Path) -> Iterator[FoundPose]:
    """Yields the poses of a folder of ``<stem>_pose.txt`` or ``<stem>.txt``, 4 x 4, camera to world.

    Raises:
        DatasetError: A file is no such matrix.
    """
    for file in sorted(path.glob("*.txt")):
        with LayoutGuard(str(file), "four rows of four numbers, camera to world"):
            rows = [[float(word) for word in line.split()] for _, line in content(file)]
            if [len(row) for row in rows] != [4, 4, 4, 4]:
                raise LodbenchError("not four rows of four numbers")
            if not np.allclose(rows[3], [0, 0, 0, 1]):
                raise LodbenchError("the last row is not 0 0 0 1")
            pose = inverted(Pose.from_matrix(np.array(rows)))
        yield FoundPose(file.stem.removesuffix("_pose"), str(file), pose)


_NAME_COMMENT = re.compile(r"^# (\S+) is (.+?)\r?$", re.MULTILINE)


def read_tum(path: Path) -> Iterator[FoundPose]:
    """Yields poses; the name is the timestamp as written, or what a comment says it is.

    Raises:
        DatasetError: A line is malformed.
    """
    names = dict(_NAME_COMMENT.findall(read_text(path)))
    for where, line in content(path):
        with LayoutGuard(where, "timestamp tx ty tz qx qy qz qw, camera to world"):
            words = line.split()
            if len(words) != 8:
                raise LodbenchError(f"{len(words)} values instead of 8")
            pose = inverted(parse_pose([words[7], *words[4:7], *words[1:4]]))
        yield FoundPose(names.get(words[0], words[0]), where, pose)


def write_tum(images: Sequence[FoundPose], path: Path) -> None:
    """Writes a trajectory with the images' numbers as timestamps, in their order.

    Raises:
        DatasetError: A name occurs twice.
    """
    require_plain_names([image.name for image in images], "\r\n", "TUM comments")
    lines = ["# timestamp tx ty tz qx qy qz qw, camera to world"]
    lines += [f"# {number} is {image.name}" for number, image in enumerate(images)]
    for number, image in enumerate(images):
        w, x, y, z = inverted(image.pose).quat_wxyz
        values = [*(float(v) for v in image.pose.center), x, y, z, w]
        lines.append(" ".join([str(number), *map(repr, values)]))
    write_text(path, lines_to_text(lines))


# How heads of tables spell what they hold, without case, unit and what is no letter.
_SPELLINGS = {
    "name": "name photo image filename imagename file label",
    "lat": "lat latitude gpslatitude",
    "lon": "lon lng long longitude gpslongitude",
    "east": "east easting x",
    "north": "north northing y",
    "height": "height altitude alt elevation up z",
    "heading": "heading yaw azimuth bearing gimbalyaw",
    "pitch": "pitch gimbalpitch",
    "roll": "roll gimbalroll",
    "crs": "crs",
}
_COLUMN_OF = {word: name for name, words in _SPELLINGS.items() for word in words.split()}
_UNIT = re.compile(r"[\s_]*(?:\b|_)(?:m|metres?|meters?|deg|degrees?)\W*$|(?<=[a-z])Degree$")
_EARTH, _GRID, _LOOK = ("lat", "lon"), ("east", "north"), ("height", "heading", "pitch")
TABLE_LAYOUT = (
    "a head `name,lat,lon,height,heading,pitch` (or `easting,northing`; `roll` if known): m, degrees"
)
_LIMITS = {"lat": (-90.0, 90.0), "lon": (-180.0, 180.0), "pitch": (-180.0, 90.0)}


def table_columns(head: str) -> list[str]:
    """Returns what columns hold by their head: ``name``, ``lat``, ..., "" for others; [] of no head."""
    cells = [cell.strip().strip("\"'#").strip() for cell in head.split(_separator(head))]
    columns = [_COLUMN_OF.get(re.sub("[^a-z]", "", _UNIT.sub("", cell).lower()), "") for cell in cells]
    return columns if {*_LOOK, *_EARTH, *_GRID}.intersection(columns) else []


def _separator(head: str) -> str:
    return next((sign for sign in ",;\t" if sign in head), ",")


def read_table(path: Path) -> Iterator[FoundPose]:
    """Yields poses of a table with a head: a place, heading, pitch and, if it is there, roll of each image.

    Heading, pitch and roll are ``LookAngles``: degrees clockwise from true north, above the horizon, about
    the optical axis. Places are latitude and longitude (WGS 84), or, where a row has none, easting and
    northing in the city's coordinates or those of a column ``crs``, with headings from their y axis. Heights
    are the city's, metres. Rows without any number are images without a pose, as in ``localized.csv``.

    Raises:
        DatasetError: A column is missing or there twice, or a cell is missing, no number, or out of range.
    """
    lines = content(path)
    where, head = next(lines, (str(path), ""))
    columns = table_columns(head)
    with LayoutGuard(where, TABLE_LAYOUT):
        twice = {name for name in columns if name and columns.count(name) > 1}
        if twice:
            raise LodbenchError(f"several columns hold {' and '.join(sorted(twice))}")
        place = _EARTH if {*_EARTH} & {*columns} else _GRID
        missing = [name for name in ("name", *place, *_LOOK) if name not in columns]
        if missing:
            raise LodbenchError(f"there is no column for {', '.join(missing)}")
    for where, line in lines:
        with LayoutGuard(where, TABLE_LAYOUT):
            cells = [cell.strip() for cell in _cells(line.rstrip("\r"), _separator(head))]
            if any(cells[len(columns) :]):
                raise LodbenchError(f"{len(cells)} values for {len(columns)} columns")
            row = {name: cell for name, cell in zip(columns, cells, strict=False) if name}
            pose = _of_row(where, row)
        if pose is not None:
            yield pose


def _cells(line: str, separator: str) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=separator))
    except csv.Error as error:
        raise LodbenchError(str(error)) from error


def _of_row(where: str, row: dict[str, str]) -> FoundPose | None:
    """Returns the pose of a row, None if it has no numbers."""
    if not any(row.get(name) for name in (*_EARTH, *_GRID, *_LOOK)):
        return None
    place = _EARTH if row.get("lat") or row.get("lon") or not {*_GRID} & {*row} else _GRID
    first, second, height, heading, pitch = (_cell(row, name) for name in (*place, *_LOOK))
    roll = _cell(row, "roll") if row.get("roll") else 0.0
    if not row.get("name"):
        raise LodbenchError("name is missing")
    # Longitude counts to the east, as x does.
    crs, x, y = (DEGREES_CRS, second, first) if place is _EARTH else (row.get("crs") or None, first, second)
    pose = Pose.from_center(rotation_from_look(heading, pitch, roll), (x, y, height))
    return FoundPose(show_formula(row["name"]), where, pose, crs=crs)


def _cell(row: dict[str, str], name: str) -> float:
    text = row.get(name, "")
    low, high = _LIMITS.get(name, (-math.inf, math.inf))
    try:
        value = float(text)
    except ValueError:
        raise LodbenchError(f"{name} is {repr(text) + ', no number' if text else 'missing'}") from None
    if not math.isfinite(value) or not low <= value <= high:
        raise LodbenchError(
            f"{name} {text} is not {'finite' if name not in _LIMITS else f'in {low:g} to {high:g}'}"
        )
    return value


_FIX_LAYOUT = "a head `name,latitude,longitude,height,sigma_east,sigma_north,sigma_up`: degrees, metres"
_GPX_LAYOUT = 'points <wpt lat="..." lon="..."><ele>...</ele><name>PHOTO</name></wpt>'
_FIX_SIGMAS = ("sigma_east", "sigma_north", "sigma_up")
# Least and most of each column: a deviation is above 0.
_FIX_LIMITS = {"latitude": (-90.0, 90.0), "longitude": (-180.0, 180.0), "height": (-1e5, 1e5)}
_TINY, _MOST_SIGMA_M = 1e-9, 1e3


class Fix(NamedTuple):
    """Where a receiver was."""

    latitude_deg: float  # WGS 84
    longitude_deg: float  # WGS 84
    height_m: float | None  # as the file has it; None where it has none
    # (3,) standard deviations east, north and up, metres; None where the file has none
    sigmas: tuple[float | None, ...]


def read_fixes(path: Path) -> dict[str, Fix]:
    """Returns the fixes of a file by the photos' names.

    Raises:
        DatasetError: It cannot be read, names a photo twice, or a value is missing, none or out of range.
    """
    fixes: dict[str, Fix] = {}
    for where, row in (_gpx_rows if path.suffix.lower() == ".gpx" else _csv_rows)(path):
        with LayoutGuard(where, _GPX_LAYOUT if path.suffix.lower() == ".gpx" else _FIX_LAYOUT):
            name = row.get("name", "")
            if not name:
                raise LodbenchError("name is missing")
            if name in fixes:
                raise LodbenchError(f"the name {name} occurs twice")
            latitude, longitude = (_number(row, axis) for axis in ("latitude", "longitude"))
            if latitude is None or longitude is None:
                raise LodbenchError("latitude or longitude is missing")
            sigmas = tuple(_number(row, axis) for axis in _FIX_SIGMAS)
            fixes[name] = Fix(latitude, longitude, _number(row, "height"), sigmas)
    if not fixes:
        raise DatasetError(f"{path} holds no fixes.", f"It is {_FIX_LAYOUT}; or GPX: {_GPX_LAYOUT}.")
    return fixes


def _csv_rows(path: Path) -> Iterator[tuple[str, dict[str, str]]]:
    lines = content(path)
    where, head = next(lines, (str(path), ""))
    names = [cell.strip().lower() for cell in head.split(",")]
    with LayoutGuard(where, _FIX_LAYOUT):
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
    low, high = _FIX_LIMITS.get(name, (_TINY, _MOST_SIGMA_M))
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not low <= number <= high:
        raise LodbenchError(f"{name} {text} is not within {low:g} to {high:g}")
    return number
