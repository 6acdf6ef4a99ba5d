"""Places of pixels on the map or the ground, with covariance, to first order in all errors.

A pixel's ray starts at the camera and turns with it; where it meets a surface, the surface's own error moves
the place along the ray (``LinearPlaces``). A laser's range to the photo's centre updates places of that
surface (``LaserResidual``). Errors of a pose that compensate one another in the image do so here too, as long
as the whole covariance is given: a place on the ground is known better than the camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene
from lodbench.errors import LodbenchError
from lodbench.geometry import Camera, Pose
from lodbench.geometry.angles import turning_axes
from lodbench.geometry.camera import camera_columns, pixel_rays
from lodbench.photos.xmp import LaserRange
from lodbench.rendering.surfaces import MAP_SIGMA_M, Hits, Surfaces

Floats = NDArray[np.float64]

# How well a pixel is pointed at, a standard deviation along each axis, pixels.
PIXEL_SIGMA_PX = 1.0
# 95 % of chi-square with two degrees of freedom: on a surface, and on the map.
CHI2_95 = 5.991464547107979


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """How well a pose, its camera and pixels are known: as of ``locate``.

    Raises:
        LodbenchError: The covariance is of another shape, not finite or no covariance, or the pixel's sigma
            is no positive number.
    """

    covariance: Floats | None
    parameters: tuple[str, ...] = ()
    pixel_sigma_px: float = PIXEL_SIGMA_PX

    def __post_init__(self) -> None:
        if not (math.isfinite(self.pixel_sigma_px) and self.pixel_sigma_px >= 0):
            raise LodbenchError(f"A pixel's sigma of {self.pixel_sigma_px} px is no length.")
        if self.covariance is None:
            return
        matrix, size = np.asarray(self.covariance, dtype=np.float64), 6 + len(self.parameters)
        if matrix.shape != (size, size):
            raise LodbenchError(
                f"The covariance is of shape {matrix.shape}, not {(size, size)}.",
                "Six rows are of the pose; further ones are named by parameters.",
            )
        if not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T, rtol=1e-6):
            raise LodbenchError("The covariance is not finite, or not symmetric.")
        if np.linalg.eigvalsh(matrix).min() < -1e-6 * np.abs(matrix).max():
            raise LodbenchError("The covariance has a negative eigenvalue.")


@dataclass(frozen=True, slots=True, eq=False)
class LinearPlaces:
    """N places as linear functions of errors: of pose and camera, of the pixel, of the surface."""

    hits: Hits  # what the rays meet
    rays: Floats  # (N, 3) directions in the scene's frame
    by_ray: Floats  # (N, 3, 6 + K) how points at these distances on the rays move with pose and camera
    by_ray_pixel: Floats  # (N, 3, 2) likewise with the pixel
    onto: Floats  # (N, 3, 3) projection along the ray onto the surface
    by_surface: Floats  # (N, 3) how the place moves with the surface along its normal

    @property
    def jacobian(self) -> Floats:
        """Returns (N, 3, 6 + K) how the places move with pose and camera."""
        return np.asarray(self.onto @ self.by_ray)

    def covariances(self, known: Uncertainty) -> Floats:
        """Returns (N, 3, 3) of the places."""
        assert known.covariance is not None  # noqa: S101 - the caller has looked
        jacobian, pixel = self.jacobian, self.onto @ self.by_ray_pixel
        surface = (self.hits.sigma_m[:, None] * self.by_surface)[:, :, None]
        spread = jacobian @ known.covariance @ jacobian.transpose(0, 2, 1)
        spread += known.pixel_sigma_px**2 * pixel @ pixel.transpose(0, 2, 1)
        return np.asarray(spread + surface @ surface.transpose(0, 2, 1))


def linearized_places(
    surfaces: Surfaces, camera: Camera, pose: Pose, pixels: Floats, parameters: Sequence[str] = ()
) -> LinearPlaces:
    """Returns the places that (N, 2) pixels show, and how they move; NaN for those that show none."""
    rays = pixel_rays(camera, pixels)
    world = rays.directions @ pose.rotation
    hits = surfaces.hit(pose.center, world)
    depths = ((hits.places - pose.center) @ pose.rotation[2])[:, None, None]
    axes = np.radians(turning_axes(pose.euler))  # per degree
    turned = np.cross(axes[None], world[:, None]).transpose(0, 2, 1)
    by_pixel = depths * (pose.rotation[:2].T @ rays.point_by_pixel)
    # A parameter that moves the image of a fixed ray moves the ray of a fixed pixel the other way.
    by_camera = -by_pixel @ camera_columns(camera, rays, parameters)
    by_center = np.broadcast_to(np.eye(3), (len(pixels), 3, 3))
    by_ray = np.concatenate([by_center, depths * turned, by_camera], axis=2)
    along = (hits.normals * world).sum(axis=1)[:, None]
    by_surface = world / along
    onto = np.eye(3) - by_surface[:, :, None] * hits.normals[:, None]
    return LinearPlaces(hits, world, by_ray, by_pixel, onto, by_surface)


# Two places of a pixel are compared with at least this standard deviation: surfaces of the ground bend.
_LEAST_M = 0.05


class GroundErrors(NamedTuple):
    """Places of N pixels by an estimated pose, against those by the true one."""

    distance_m: Floats  # (N,) between the two; NaN where either shows no place
    # (N,) whether the true one lies in the 95 % ellipse of the other, on its surface
    is_within: NDArray[np.bool_]
    surface: tuple[str, ...]  # N names of what the estimate has them on: roof, wall or ground; "" for nothing


def ground_errors(
    camera: Camera,
    pose: Pose,
    covariance: NDArray[np.float64],
    truth: Pose,
    surfaces: Surfaces,
    pixels: NDArray[np.float64],
    parameters: Sequence[str] = (),
    true_camera: Camera | None = None,
) -> GroundErrors:
    """Returns how far an estimate puts pixels from where the truth does.

    Map, ground and pixels are the same of both, so that the ellipse is of the pose alone.

    Args:
        camera: Of the estimate.
        pose: The estimate, in the scene's frame.
        covariance: (6 + K, 6 + K) of it, as of ``locate``.
        truth: The true pose, in the scene's frame.
        surfaces: The map.
        pixels: (N, 2).
        parameters: As of ``locate``.
        true_camera: Where it is another than ``camera``.
    """
    linear = linearized_places(surfaces, camera, pose, pixels, parameters)
    true_rays = pixel_rays(true_camera or camera, pixels).directions @ truth.rotation
    off = surfaces.hit(truth.center, true_rays).places - linear.hits.places
    known = Uncertainty(covariance, tuple(parameters))
    spread = linear.jacobian @ np.asarray(known.covariance) @ linear.jacobian.transpose(0, 2, 1)
    weighted = np.linalg.solve(np.nan_to_num(spread) + _LEAST_M**2 * np.eye(3), off[:, :, None])[:, :, 0]
    is_within = (off * weighted).sum(axis=1) <= CHI2_95
    return GroundErrors(np.linalg.norm(off, axis=1), is_within, linear.hits.kind)


# Correlation length of a surface's errors, metres; a range whose residual is more standard deviations than
# this was measured to something else.
_CORRELATION_M, MOST_SIGMAS = 30.0, 3.0


@dataclass(frozen=True, slots=True, eq=False)
class LaserResidual:
    """How a laser's range disagrees with a pose."""

    residual_m: float  # range to the surface at the pose, less the range measured
    # (6 + K,) of it by x, y, z (metres), pitch, roll, yaw (degrees) and the camera's parameters
    jacobian: Floats
    sigma_m: float  # standard deviation of the residual at the true pose: of the laser and the surface
    surface_m: float  # the surface's part, signed: how much farther it is for one sigma along its normal


def at_centre(surfaces: Surfaces, camera: Camera, pose: Pose, parameters: Sequence[str] = ()) -> LinearPlaces:
    """Returns the one place that the photo's centre shows, along whose ray a drone's laser measures.

    Args:
        surfaces: The map.
        camera: Of the photo.
        pose: In the scene's frame.
        parameters: As of ``locate``.
    """
    middle = np.array([[0.5 * camera.width, 0.5 * camera.height]])
    return linearized_places(surfaces, camera, pose, middle, parameters)


def laser_residual(centre: LinearPlaces, pose: Pose, laser: LaserRange) -> LaserResidual | None:
    """Returns how a range disagrees with a pose in the scene's frame; None where its ray meets nothing.

    Args:
        centre: Of that pose, from ``at_centre``.
        pose: In the scene's frame.
        laser: The range measured.
    """
    if not centre.hits.kind[0]:
        return None
    way = centre.hits.places[0] - pose.center
    ray = way / np.linalg.norm(way)
    jacobian = ray @ centre.jacobian[0]
    jacobian[:3] -= ray
    surface = float(centre.hits.sigma_m[0] * (ray @ centre.by_surface[0]))
    sigma = math.hypot(laser.sigma_m, surface)
    return LaserResidual(float(np.linalg.norm(way)) - laser.range_m, jacobian, sigma, surface)


def update_by_range(
    centre: LinearPlaces,
    pose: Pose,
    known: Uncertainty,
    laser: LaserRange,
    linear: LinearPlaces,
    places: Floats,
    covariances: Floats,
) -> list[str]:
    """Updates places on the surface that a range was measured to, in place, as a Kalman filter does.

    The range shares the pose's error with every place, and the surface's with places nearby.

    Args:
        centre: From ``at_centre``.
        pose: In the scene's frame.
        known: The pose's covariance, which must be there.
        laser: The range measured.
        linear: The N places before.
        places: (N, 3) those, scene frame.
        covariances: (N, 3, 3) of them, square metres.

    Returns:
        N sentences: why a range contradicts a place and was not used; "" where it does not.
    """
    residual, notes = laser_residual(centre, pose, laser), [""] * len(places)
    if residual is None:
        return notes
    assert known.covariance is not None  # noqa: S101 - the caller has looked
    pose_share = known.covariance @ residual.jacobian
    variance = float(residual.jacobian @ pose_share) + residual.sigma_m**2
    off = abs(residual.residual_m) / math.sqrt(variance)
    for row, kind in enumerate(linear.hits.kind):
        if not kind or not linear.hits.is_same(row, centre.hits, 0):
            continue
        if off > MOST_SIGMAS:
            expected = laser.range_m + residual.residual_m
            notes[row] = (
                f"the laser measured {laser.range_m:.1f} m to the photo's centre, map and pose say "
                f"{expected:.1f} m, {off:.1f} sigma apart: not used"
            )
            continue
        away = float(np.linalg.norm(linear.hits.places[row] - centre.hits.places[0]))
        common = math.exp(-away / _CORRELATION_M) * residual.surface_m * linear.hits.sigma_m[row]
        shared = linear.jacobian[row] @ pose_share + common * linear.by_surface[row]
        places[row] -= shared * residual.residual_m / variance
        covariances[row] -= np.outer(shared, shared) / variance
    return notes


# Rays on the 95 % ellipse around a pixel, for what else it may show.
_NUM_RAYS = 8


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
    located = places_of(surfaces, camera, pose.shifted(-scene.origin), pixels, uncertainty, laser)[0]
    if located is None:
        raise nowhere(pixels[0])
    return shifted(located, scene.origin)


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


def shifted(pixel: LocatedPixel, offset: Floats) -> LocatedPixel:
    """Returns a place moved by (3,) metres."""
    return LocatedPixel(
        pixel.place + offset, pixel.covariance, pixel.surface, pixel.building, pixel.beside, pixel.notes
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
    turns = np.linspace(0.0, 2.0 * np.pi, _NUM_RAYS, endpoint=False)
    reach = np.sqrt(CHI2_95 * np.maximum(values[:, None, 1:], 0.0))
    rim = (np.stack([np.cos(turns), np.sin(turns)], axis=1) * reach) @ axes[:, :, 1:].transpose(0, 2, 1)
    rays = linear.hits.places[rows][:, None] + rim - pose.center
    hits = surfaces.hit(pose.center, rays.reshape(-1, 3))
    names = [surfaces.name(hits, k) or "nothing" for k in range(len(hits.kind))]
    others: list[tuple[str, ...]] = [()] * len(linear.hits.kind)
    for k, row in enumerate(rows):
        near = dict.fromkeys(names[k * _NUM_RAYS : (k + 1) * _NUM_RAYS])
        others[row] = tuple(name for name in near if name != surfaces.name(linear.hits, row))
    return others
