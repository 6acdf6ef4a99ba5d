"""Places of pixels on the map or the ground, with covariance.

Errors of a pose that compensate one another in the image do so here too, as long as the whole covariance is
given: a place on the ground is known better than the camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap.laser import at_centre, update_by_range
from lodbench.citymap.linear_places import (
    CHI2_95,
    PIXEL_SIGMA_PX,
    LinearPlaces,
    Uncertainty,
    linearized_places,
)
from lodbench.citymodel.scene import Scene
from lodbench.errors import LodbenchError
from lodbench.geometry import Camera, Pose
from lodbench.photos.xmp import LaserRange
from lodbench.rendering.surfaces import MAP_SIGMA_M, Surfaces

Floats = NDArray[np.float64]

# Rays on the 95 % ellipse around a pixel, for what else it may show.
_AROUND = 8


class Ellipse(NamedTuple):
    """Where on the map a place is with 95 %: half axes in metres, the long one's bearing from grid north."""

    major_m: float
    minor_m: float
    bearing_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class LocatedPixel:
    """Where a pixel is.

    Attributes:
        place: (3,) east, north, up, metres: the city's coordinates from ``locate``.
        covariance: (3, 3) of its error, square metres; None where that of the pose is not known.
        surface: What the pixel shows: ``roof``, ``wall`` or ``ground``.
        building: Id of the building, or None on the ground.
        beside: What else it may show, within 95 % of pose and pixel: the covariance knows of no edges.
        notes: What a laser's range says against it, in a sentence.
    """

    place: Floats
    covariance: Floats | None
    surface: str
    building: str | None
    beside: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def shows(self) -> str:
        """Returns what the pixel shows, in words: ``roof of B1``."""
        return self.surface if self.building is None else f"{self.surface} of {self.building}"

    @property
    def ellipse(self) -> Ellipse | None:
        """Returns the 95 % ellipse on the map; None without a covariance."""
        if self.covariance is None:
            return None
        (small, large), axes = np.linalg.eigh(self.covariance[:2, :2])
        bearing = math.degrees(math.atan2(axes[0, 1], axes[1, 1])) % 180.0
        major, minor = (math.sqrt(CHI2_95 * max(float(value), 0.0)) for value in (large, small))
        return Ellipse(major, minor, bearing)


def locate(
    scene: Scene,
    camera: Camera,
    pose: Pose,
    pixel: Sequence[float],
    covariance: NDArray[np.float64] | None = None,
    *,
    parameters: Sequence[str] = (),
    pixel_sigma_px: float = PIXEL_SIGMA_PX,
    map_sigma_m: float = MAP_SIGMA_M,
    ground_sigma_m: float | None = None,
    laser: LaserRange | None = None,
) -> LocatedPixel:
    """Returns the place that a pixel of a localised photo shows: on a building, else on the ground.

    The ground is a local plane through the bases of the buildings around.

    Args:
        scene: The city, from ``open_scene``.
        camera: Of the photo; a lens is undone.
        pose: In the city's own coordinates (its CRS); so is the answer.
        pixel: Column and row, COLMAP's convention: the centre of the first pixel is 0.5, 0.5.
        covariance: (6, 6) as of ``Estimate``: x, y, z in metres, pitch, roll, yaw in degrees; with
            ``parameters`` (6 + K, 6 + K).
        parameters: What its further rows are of: ``focal`` (a share), ``cx``, ``cy`` (pixels), ``k1``.
        pixel_sigma_px: Standard deviation of the pixel along each axis.
        map_sigma_m: The same of a surface of the map along its normal.
        ground_sigma_m: The same of the ground's height; None for what the bases around say.
        laser: The range measured at the photo's centre, used for pixels on the surface that it met.

    Raises:
        LodbenchError: The pixel is outside the photo or shows no place of the map, or the covariance is none.
    """
    if not isinstance(scene, Scene):
        raise LodbenchError(f"{scene!r} is not a scene.", "lodbench.open_scene(FILE) makes one.")
    pixels = np.array([pixel], dtype=np.float64)
    require_pixels(camera, pixels)
    surfaces = Surfaces(scene, map_sigma_m, ground_sigma_m)
    uncertainty = Uncertainty(covariance, tuple(parameters), pixel_sigma_px)
    found = places_of(surfaces, camera, pose.shifted(-scene.origin), pixels, uncertainty, laser)[0]
    if found is None:
        raise nowhere(pixels[0])
    return shifted(found, scene.origin)


def require_pixels(camera: Camera, pixels: Floats) -> None:
    """Makes sure that (N, 2) pixels are in a photo.

    Raises:
        LodbenchError: One is not.
    """
    for u, v in pixels:
        if not (0 <= u <= camera.width and 0 <= v <= camera.height):
            raise LodbenchError(
                f"The pixel {u:g} {v:g} is outside the photo of {camera.width} x {camera.height}.",
                "Pixels count from the upper left corner of the photo as it is stored.",
            )


def nowhere(pixel: Floats) -> LodbenchError:
    """Returns the fault of a pixel that shows no place."""
    return LodbenchError(
        f"The ray through pixel {pixel[0]:g} {pixel[1]:g} meets neither a building nor the ground: sky, or "
        "ground far outside the city model.",
        "Take a pixel on the ground or on a building of the model.",
    )


def shifted(found: LocatedPixel, offset: Floats) -> LocatedPixel:
    """Returns a place moved by (3,) metres."""
    return LocatedPixel(
        found.place + offset, found.covariance, found.surface, found.building, found.beside, found.notes
    )


def places_of(
    surfaces: Surfaces,
    camera: Camera,
    pose: Pose,
    pixels: Floats,
    known: Uncertainty,
    laser: LaserRange | None = None,
) -> list[LocatedPixel | None]:
    """Returns the places that (N, 2) pixels show, in the scene's frame; None for those that show none.

    Arguments as of ``locate``, pose in the scene's frame.
    """
    linear = linearized_places(surfaces, camera, pose, pixels, known.parameters)
    hits = linear.hits
    places, covariances, notes = hits.places.copy(), None, [""] * len(pixels)
    beside: list[tuple[str, ...]] = [()] * len(pixels)
    if known.covariance is not None:
        covariances, beside = linear.covariances(known), _beside(surfaces, pose, linear, known)
        if laser is not None:
            centre = at_centre(surfaces, camera, pose, known.parameters)
            notes = update_by_range(centre, pose, known, laser, linear, places, covariances)
    return [
        LocatedPixel(
            places[row],
            None if covariances is None else covariances[row],
            kind,
            None if hits.building[row] < 0 else surfaces.scene.building_ids[hits.building[row]],
            beside[row],
            (notes[row],) if notes[row] else (),
        )
        if kind
        else None
        for row, kind in enumerate(hits.kind)
    ]


def _beside(
    surfaces: Surfaces, pose: Pose, linear: LinearPlaces, known: Uncertainty
) -> list[tuple[str, ...]]:
    """Returns what else pixels may show: what rays on the 95 % ellipse around their own meet."""
    assert known.covariance is not None  # noqa: S101 - the caller has looked
    rows = [row for row, kind in enumerate(linear.hits.kind) if kind]
    by_ray, by_pixel = linear.by_ray[rows], linear.by_ray_pixel[rows]
    spread = by_ray @ known.covariance @ by_ray.transpose(0, 2, 1)
    spread += known.pixel_sigma_px**2 * by_pixel @ by_pixel.transpose(0, 2, 1)
    ray = linear.rays[rows] / np.linalg.norm(linear.rays[rows], axis=1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None]
    values, axes = np.linalg.eigh(across @ spread @ across)
    turns = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
    reach = np.sqrt(CHI2_95 * np.maximum(values[:, None, 1:], 0.0))
    rim = (np.stack([np.cos(turns), np.sin(turns)], axis=1) * reach) @ axes[:, :, 1:].transpose(0, 2, 1)
    rays = linear.hits.places[rows][:, None] + rim - pose.center
    hits = surfaces.hit(pose.center, rays.reshape(-1, 3))
    names = [surfaces.name(hits, k) or "nothing" for k in range(len(hits.kind))]
    others: list[tuple[str, ...]] = [()] * len(linear.hits.kind)
    for k, row in enumerate(rows):
        around = dict.fromkeys(names[k * _AROUND : (k + 1) * _AROUND])
        others[row] = tuple(name for name in around if name != surfaces.name(linear.hits, row))
    return others
