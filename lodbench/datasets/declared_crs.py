"""Poses of a file that declares a reference system of its own, brought into that of a city."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from lodbench.citymodel.crs import is_same_plane, require_crs
from lodbench.citymodel.frame import brought_note
from lodbench.datasets.exchange.posed import FoundPose
from lodbench.errors import DatasetError
from lodbench.geometry import Pose

if TYPE_CHECKING:
    from pyproj import Transformer


# Half of the line to the north that shows how one grid lies on the other, metres.
_NORTH_M = 50.0


def brought(found: Sequence[FoundPose], crs: str | None) -> tuple[list[FoundPose], tuple[str, ...]]:
    """Returns poses in a city's coordinates, and what the reader should know of those that were moved.

    Places are moved, and headings turned from the one grid north to the other; heights stay as they are.
    Poses whose file declares no system are taken to be in the city's.

    Args:
        found: As their file has them.
        crs: Of the city, projected in metres; None where nobody knows it.

    Raises:
        DatasetError: The declared system is not in metres, or the way from it to the city's is not known.
    """
    moved: list[FoundPose] = []
    notes: dict[str, str] = {}
    for image in found:
        if crs is None or image.crs is None or is_same_plane(image.crs, crs):
            moved.append(image)
            continue
        pose, accuracy_m = _moved(image, image.crs, crs)
        moved.append(image._replace(pose=pose, crs=crs))
        sure = f", places to {accuracy_m:g} m" if accuracy_m else ""
        notes.setdefault(image.crs, f"poses in {brought_note(image.crs, crs)}{sure}")
    return moved, tuple(notes.values())


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
    c, s = math.cos(turn), math.sin(turn)
    old_from_new = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return Pose.from_center(image.pose.rotation @ old_from_new, (easts[1], norths[1], up)), accuracy_m


@lru_cache(maxsize=16)
def _transformer(declared: str, crs: str) -> Transformer:
    """Returns the way between two planes; never one that leaves out the step between their datums."""
    from pyproj import Transformer

    planes = require_crs(declared).horizontal, require_crs(crs).horizontal
    return Transformer.from_crs(*planes, always_xy=True, allow_ballpark=False)
