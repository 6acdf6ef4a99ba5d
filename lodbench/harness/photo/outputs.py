"""What localising a photo leaves: a picture of mask and city over the photo, and a map of the cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.geojson import camera_feature, footprint_feature, view_feature
from lodbench.geometry import Camera, Pose
from lodbench.methods import Estimate
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.undistort import undistorted
from lodbench.rendering import Renderer
from lodbench.reporting.answers import rounded_down
from lodbench.reporting.overlays import OverlayInput, draw_overlay, write_picture
from lodbench.reporting.table_columns import finite_text
from lodbench.reporting.view3d import photo_jpeg
from lodbench.segmentation import binary_mask
from lodbench.storage.json_text import finite

# The ground is where the lowest corners of the city are, this near a camera; a few may be cellars.
_NEAR_M, _LOWEST_PERCENT = 400.0, 5.0


class PhotoView(NamedTuple):
    """A photo as the camera took it, and as it was localised.

    Attributes:
        name: File name.
        pixels: (H, W, 3) uint8 of the photo as stored, or None where it cannot be decoded.
        camera: Its camera, lens included.
        pinhole: The camera that was localised.
        mask: (H, W) probability of building as the pinhole sees it; None where no mask was looked at.
    """

    name: str
    pixels: NDArray[np.uint8] | None
    camera: Camera
    pinhole: Camera
    mask: NDArray[np.float32] | None

    def undistorted(self) -> NDArray[np.uint8] | None:
        """Returns the pixels as the pinhole sees them."""
        return None if self.pixels is None else undistorted(self.pixels, self.camera, self.pinhole)

    def thumbnail(self) -> bytes | None:
        """Returns these pixels as a small JPEG."""
        pixels = self.undistorted()
        return None if pixels is None else photo_jpeg(pixels)


def write_photo_overlay(
    path: Path, view: PhotoView, renderer: Renderer, prior: Pose, estimate: Estimate
) -> None:
    """Writes the photo with the city's outline at the estimate beside it at the prior."""
    mask, origin = view.mask, renderer.scene.origin
    shown = OverlayInput(
        camera=view.pinhole,
        mask=None if mask is None else binary_mask(mask, mask.shape[1], mask.shape[0]),
        image=view.undistorted(),
        prior=prior.shifted(-origin),
        estimate=estimate.pose.shifted(-origin),
        truth=None,
        caption=f"{view.name}: score {finite_text(estimate.score, '.3f')}",
    )
    write_picture(path, draw_overlay(shown, renderer))


def photo_features(
    frame: MapFrame, name: str, camera: Camera, scene: Scene, prior: Pose, estimate: Estimate
) -> list[dict[str, Any]]:
    """Returns the cameras of prior and estimate, and what the latter sees, as features of GeoJSON."""
    stated: dict[str, Any] = {
        "name": name,
        "kind": "estimate",
        "score": finite(round(float(estimate.score), 4)),
    }
    if estimate.probability is not None:
        stated["probability"] = rounded_down(estimate.probability, 4)
    footprint = footprint_feature(
        frame, camera, estimate.pose, ground_below_m(scene, estimate.pose), {"name": name}
    )
    features = [
        camera_feature(frame, estimate.pose, stated, estimate.covariance),
        view_feature(frame, estimate.pose, {"name": name}),
        footprint,
        camera_feature(frame, prior, {"name": name, "kind": "prior"}),
    ]
    return [feature for feature in features if feature is not None]


def ground_below_m(scene: Scene, pose: Pose) -> float:
    """Returns the height of the ground around a camera, in the city's heights: its lowest walls there."""
    center = pose.center - scene.origin
    vertices = scene.vertices
    near = np.hypot(vertices[:, 0] - center[0], vertices[:, 1] - center[1]) < _NEAR_M
    heights = vertices[near, 2] if near.any() else vertices[:, 2]
    return float(np.percentile(heights, _LOWEST_PERCENT)) + float(scene.origin[2])
