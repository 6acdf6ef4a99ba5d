"""Anybody's poses, read into world-to-camera poses with the place each stood at.

==========  ==============================================================  ===============
format      layout                                                          stored as
==========  ==============================================================  ===============
lines       ``name qw qx qy qz tx ty tz`` (visuallocalization.net)          world to camera
c2w         a folder of ``<stem>_pose.txt`` or ``<stem>.txt``, 4 x 4        camera to world
colmap      a model's folder, or its ``images.txt`` or ``images.bin``       world to camera
tum         ``timestamp tx ty tz qx qy qz qw``                              camera to world
kapture     a folder with ``sensors/trajectories.txt``                      world to camera
nerfstudio  ``transforms.json``, OpenGL axes                                camera to world
metashape   exported reference: ``#Label,X/Easting,...,Yaw,Pitch,Roll``     centre and angles
pix4d       ``imageName X Y Z Omega Phi Kappa``                             centre and angles
table       a head ``name,lat,lon,height,heading,pitch``, and a row each    centre and angles
odm         ``geo.txt`` with omega, phi, kappa                              centre and angles
==========  ==============================================================  ===============

Poses of a file that declares a reference system of its own are brought into that of the city.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.crs import is_same_plane, require_crs
from lodbench.citymodel.frame import brought_note
from lodbench.datasets.exchange.colmap import is_colmap, models_below
from lodbench.datasets.exchange.kapture_nerfstudio import is_kapture
from lodbench.datasets.exchange.lines import TABLE_LAYOUT, table_columns
from lodbench.datasets.exchange.photogrammetry import looks_like
from lodbench.datasets.pose_text import DEGREES_CRS, FoundPose, content, with_slashes
from lodbench.errors import ConfigError, DatasetError, nearest_names
from lodbench.geometry import Pose
from lodbench.photos.map_frame import MapFrame
from lodbench.plugins import blaming, load_plugin, of_kind, plugin_names
from lodbench.storage.paths import require_regular

if TYPE_CHECKING:
    from pyproj import Transformer

# What a format is stored in, where it is not either.
_FOLDERS, _FILES = ("c2w", "kapture"), ("lines", "tum", "metashape", "pix4d", "odm", "table")


def read_pose_file(path: Path, format_name: str, known: Collection[str] = ()) -> tuple[str, list[FoundPose]]:
    """Returns the format and the poses of a file or folder, in file order.

    Args:
        path: A file or folder.
        format_name: An entry point under ``lodbench.pose_formats``, a function from a path to poses; or
            ``auto`` to tell by the content, among those above.
        known: Names of queries: a line that starts with one is no TUM line, even if it is a number.

    Raises:
        ConfigError: There is no such format, or it is broken.
        DatasetError: The file is missing, empty or of no known format, or a line holds no pose; the
            message names the line.
    """
    known_formats = (*plugin_names("pose_formats"), "auto")
    if format_name not in known_formats:
        raise ConfigError(f"format={format_name} is not known.", nearest_names(format_name, known_formats))
    if not path.exists():
        raise DatasetError(f"The pose file {path} does not exist.", "Set `poses=FILE`.")
    require_regular(path)
    kind = _guess(path, known) if format_name == "auto" else format_name
    if kind in (_FILES if path.is_dir() else _FOLDERS):
        actual, wanted = ("a folder", "a file") if path.is_dir() else ("a file", "a folder")
        raise DatasetError(f"{path} is {actual}.", f"format={kind} reads {wanted}.")
    read = load_plugin("pose_formats", kind)
    with blaming("pose_formats", kind, f"read {path}"):
        read_poses = (of_kind(pose, FoundPose) for pose in read(path))
        poses = [pose._replace(name=with_slashes(pose.name)) for pose in read_poses]
    if not poses:
        raise DatasetError(f"{path} holds no poses.", f"It was read with `format={kind}`.")
    return kind, poses


def _guess(path: Path, known: Collection[str]) -> str:
    """Returns the format that a folder's files, a file's ending or its first line look like."""
    if path.is_dir():
        if is_kapture(path):
            return "kapture"
        is_above_models = bool(models_below(path)) and not any(path.glob("*.txt"))
        return "colmap" if is_colmap(path) or is_above_models else "c2w"
    if path.suffix in (".json", ".bin"):
        return "nerfstudio" if path.suffix == ".json" else "colmap"
    where, line = next(content(path), (str(path), ""))
    named = looks_like(path)
    # Pix4D's own tables have no heading.
    if named is None or (named == "pix4d" and "heading" in line.lower()):
        named = "table" if table_columns(line) else named
    if named is not None:
        return named
    words = line.split()
    if not words:
        raise DatasetError(f"{path} holds no poses.", "A line of a pose file is a name and numbers.")
    if len(words) >= 10 and words[0].isdigit() and words[8].isdigit():
        return "colmap"
    if len(words) == 8 and words[0] not in known and is_number(words[0]):
        return "tum"
    if len(words) >= 8:
        return "lines"
    raise DatasetError(
        f"{where} is of no known pose format.",
        f"Known formats: {', '.join(plugin_names('pose_formats'))}. A table has {TABLE_LAYOUT}.",
    )


def is_number(word: str) -> bool:
    """Tells whether a word reads as a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


# Half of the line to the north that shows how one grid lies on the other, metres.
_NORTH_M = 50.0


def brought(images: Sequence[FoundPose], crs: str | None) -> tuple[list[FoundPose], tuple[str, ...]]:
    """Returns poses in a city's coordinates, and what the reader should know of those that were moved.

    Places are moved, and headings turned from the one grid north to the other; heights stay as they are.
    Poses whose file declares no system are taken to be in the city's.

    Args:
        images: As their file has them.
        crs: Of the city, projected in metres; None where nobody knows it.

    Raises:
        DatasetError: The declared system is not in metres, or the way from it to the city's is not known; or
            poses have latitude and longitude, and nobody knows the city's system.
    """
    moved: list[FoundPose] = []
    notes: dict[str, str] = {}
    for image in images:
        if image.crs == DEGREES_CRS:
            moved.append(image._replace(pose=_projected(image, crs), crs=crs))
            notes.setdefault(
                DEGREES_CRS, f"latitudes and longitudes brought to {crs}; heights are the city's"
            )
            continue
        if crs is None or image.crs is None or is_same_plane(image.crs, crs):
            moved.append(image)
            continue
        pose, accuracy_m = _moved(image, image.crs, crs)
        moved.append(image._replace(pose=pose, crs=crs))
        sure = f", places to {accuracy_m:g} m" if accuracy_m else ""
        notes.setdefault(image.crs, f"poses in {brought_note(image.crs, crs)}{sure}")
    return moved, tuple(notes.values())


def _projected(image: FoundPose, crs: str | None) -> Pose:
    """Returns a pose by longitude, latitude and true north in a city's coordinates."""
    if crs is None:
        raise DatasetError(
            f"{image.where}: latitude and longitude are nowhere in a city without a reference system.",
            "Name it with `--crs`, or give easting and northing in the city's coordinates.",
        )
    longitude, latitude, height = (float(value) for value in image.pose.center)
    frame = MapFrame(crs)
    east, north = frame.east_north(latitude, longitude)
    turn = -math.radians(frame.convergence_deg(east, north))
    return Pose.from_center(image.pose.rotation @ _turned(turn), (east, north, height))


def _moved(image: FoundPose, declared: str, crs: str) -> tuple[Pose, float]:
    """Returns a pose in another system, and how well the way there is known, metres."""
    from pyproj.exceptions import ProjError

    hint = f"Export the poses in the city's own system, {crs}."
    if not require_crs(declared).is_metric:
        raise DatasetError(f"{image.where}: {declared} is not in metres to the east and north.", hint)
    east, north, up = (float(value) for value in image.pose.center)
    line = [east, east, east], [north - _NORTH_M, north, north + _NORTH_M]
    try:
        transformer = _transformer(declared, crs)
        easts, norths = transformer.transform(*line, errcheck=True)
        accuracy_m = float(transformer.get_last_used_operation().accuracy)
    except ProjError as error:
        raise DatasetError(
            f"{image.where}: the place {east:.2f}, {north:.2f} in {declared} cannot be brought to {crs}.",
            hint,
        ) from error
    turn = math.atan2(easts[2] - easts[0], norths[2] - norths[0])
    return Pose.from_center(image.pose.rotation @ _turned(turn), (easts[1], norths[1], up)), accuracy_m


def _turned(turn: float) -> NDArray[np.float64]:
    """Returns the rotation from a system's axes to others, against which its north is turned clockwise."""
    c, s = math.cos(turn), math.sin(turn)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@lru_cache(maxsize=16)
def _transformer(declared: str, crs: str) -> Transformer:
    """Returns the way between two planes; never one that leaves out the step between their datums."""
    from pyproj import Transformer

    planes = require_crs(declared).horizontal, require_crs(crs).horizontal
    return Transformer.from_crs(*planes, always_xy=True, allow_ballpark=False)
