"""Photos of a flight as they are compared with the map: small, where they were found to be taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Query
from lodbench.geometry import Camera, Pose
from lodbench.segmentation import binary_mask

# Photos are compared at this width, pixels.
_WIDTH = 301


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A photo of a flight, where it was found to be taken.

    Attributes:
        name: Of the photo.
        camera: The lens it was found to have, of the working size.
        pose: Scene frame.
        mask: (H, W) what it shows of buildings.
    """

    name: str
    camera: Camera
    pose: Pose
    mask: NDArray[np.bool_]


def views_of(queries: Sequence[Query], poses: Sequence[Pose], focal: float) -> list[View]:
    """Returns photos to be compared with the map.

    Args:
        queries: The photos.
        poses: Where they were found to be taken.
        focal: By which share the focal length is longer than told.
    """
    views = []
    for query, pose in zip(queries, poses, strict=True):
        whole = query.camera
        small = whole.scaled(_WIDTH, max(1, round(_WIDTH * whole.height / whole.width)))
        camera = replace(small, fx=small.fx * (1.0 + focal), fy=small.fy * (1.0 + focal))
        views.append(View(query.name, camera, pose, binary_mask(query.mask, small.width, small.height)))
    return views
