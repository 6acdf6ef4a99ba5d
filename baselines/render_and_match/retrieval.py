"""Views over an area, drawn in the prior's direction and looked up by what whole pictures look like."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.errors import QueryFault
from lodbench.geometry import Camera, Pose
from lodbench.matching.protocol import Retrieval

from .correspondences import resized_photo

Floats = NDArray[np.float64]
# From a camera, rotations and centres to pictures and depths.
Draw = Callable[[Camera, Floats, Floats], tuple[NDArray[np.uint8], NDArray[np.float32]]]

# Long side of pictures that are described, and how many are drawn at a time.
_SIZE, _BATCH = 160, 16
_MOST_VIEWS = 20_000


def places_over(scene: Scene, center: Floats, area_m: float, spacing_m: float) -> Floats:
    """Returns (N, 3) places at one height, a spacing apart, no further from a place than an area reaches.

    Nor further beyond the city than the place is high: what is there shows none of it.

    Raises:
        QueryFault: They are too many.
    """
    low, high = scene.vertices.min(axis=0), scene.vertices.max(axis=0)
    reach = max(0.0, float(center[2] - low[2]))
    ranges = []
    for k in (0, 1):
        first = max(-area_m, float(low[k]) - reach - float(center[k]))
        last = min(area_m, float(high[k]) + reach - float(center[k]))
        ranges.append((np.ceil(first / spacing_m), np.floor(last / spacing_m) + 1))
    count = int(np.prod([max(0.0, stop - start) for start, stop in ranges]))
    if count > _MOST_VIEWS:
        raise QueryFault(f"{count} views over the area are too many: a larger method.spacing_m makes fewer")
    axes = [center[k] + spacing_m * np.arange(*ranges[k]) for k in (0, 1)]
    x, y = (each.ravel() for each in np.meshgrid(*axes, indexing="ij"))
    return np.column_stack([x, y, np.full(count, center[2])])


def retrieved(
    photo: NDArray[np.uint8],
    prior: Pose,
    camera: Camera,
    places: Floats,
    draw: Draw,
    retrieval: Retrieval,
    count: int,
) -> list[Pose]:
    """Returns the poses of the views that resemble a photo most, best first.

    All have the prior's direction: of a database of all directions, what an orientation gate would leave.

    Args:
        photo: (H, W, 3) RGB.
        prior: Of its place nothing is used.
        camera: Of the photo.
        places: (N, 3) where views are drawn from.
        draw: Draws them.
        retrieval: Describes pictures.
        count: How many to return.

    Raises:
        QueryFault: No view sees anything of the map.
    """
    share = _SIZE / max(camera.width, camera.height)
    small = camera.scaled(*(max(1, round(share * side)) for side in (camera.width, camera.height)))
    (wanted,) = retrieval.describe(resized_photo(photo, small)[None])
    likeness = np.full(len(places), -np.inf)
    for start in range(0, len(places), _BATCH):
        batch = places[start : start + _BATCH]
        pictures, depths = draw(small, np.repeat(prior.rotation[None], len(batch), axis=0), batch)
        sees = depths.any(axis=(1, 2))
        likeness[start : start + _BATCH] = np.where(sees, retrieval.describe(pictures) @ wanted, -np.inf)
    best = np.argsort(-likeness, kind="stable")[:count]
    poses = [Pose.from_center(prior.rotation, places[k]) for k in best if np.isfinite(likeness[k])]
    if not poses:
        raise QueryFault("no view over the area sees the map")
    return poses
