"""Whether poses look at the city, or would if they were read in the other direction.

A file of camera-to-world poses that is read as world-to-camera puts cameras under ground or far away:
then the city lies behind them or out of the picture.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.posed import inverted
from lodbench.datasets.query import Dataset, Entry
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, Pose

Points = NDArray[np.float64]

# Corners of a city and poses of a dataset that are looked at: enough to tell, whatever their number.
_MAX_CORNERS, _MAX_POSES = 20_000, 60
# Poses are wrong if hardly any sees the city as given, and nearly all do the other way.
_HARDLY_ANY, _NEARLY_ALL = 0.2, 0.8


def sample_corners(scene: Scene) -> Points:
    """Returns (N, 3) corners of a city, evenly through its buildings, in ``scene``'s frame."""
    step = -(-len(scene.vertices) // _MAX_CORNERS)
    return scene.vertices[:: max(step, 1)].astype(np.float64)


def sees(camera: Camera, pose: Pose, corners: Points) -> bool:
    """Tells whether any of (N, 3) points lies in a picture."""
    pixels = camera.without_distortion().project(corners @ pose.rotation.T + pose.translation)
    # NaN, behind the camera, is never within.
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0) & (pixels <= (camera.width, camera.height))
    return bool(inside.all(axis=1).any())


def require_direction(dataset: Dataset, entries: Sequence[Entry], scene: Scene) -> None:
    """Makes sure that true poses and priors are not camera to world where world to camera is meant.

    Args:
        dataset: The dataset; poses are in its frame.
        entries: The queries to look at.
        scene: The city, whose origin is in the same frame.

    Raises:
        DatasetError: They see the city only when read in the other direction.
    """
    corners = sample_corners(scene)
    truth = [(entry.camera, dataset.truth.get(entry.key)) for entry in entries]
    priors = [(entry.camera, entry.prior) for entry in entries]
    for what, pairs in (("true poses", truth), ("priors", priors)):
        words = suspect_direction(pairs, corners, scene.origin)
        if words is not None:
            raise DatasetError(
                f"The {what} of {dataset.name} are the wrong way round: {words}.",
                "Text poses are world to camera (x_cam = R x_world + t); invert them.",
            )


def suspect_direction(
    pairs: Iterable[tuple[Camera | None, Pose | None]], corners: Points, origin: Points
) -> str | None:
    """Returns in words that poses see a city only if they are inverted, or None.

    Args:
        pairs: Cameras and poses; where one is missing the pair is left out.
        corners: (N, 3) points of the city less its origin.
        origin: (3,) of the city in the poses' frame.
    """
    known = [(camera, pose) for camera, pose in pairs if camera is not None and pose is not None]
    known = known[:: max(1, len(known) // _MAX_POSES)]
    if not known:
        return None
    given = sum(sees(camera, pose.shifted(-origin), corners) for camera, pose in known)
    if given > _HARDLY_ANY * len(known):
        return None
    other = sum(sees(camera, inverted(pose).shifted(-origin), corners) for camera, pose in known)
    if other < _NEARLY_ALL * len(known):
        return None
    return f"{given} of {len(known)} see the city as given, {other} if read camera to world"
