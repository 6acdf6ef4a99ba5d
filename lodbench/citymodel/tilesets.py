"""3D Tiles, which are not read: what a ``tileset.json`` is, and which place on Earth it is of."""

from __future__ import annotations

from typing import Any

import numpy as np

_EARTH_M = (6.2e6, 6.5e6)  # how far from the middle of the Earth its places are
HINT = (
    "Its tiles are meshes of their own (.b3dm, .glb): convert them to one .glb or .obj, or take the CityGML "
    "or CityJSON they were made from."
)


def is_tileset(document: Any) -> bool:
    """Tells whether a JSON document is the index of 3D Tiles."""
    return isinstance(document, dict) and {"asset", "root", "geometricError"} <= document.keys()


def place_of_tileset(document: dict[str, Any]) -> str:
    """Returns where the root of a tileset lies, in words; "" where it says no place.

    Example:
        >>> place_of_tileset({"root": {"boundingVolume": {"region": [0.2, 0.8, 0.2, 0.8, 0, 9]}}})
        'at latitude 45.83662, longitude 11.45916'
    """
    try:
        longitude, latitude = _degrees(document["root"])
    except (KeyError, TypeError, ValueError, IndexError):
        return ""
    return f"at latitude {latitude:.5f}, longitude {longitude:.5f}"


def _degrees(root: dict[str, Any]) -> tuple[float, float]:
    """Returns longitude and latitude of the middle of a tile.

    Raises:
        KeyError, TypeError, ValueError, IndexError: It says none.
    """
    from pyproj import Transformer

    volume = root["boundingVolume"]
    if "region" in volume:  # west, south, east, north in radians
        west, south, east, north = np.degrees(np.asarray(volume["region"][:4], np.float64)).tolist()
        return 0.5 * (west + east), 0.5 * (south + north)
    middle = np.asarray((volume.get("box") or volume["sphere"])[:3], np.float64)
    matrix = np.asarray(root.get("transform", np.eye(4)), np.float64).reshape(4, 4)  # column by column
    place = np.append(middle, 1.0) @ matrix[:, :3]
    if not _EARTH_M[0] < np.linalg.norm(place) < _EARTH_M[1]:
        raise ValueError("no place on Earth")
    degrees = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*place)
    return float(degrees[0]), float(degrees[1])
