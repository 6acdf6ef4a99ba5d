"""Opening the city of a command: from the cache where it is there, with progress where it is not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lodbench.citymodel.cache import OpenCity, open_cached_city
from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError, DatasetError
from lodbench.execution import ProgressCallback
from lodbench.geometry import Pose
from lodbench.photos.map_frame import MapFrame
from lodbench.storage import digest_of

# A camera further from the city's outline than this sees none of it; nor one further below it than rough
# heights are off.
FURTHEST_M, _DEEPEST_M = 2000.0, 50.0
# From here on distances on the map are not those on the ground, or there is no place on the map at all.
_OTHER_REGION_M = 300_000.0
_TILE_HINT = "Is it the right tile, and its reference system right? lodbench city info says where it is."
HEIGHT_HINT = (
    "Photo and city use different height datums: set the photo's with `--takeoff METRES` or `--heights`."
)


def open_city(path: Path, lod: str | None, options: ReadOptions, roof_height: str | None) -> OpenCity:
    """Returns one level of detail of a city, drawing progress on a terminal; see ``open_cached_city``.

    Raises:
        CityModelError: The city cannot be read, or has no building at that level.
    """
    with ProgressCallback(f"reading {path.name}", "MB", 1_000_000) as progress:
        return open_cached_city(path, lod=lod, options=options, roof_height=roof_height, progress=progress)


def city_of_dataset(dataset: Dataset) -> OpenCity:
    """Returns the city of a dataset.

    Raises:
        ConfigError: It names none.
        CityModelError: It cannot be read, or has no building at that level.
    """
    if dataset.city_model is None:
        raise ConfigError("There is no city model to localise against.", dataset.city_hint)
    return open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height)


def scene_digest(scene: Scene) -> str:
    """Returns a digest of a city; the same houses elsewhere are another one."""
    return digest_of([scene.digest(), scene.origin.tolist()])


def city_digests(scene: Scene) -> dict[str, str]:
    """Returns digests of a city by name: ``scene``, and ``roofs`` where its source tells of pitched ones."""
    reported = {} if scene.pitched is None else {"roofs": digest_of(np.flatnonzero(scene.pitched).tolist())}
    return {"scene": scene_digest(scene), **reported}


def distance_outside_m(pose: Pose, scene: Scene) -> float:
    """Returns how far outside a city's rectangle a camera (its coordinates) is, metres; 0 above it."""
    low, high = (corner + scene.origin for corner in scene.extent_m)
    beside = np.maximum(np.maximum(low - pose.center, pose.center - high), 0.0)[:2]
    return float(np.hypot(beside[0], beside[1]))


def height_above_m(pose: Pose, scene: Scene) -> float:
    """Returns how far above a city's lowest point a camera (its coordinates) is, metres; else negative."""
    return float(pose.center[2] - scene.extent_m[0][2] - scene.origin[2])


def far_words(poses: Sequence[Pose], scene: Scene) -> tuple[str, str] | None:
    """Returns how far off cameras (their median) are that see none of a city, and what to do; else None."""
    away = float(np.median([distance_outside_m(pose, scene) for pose in poses]))
    if away > FURTHEST_M:
        return f"{_km(away)} outside the city model", _TILE_HINT
    below = -float(np.median([height_above_m(pose, scene) for pose in poses]))
    return (f"{below:.0f} m below the city model", HEIGHT_HINT) if below > _DEEPEST_M else None


def _km(metres: float) -> str:
    return f"{metres / 1000:,.0f} km" if metres > 1e5 else f"{metres / 1000:.1f} km"


def require_same_region(what: str, latitude_deg: float, longitude_deg: float, scene: Scene) -> None:
    """Makes sure that a place is where a city's coordinates mean anything: projections end far away.

    Args:
        what: It is, and did: "By its position DJI_0001.JPG was taken".
        latitude_deg: WGS 84.
        longitude_deg: WGS 84.
        scene: The city, with a reference system.

    Raises:
        DatasetError: It is hundreds of kilometres off.
    """
    from pyproj import Geod

    east, north = (float(value) for value in np.mean(scene.extent_m, axis=0)[:2] + scene.origin[:2])
    latitude, longitude = MapFrame(str(scene.crs)).latitude_longitude(east, north)
    away = Geod(ellps="WGS84").inv(longitude, latitude, longitude_deg, latitude_deg)[2]
    if away > _OTHER_REGION_M:
        hint = f"Is it the right tile? It is at latitude {latitude:.4f}, longitude {longitude:.4f}."
        raise DatasetError(f"{what} {_km(away)} outside the city model.", hint)


def require_near_city(what: str, poses: Sequence[Pose], scene: Scene) -> None:
    """Makes sure that cameras may see something of a city.

    Args:
        what: They are, and did: "The first frame was taken".
        poses: Theirs, in the city's own coordinates.
        scene: The city.

    Raises:
        DatasetError: They are too far off.
    """
    far = far_words(poses, scene)
    if far is not None:
        raise DatasetError(f"{what} {far[0]}.", far[1])
