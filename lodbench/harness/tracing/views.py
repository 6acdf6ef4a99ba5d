"""Posed photos that roofs are traced in: projection, rays, and the line segments that each shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.exchange.posed import FoundPose
from lodbench.datasets.own import find_photo
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, Pose
from lodbench.geometry.lens import distort
from lodbench.geometry.similarity import Similarity
from lodbench.segmentation.photos import read_photo

Floats = NDArray[np.float64]

# Shorter line segments are texture, pixels.
_SHORTEST_PX = 12.0
# The fixed point of a lens's inverse: photos of drones need five rounds.
_LENS_ROUNDS = 30


@dataclass(slots=True, eq=False)
class View:
    """A posed photo.

    Attributes:
        name: As the model calls it.
        camera: Of the photo as stored, lens distortion included.
        pose: World to camera.
        photo: Its file.
        kept: Its line segments, once they were looked for: copies of the view share them.
    """

    name: str
    camera: Camera
    pose: Pose
    photo: Path
    kept: list[Floats] = field(default_factory=list, repr=False)

    def project(self, points: Floats) -> Floats:
        """Returns (N, 2) pixels of (N, 3) points of the world; NaN behind the camera."""
        return self.camera.project(points @ self.pose.rotation.T + self.pose.translation)

    def rays(self, pixels: Floats) -> Floats:
        """Returns (N, 3) unit directions, world axes, of (N, 2) pixels."""
        camera = self.camera
        seen = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        plain = seen
        if camera.distortion:
            for _ in range(_LENS_ROUNDS):
                bent = np.stack(distort(camera.lens, camera.distortion, plain[:, 0], plain[:, 1]), axis=1)
                plain = plain + seen - bent
        rays = np.column_stack([plain, np.ones(len(plain))]) @ self.pose.rotation
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def shows(self, pixels: Floats) -> NDArray[np.bool_]:
        """Tells which of (N, 2) pixels are in the photo."""
        inside = (pixels >= 0) & (pixels <= [self.camera.width, self.camera.height])
        return np.asarray(inside.all(axis=1))

    def segments(self) -> Floats:
        """Returns (S, 4) line segments of the photo, ends in pixels (von Gioi et al., LSD, 2010); kept."""
        import cv2

        if not self.kept:
            grey = cv2.cvtColor(read_photo(self.photo), cv2.COLOR_RGB2GRAY)
            found = cv2.createLineSegmentDetector().detect(grey)[0]
            # OpenCV counts from pixel centres.
            ends = np.zeros((0, 4)) if found is None else np.reshape(found, (-1, 4)).astype(np.float64) + 0.5
            self.kept.append(ends[np.hypot(*(ends[:, 2:] - ends[:, :2]).T) >= _SHORTEST_PX])
        return self.kept[0]


def posed_views(images: Sequence[FoundPose], photos: Path, similarity: Similarity) -> dict[str, View]:
    """Returns the model's photos in the frame that a similarity leads to, by name.

    Those without a file, or a camera that is known here, are left out.

    Raises:
        DatasetError: No image has both.
    """
    views = {}
    for image in images:
        file = find_photo(photos, image.name)
        if image.camera is not None and file is not None:
            views[image.name] = View(image.name, image.camera, similarity.pose(image.pose), file)
    if all(image.camera is None for image in images):
        raise DatasetError(f"No image of the model can be used; {images[0].name}: {images[0].no_camera}")
    if not views:
        raise DatasetError(
            f"{photos} holds no photo of the model; the first is looked for as {images[0].name}.",
            "--images is the folder of the model's photos.",
        )
    return views


def triangulated(pixels: Mapping[str, Floats], views: Mapping[str, View]) -> Floats:
    """Returns (N, 3) the places nearest to the rays of all photos.

    Raises:
        DatasetError: A photo is not there, or the rays of a point are parallel.
    """
    count = len(next(iter(pixels.values())))
    normal, side = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for name, points in pixels.items():
        if name not in views:
            raise DatasetError(f"There is no photo {name}.", "--images is the folder of the model's photos.")
        rays, center = views[name].rays(points), views[name].pose.center
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        normal, side = normal + across, side + across @ center
    if np.linalg.eigvalsh(normal)[:, 0].min() < 1e-6:
        raise DatasetError(
            f"The rays from {' and '.join(pixels)} are parallel.", "Trace in photos taken further apart."
        )
    return np.asarray(np.linalg.solve(normal, side[..., None])[..., 0])
