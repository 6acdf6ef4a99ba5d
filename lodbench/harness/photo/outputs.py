"""What localising a photo leaves: a picture of mask and city over the photo, and a map of the cameras."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.geojson import camera_feature, view_feature, write_geojson
from lodbench.datasets.map_frame import MapFrame
from lodbench.datasets.undistort import undistorted
from lodbench.geometry import Camera, Pose
from lodbench.methods import Estimate
from lodbench.rendering import make_renderer
from lodbench.reporting.overlays import OverlayInput, draw_overlay, write_picture
from lodbench.segmentation import binary_mask


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


def write_photo_overlay(path: Path, view: PhotoView, scene: Scene, prior: Pose, estimate: Estimate) -> None:
    """Writes the photo with the city's outline at the estimate beside it at the prior."""
    mask = view.mask
    shown = OverlayInput(
        camera=view.pinhole,
        mask=None if mask is None else binary_mask(mask, mask.shape[1], mask.shape[0]),
        image=view.undistorted(),
        prior=prior.shifted(-scene.origin),
        estimate=estimate.pose.shifted(-scene.origin),
        truth=None,
        caption=f"{view.name}: score {estimate.score:.3f}",
    )
    write_picture(path, draw_overlay(shown, make_renderer("silhouette", scene)))


def write_photo_map(path: Path, frame: MapFrame, name: str, prior: Pose, estimate: Estimate) -> None:
    """Writes the cameras of prior and estimate, and what the latter sees, as GeoJSON."""
    stated = {"name": name, "kind": "estimate", "score": round(float(estimate.score), 4)}
    features = [
        camera_feature(frame, estimate.pose, stated),
        view_feature(frame, estimate.pose, {"name": name}),
        camera_feature(frame, prior, {"name": name, "kind": "prior"}),
    ]
    write_geojson(features, path)
