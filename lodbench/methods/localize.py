"""One call from a city, a mask and a rough pose to the pose."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Query
from lodbench.geometry import Camera, Pose
from lodbench.methods.asking import localize_query
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.methods.protocol import Estimate, Method
from lodbench.segmentation import check_mask
from lodbench.storage import random_stream


def localize(
    scene: Scene,
    camera: Camera,
    prior: Pose,
    mask: NDArray[np.float32] | NDArray[np.bool_] | None = None,
    *,
    method: Method | None = None,
    seed: int = 0,
    threads: int | None = None,
) -> Estimate:
    """Returns the pose of one photo, from its building mask and a rough pose.

    Args:
        scene: The city, from ``open_scene``.
        camera: Pinhole of the full-size photo.
        prior: Rough pose in the city's own coordinates (its CRS); so is the answer.
        mask: (H, W) probability of building in [0, 1], or bool; any size of the photo's aspect; None
            for a method that requires none.
        method: How; LoD-Loc v2 with the paper's parameters by default.
        seed: Seed of the search.
        threads: Threads of the renderer, None for one per core; never changes the answer.

    Raises:
        QueryFault: The mask is not as described or holds no building, or no building is near the prior.
    """
    probability = None if mask is None else check_mask(mask, camera)
    query = Query("photo", "", camera, prior.shifted(-scene.origin), probability)
    city_map = CityMap(scene, threads=threads)
    streams = partial(random_stream, seed, "localize", "photo")
    estimate = localize_query(method or LodLocV2(), query, city_map, streams)
    return replace(estimate, pose=estimate.pose.shifted(scene.origin))
