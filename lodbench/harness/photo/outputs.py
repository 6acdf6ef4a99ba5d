"""What localising photos leaves: overlays, maps of cameras and of errors in the city, a 3D page, sidecars."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from shapely import Polygon, polygons, union_all
from shapely.geometry.polygon import orient

from lodbench.citymodel.scene import Scene
from lodbench.datasets.exchange.geojson import camera_feature, footprint_feature, view_feature
from lodbench.datasets.exchange.photogrammetry import write_sidecar
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, Pose
from lodbench.methods import Estimate
from lodbench.photos.camera import undistorted
from lodbench.photos.map_frame import MapFrame
from lodbench.rendering import Renderer
from lodbench.reporting import answers, flight_words, maps, overlays, table_heads
from lodbench.segmentation import binary_mask
from lodbench.storage import can_write
from lodbench.storage.json_text import finite

# The ground is where the lowest corners of the city are, this near a camera; a few may be cellars.
_NEAR_M, _LOWEST_PERCENT = 400.0, 5.0
# Polygons, each its rings, (N, 2) east and north.
Outline = list[list[NDArray[np.float64]]]
# Digits of a degree, a millimetre or so; triangles smaller than this from above are walls, square metres; and
# points nearer than this are one, metres.
_DIGITS, _LEAST_M2, _SAME_M = 8, 1e-3, 0.01


class PhotoView(NamedTuple):
    """A photo as the camera took it, and as it was localised."""

    name: str  # file name
    # (H, W, 3) uint8 of the photo as stored, or None where it cannot be decoded.
    pixels: NDArray[np.uint8] | None
    camera: Camera  # its camera, lens included
    pinhole: Camera  # the camera that was localised
    # (H, W) probability of building as the pinhole sees it; None where no mask was looked at.
    mask: NDArray[np.float32] | None

    def undistorted(self) -> NDArray[np.uint8] | None:
        """Returns the pixels as the pinhole sees them."""
        return None if self.pixels is None else undistorted(self.pixels, self.camera, self.pinhole)

    def thumbnail(self) -> bytes | None:
        """Returns these pixels as a small JPEG."""
        pixels = self.undistorted()
        return None if pixels is None else maps.photo_jpeg(pixels)


def write_photo_overlay(
    path: Path, view: PhotoView, renderer: Renderer, prior: Pose, estimate: Estimate
) -> None:
    """Writes the photo with the city's outline at the estimate beside it at the prior."""
    mask, origin = view.mask, renderer.scene.origin
    shown = overlays.OverlayInput(
        camera=view.pinhole,
        mask=None if mask is None else binary_mask(mask, mask.shape[1], mask.shape[0]),
        image=view.undistorted(),
        prior=prior.shifted(-origin),
        estimate=estimate.pose.shifted(-origin),
        truth=None,
        caption=f"{view.name}: score {table_heads.finite_text(estimate.score, '.3f')}",
    )
    overlays.write_picture(path, overlays.draw_overlay(shown, renderer))


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
        stated["probability"] = answers.rounded_down(estimate.probability, 4)
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


def building_outline(scene: Scene, building: int) -> Outline:
    """Returns the polygons of a building seen from above, each its rings, the outer one first.

    Rings are (N, 2) east and north in the city's coordinates; the outer one runs counter-clockwise.
    """
    rows = slice(scene.triangle_starts[building], scene.triangle_starts[building + 1])
    corners = scene.vertices[scene.triangles[rows]].astype(np.float64)[:, :, :2] + scene.origin[:2]
    sides = corners[:, 1:] - corners[:, :1]
    doubled = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
    whole = union_all(polygons(corners[np.abs(doubled) > _LEAST_M2]), grid_size=_SAME_M)
    parts = [orient(part) for part in getattr(whole, "geoms", [whole]) if isinstance(part, Polygon)]
    return [
        [np.array(ring.coords) for ring in (part.exterior, *part.interiors)]
        for part in parts
        if not part.is_empty
    ]


def contradictions(scene: Scene, findings: Mapping[str, Any]) -> list[tuple[dict[str, Any], Outline]]:
    """Returns what a flight contradicts in the map, the surest of each kind first: what, and where.

    ``kind`` is ``height``, ``demolished`` or ``unmapped``; the rest is as in the flight's findings. Outlines
    are polygons, each its rings, in the city's coordinates; of buildings that this map has not there is none.
    """
    rows = {name: row for row, name in enumerate(scene.building_ids)}

    def outline(name: str) -> Outline:
        return building_outline(scene, rows[name]) if name in rows else []

    conflicts: list[tuple[dict[str, Any], Outline]] = [
        ({"kind": "height", **each}, outline(each["id"]))
        for each in flight_words.doubted_buildings(findings.get("buildings", []))
    ]
    for change in findings.get("changes", []):
        stated = {key: value for key, value in change.items() if key != "outline"}
        if change["kind"] == "demolished":
            conflicts.append((stated, outline(change["id"])))
        else:
            conflicts.append((stated, [[np.array(ring, dtype=np.float64)] for ring in change["outline"]]))
    return conflicts


def contradiction_features(
    scene: Scene, frame: MapFrame, findings: Mapping[str, Any], flight: str
) -> list[dict[str, Any]]:
    """Returns what a flight contradicts in the map, as features of GeoJSON."""
    features = []
    for stated, outline in contradictions(scene, findings):
        rings = [[on_earth(ring, frame) for ring in polygon] for polygon in outline]
        geometry = {"type": "MultiPolygon", "coordinates": rings}
        features.append({"type": "Feature", "geometry": geometry, "properties": {"flight": flight, **stated}})
    return features


def city_and_marks(
    scene: Scene, findings: Mapping[str, Any]
) -> tuple[tuple[NDArray[np.float64], NDArray[np.int32]], list[maps.Marked]]:
    """Returns the city in its coordinates for a page, and what a flight contradicts in it."""
    outlines = [outline for _, outline in contradictions(scene, findings)]
    marks = [
        maps.Marked(f"{name}: {stated}", [ring for polygon in outline for ring in polygon])
        for (name, stated, _), outline in zip(flight_words.map_rows(findings), outlines, strict=True)
    ]
    return (scene.vertices + scene.origin, scene.triangles), marks


def on_earth(points: NDArray[np.float64], frame: MapFrame) -> list[list[float]]:
    """Returns (N, 2) points, east and north, as longitudes and latitudes of GeoJSON."""
    places = [frame.latitude_longitude(float(east), float(north)) for east, north in points]
    return [[round(longitude, _DIGITS), round(latitude, _DIGITS)] for latitude, longitude in places]
