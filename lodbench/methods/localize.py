"""One call from a city, a mask and a rough pose to the pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene
from lodbench.datasets.query import Query
from lodbench.errors import LodbenchError
from lodbench.geometry import Camera, CameraSigmas, Pose
from lodbench.methods.lodlocv2 import LodLocV2
from lodbench.methods.protocol import Estimate, Method, SupportsPrepare
from lodbench.methods.registry import make_method
from lodbench.methods.timed_localize import localize_query
from lodbench.methods.workspace import Workspace
from lodbench.photos.measurements import Measurements
from lodbench.segmentation import check_mask
from lodbench.storage import random_stream


def localize(
    scene: Scene,
    camera: Camera,
    prior: Pose,
    mask: NDArray[np.float32] | NDArray[np.bool_] | None = None,
    *,
    image: str | Path | None = None,
    method: str | Method | None = None,
    seed: int = 0,
    threads: int | None = None,
    lens_percent: float | None = None,
    camera_sigmas: CameraSigmas | None = None,
    measured: Measurements | None = None,
    segment: Callable[[Pose], NDArray[np.float32]] | None = None,
) -> Estimate:
    """Returns the pose of one photo, from its building mask or its pixels, and a rough pose.

    Args:
        scene: The city, from ``open_scene``.
        camera: Pinhole of the full-size photo.
        prior: Rough pose in the city's own coordinates (its CRS); so is the answer.
        mask: (H, W) probability of building in [0, 1], or bool; any size of the photo's aspect; None
            for a method that requires none.
        image: The photo's file, lens distortion undone, for a method that looks at it.
        method: How, or the name of a method with its settings as they are; LoD-Loc v2 with the paper's
            parameters by default. One that prepares does so anew.
        seed: Seed of the search.
        threads: Threads of the renderer, None for one per core; never changes the answer.
        lens_percent: Standard deviation of the camera's focal length, percent, where that is not calibrated.
        camera_sigmas: Standard deviations of all of the camera's numbers; None: as calibrated.
        measured: What was measured beside the photo: deviations of the prior, a laser's range.
        segment: Makes a mask as of ``mask``, for a method that has one made where it needs it; its argument,
            the pose to guide it, is in the scene's frame.

    Raises:
        QueryFault: The mask is not as described or holds no building, or no building is near the prior.
        LodbenchError: The scene is none, the prior is no pose, or the method is not known.
    """
    if not isinstance(scene, Scene):
        raise LodbenchError(f"{scene!r} is not a scene.", "lodbench.open_scene(FILE) makes one.")
    prior = Pose.from_matrix(prior.cam_from_world)
    photo = None if image is None else Path(image)
    probability = None if mask is None else check_mask(mask, camera)
    query = Query(
        "photo",
        "",
        camera,
        prior.shifted(-scene.origin),
        probability,
        photo,
        lens_percent=lens_percent,
        camera_sigmas=camera_sigmas,
        measured=measured,
        segment=segment,
    )
    city_map = CityMap(scene, threads=threads)
    streams = partial(random_stream, seed, "localize", "photo")
    method = make_method(method) if isinstance(method, str) else method or LodLocV2()
    with TemporaryDirectory() as folder:
        if isinstance(method, SupportsPrepare):
            method.prepare(city_map, (), Workspace(Path(folder)))
        estimate = localize_query(method, query, city_map, streams)
    return replace(
        estimate,
        pose=estimate.pose.shifted(scene.origin),
        alternatives=tuple(pose.shifted(scene.origin) for pose in estimate.alternatives),
    )
