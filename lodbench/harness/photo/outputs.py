"""What localising photos leaves: overlays, a map of the cameras, a 3D page, XMP sidecars."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.geojson import camera_feature, footprint_feature, view_feature
from lodbench.datasets.exchange.photogrammetry import write_sidecar
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, Pose
from lodbench.harness.city import open_city
from lodbench.harness.photo import LocalizedPhoto, PhotoRequest
from lodbench.methods import Estimate
from lodbench.photos.camera import undistorted
from lodbench.photos.map_frame import MapFrame, survey_row
from lodbench.rendering import Renderer
from lodbench.reporting.answers import percent_text, rounded_down
from lodbench.reporting.flight_words import place_columns
from lodbench.reporting.overlays import OverlayInput, draw_overlay, write_picture
from lodbench.reporting.table_columns import finite_text
from lodbench.reporting.view3d import MAX_PHOTOS, ViewedCamera, draw_view3d, photo_jpeg
from lodbench.segmentation import binary_mask
from lodbench.storage import can_write, write_text
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


def write_view(
    path: Path,
    request: PhotoRequest,
    found: Sequence[LocalizedPhoto],
    pages: Mapping[str, str] | None = None,
) -> None:
    """Writes a page of city, photos, rough and found poses.

    Args:
        path: The page.
        request: Its city is drawn.
        found: The answers, one at least.
        pages: Addresses of the pages that it leads to, by what they are called.
    """
    city = open_city(request.city, request.lod, request.options, request.roof_height)
    origin = city.scene.origin
    cameras = [
        ViewedCamera(
            key=each.photo,
            facts=_facts(each),
            camera=each.camera,
            prior=each.prior.shifted(-origin),
            estimate=each.pose.shifted(-origin),
            truth=None,
            photo=each.thumbnail if number < MAX_PHOTOS else None,
        )
        for number, each in enumerate(found)
    ]
    title = f"{len(found)} photo{'s' if len(found) > 1 else ''} over {request.city.name}"
    write_text(path, draw_view3d(title, city.scene, cameras, pages))


def _facts(found: LocalizedPhoto) -> dict[str, str]:
    """Returns what is stated of a photo, by name."""
    row = survey_row(found.pose, found.place)
    columns = place_columns(found.place is not None)
    x, y, *others = [format(row[name], spec) for _, name, spec in columns]
    place = {", ".join(head for head, _, _ in columns[:2]): f"{x}, {y}", "height m": others[0]}
    facts = {"trust": found.trust} | place | {"heading, pitch, roll deg": ", ".join(others[1:])}
    if found.probability is not None:
        facts["sure"] = percent_text(found.probability)
    moved = f"{found.moved.translation_m:.2f} m, {found.moved.rotation_deg:.2f} deg"
    return {**facts, "from the prior": moved, "score": finite_text(found.score, ".3f")}


def frame_on_earth(crs: str | None) -> MapFrame:
    """Returns the frame that sidecars are written in.

    Raises:
        DatasetError: Nobody knows where on Earth the city is.
    """
    if crs is None:
        raise DatasetError("`--sidecars` need a city with a reference system.", "Name it with `--crs`.")
    return MapFrame(crs)


def require_sidecars(crs: str | None, folders: Iterable[Path]) -> None:
    """Makes sure, before any work, that sidecars of photos in some folders can be written.

    Raises:
        DatasetError: A folder takes no files, or as ``frame_on_earth``.
    """
    frame_on_earth(crs)
    for folder in folders:
        if not can_write(folder):
            raise DatasetError(
                f"Nothing can be written beside the photos in {folder}.", "Leave `--sidecars` out."
            )


def write_sidecars(placed: Iterable[tuple[Path, Pose]], crs: str | None) -> str:
    """Writes ``PHOTO.xmp`` beside each photo; returns a line that says how many, and which were left alone.

    Of photos that differ in their ending alone, which would share one file, none gets any.

    Args:
        placed: Photos and their poses in the city's coordinates.
        crs: Of these.

    Raises:
        DatasetError: Nobody knows where on Earth the city is.
    """
    frame, placed = frame_on_earth(crs), list(placed)
    claims = Counter(photo.with_suffix(".xmp") for photo, _ in placed)
    written, left = 0, []
    for photo, pose in placed:
        if claims[photo.with_suffix(".xmp")] == 1:
            if write_sidecar(photo, pose, frame) is None:
                left.append(photo.with_suffix(".xmp"))
            else:
                written += 1
    shared = [path for path, count in claims.items() if count > 1]
    return (
        f"{written} written beside the photos"
        + _listed("of other programs left alone", left)
        + _listed("not written, which several photos would share", shared)
    )


def _listed(what: str, files: list[Path]) -> str:
    names = ", ".join(file.name for file in files[:3]) + (", ..." if len(files) > 3 else "")
    return f"; {len(files)} {what}: {names}" if files else ""
