"""The folder of a track: what is written there, and whose it is, so that no track replaces another's."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

from lodbench.errors import DatasetError
from lodbench.storage import hide_formula

TABLE_FILE, MAP_FILE, POSES_FILE = "track.csv", "track.geojson", "poses.txt"
# Frames of all videos have the same names: only this tells whose they are.
SOURCE_COLUMN = "source"
# The same whatever was found.
TABLE_COLUMNS = (
    "frame", "time_s", "state", "score", "reason", SOURCE_COLUMN, "sigma_m", "sigma_deg", "probability",
    "latitude_deg", "longitude_deg", "height_m", "heading_deg", "pitch_deg", "roll_deg", "crs",
    "east", "north", "up",
)  # fmt: skip


def source_word(source: Path) -> str:
    """Returns what stands in the table for a video or a folder of photos."""
    return hide_formula(str(source.resolve()))


def require_no_other(out: Path, source: Path, names: Iterable[str]) -> None:
    """Refuses a folder that holds a track of other frames, or files of somebody else's under its names.

    Args:
        out: The folder, which need not be there.
        source: The video or folder of photos whose track is to be written.
        names: Of its frames, in order; perhaps without end.

    Raises:
        DatasetError: It does.
    """
    files = [out / name for name in (TABLE_FILE, MAP_FILE, POSES_FILE)]
    there = [file for file in files if file.exists()]
    if there and not _is_track_of(out / TABLE_FILE, source, names):
        raise DatasetError(
            f"{there[0]} is not of these frames of {source} and would be written over.",
            "Name another folder: --out OTHER",
        )


def _is_track_of(table: Path, source: Path, names: Iterable[str]) -> bool:
    """Tells whether a table's rows are the first of these frames: what replaces it has a row for each."""
    try:
        with table.open(encoding="utf-8", newline="") as stream:
            rows = [(row["frame"], row[SOURCE_COLUMN]) for row in csv.DictReader(stream)]
        expected = [(hide_formula(name), source_word(source)) for name in islice(names, len(rows))]
        return bool(rows) and rows == expected
    except (OSError, ValueError, KeyError, csv.Error):
        return False  # somebody else's, or of a version that did not say
