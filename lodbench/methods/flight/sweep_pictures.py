"""Photos as heights of roofs are looked for in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.pictures import read_picture
from lodbench.datasets.query import Query
from lodbench.geometry import Camera, Pose
from lodbench.segmentation import binary_mask

Floats = NDArray[np.float64]

# Photos are compared at this width, or at what leaves all of them so many pixels (1 GB), blurred a little,
# for poses are not exact.
_WIDTH, _PIXELS, _BLUR_PX = 1280, 256_000_000, 0.8


@dataclass(frozen=True, slots=True, eq=False)
class SweepPicture:
    """A photo as roofs are compared in it.

    Attributes:
        camera: The lens it was found to have, of the picture's size.
        distortion: Radial, k1.
        pose: Scene frame.
        pixels: (H, W, 4) L, a, b and the mask, 8 bits.
    """

    camera: Camera
    distortion: float
    pose: Pose
    pixels: NDArray[np.uint8]

    def project(self, points: Floats, distortion: float | None = None) -> tuple[Floats, Floats]:
        """Returns pixels (..., 2) of points (..., 3), the first pixel's centre at 0.5, and depths."""
        local = (points - self.pose.center) @ self.pose.rotation.T
        depths = np.maximum(local[..., 2], 0.1)
        away = local[..., :2] / depths[..., None]
        bent = self.distortion if distortion is None else distortion
        away = away * (1.0 + bent * (away**2).sum(axis=-1, keepdims=True))
        camera = self.camera
        return away * [camera.fx, camera.fy] + [camera.cx, camera.cy], local[..., 2]

    def holds(self, pixels: Floats, depths: Floats) -> NDArray[np.bool_]:
        """Returns which pixels it has, a pixel from its edge."""
        size = np.array([self.camera.width, self.camera.height]) - 1.0
        return np.asarray(((pixels > 1.0) & (pixels < size)).all(axis=-1) & (depths > 1.0))

    def shift_colours(self, shift: NDArray[np.float32]) -> None:
        """Adds (3,) to L, a and b, which stay within 8 bits."""
        self.pixels[..., :3] = np.clip(np.rint(self.pixels[..., :3] + shift), 0, 255)


def open_pictures(queries: Sequence[Query], poses: Sequence[Pose], lens: Floats) -> list[SweepPicture]:
    """Returns the photos that can be read; many are narrower than few.

    Args:
        queries: The photos.
        poses: Where they were found to be taken, scene frame.
        lens: The focal length's change as a share, and the radial distortion k1.
    """
    if not queries:
        return []
    # Of pictures one pixel wide.
    area = sum(query.camera.height / query.camera.width for query in queries)
    width = min(_WIDTH, int(math.sqrt(_PIXELS / area)))
    taken = (_picture(query, pose, lens, width) for query, pose in zip(queries, poses, strict=True))
    return [picture for picture in taken if picture is not None]


def _picture(query: Query, pose: Pose, lens: Floats, widest: int) -> SweepPicture | None:
    pixels = None if query.image is None else read_picture(query.image)
    if pixels is None:
        return None
    width = min(widest, pixels.shape[1])
    camera = query.camera.scaled(width, max(1, round(width * query.camera.height / query.camera.width)))
    size = camera.width, camera.height
    small = cv2.GaussianBlur(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), (0, 0), _BLUR_PX)
    mask = 255 * binary_mask(query.mask, *size).astype(np.uint8)
    longer = 1.0 + float(lens[0])
    camera = replace(camera, fx=camera.fx * longer, fy=camera.fy * longer)
    return SweepPicture(
        camera, float(lens[1]), pose, np.dstack([cv2.cvtColor(small, cv2.COLOR_BGR2LAB), mask])
    )
