"""Similarities between frames, shifted earth-centred coordinates into east-north-up, grid convergence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import LodbenchError
from lodbench.geometry.pose import Pose

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]

# Poses that a similarity is fitted to: one alone has no scale, two leave a turn open to chance.
FEWEST_POSES = 3
# Beyond so many standard deviations a pose counts less and less.
_OUTLIER_SIGMAS = 2.0
# Poses nearer than this share of their coordinates are in one place: rounding.
_SAME_PLACE = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """``x_map = scale * rotation @ x + translation``."""

    scale: float  # map metres per unit
    rotation: Floats  # (3, 3), determinant +1
    translation: Floats  # (3,) map metres

    def points(self, points: Floats) -> Floats:
        """Returns (N, 3) points in the map."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    def pose(self, pose: Pose) -> Pose:
        """Returns a camera's pose in the map, metres."""
        return Pose.from_center(pose.rotation @ self.rotation.T, self.points(pose.center[None])[0])


@dataclass(frozen=True, slots=True, eq=False)
class FittedSimilarity:
    """A similarity that lays poses on others."""

    similarity: Similarity  # it
    middle: Floats  # (3,) of the poses it was fitted to, map metres
    # (7,) standard deviations: shift of the middle (metres), turn about the map's axes (degrees), scale (as a
    # share)
    sigmas: Floats
    covariance: Floats  # (7, 7) of the same numbers
    distances_m: Floats  # (N,) how far each pose then is from its own


def fit_similarity(
    poses: Sequence[Pose], mapped: Sequence[Pose], sigma_m: Floats, sigma_deg: Floats
) -> FittedSimilarity:
    """Returns the similarity that lays poses on others; some of these may be far off.

    Both places and directions count, so that a straight flight leaves no turn open. The start is the mean of
    the turns and the median of distances; the rest is robust least squares (soft L1).

    Args:
        poses: In a frame of their own.
        mapped: Of the same cameras in the map.
        sigma_m: (N, 3) standard deviations of ``mapped``: east, north, up, metres.
        sigma_deg: (N,) of its directions, degrees.

    Raises:
        LodbenchError: There are fewer than three poses, or all are in one place.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    if len(poses) < FEWEST_POSES:
        raise LodbenchError(f"A similarity needs at least {FEWEST_POSES} cameras, not {len(poses)}.")
    centers, there = (np.array([pose.center for pose in each]) for each in (poses, mapped))
    pairs = zip(poses, mapped, strict=True)
    turns = Rotation.from_matrix([other.rotation.T @ one.rotation for one, other in pairs])
    turn = _robust_mean(turns)
    middle, own_middle = np.median(there, axis=0), np.median(centers, axis=0)
    reach, own_reach = (
        float(np.median(np.linalg.norm(p - m, axis=1))) for p, m in ((there, middle), (centers, own_middle))
    )
    least = _SAME_PLACE * (1.0 + float(np.abs([middle, own_middle]).max()))
    if min(reach, own_reach) <= least:
        raise LodbenchError(
            "All cameras are in one place, which leaves the scale open.",
            "Take a reconstruction of photos from several places.",
        )
    scale = reach / own_reach

    def residuals(numbers: Floats) -> Floats:
        now = Rotation.from_rotvec(numbers[3:6]) * turn
        places = scale * np.exp(numbers[6]) * now.apply(centers - own_middle) + middle + reach * numbers[:3]
        gaps = (now * turns.inv()).as_rotvec(degrees=True)
        return np.concatenate([((places - there) / sigma_m).ravel(), (gaps / sigma_deg[:, None]).ravel()])

    solution = least_squares(residuals, np.zeros(7), loss="soft_l1", f_scale=_OUTLIER_SIGMAS)
    turn = Rotation.from_rotvec(solution.x[3:6]) * turn
    scale *= float(np.exp(solution.x[6]))
    shift = middle + reach * solution.x[:3] - scale * turn.apply(own_middle)
    similarity = Similarity(scale, turn.as_matrix(), shift)
    units = np.array([reach] * 3 + [np.degrees(1.0)] * 3 + [1.0])
    covariance = np.linalg.pinv(solution.jac.T @ solution.jac)
    sigmas = np.sqrt(np.diagonal(covariance)) * units
    distances = np.linalg.norm(similarity.points(centers) - there, axis=1)
    middle, covariance = similarity.points(own_middle[None])[0], covariance * np.outer(units, units)
    return FittedSimilarity(similarity, middle, sigmas, covariance, distances)


def _robust_mean(turns: Rotation) -> Rotation:
    """Returns the mean of turns without those that are far from most."""
    weights = np.ones(len(turns))
    mean = turns.mean()
    for _ in range(10):
        away = (turns * mean.inv()).magnitude()
        weights = 1.0 / (1.0 + (away / max(float(np.median(away)), 1e-9)) ** 2) ** 2
        mean = turns.mean(weights)
    return mean


Matrix = NDArray[np.float64]


def enu_from_ecef_rotation(lat_deg: float, lon_deg: float) -> Matrix:
    """Returns the (3, 3) rotation whose rows are east, north and up at a geodetic position."""
    phi, lam = math.radians(lat_deg), math.radians(lon_deg)
    sp, cp, sl, cl = math.sin(phi), math.cos(phi), math.sin(lam), math.cos(lam)
    return np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])


@dataclass(frozen=True, slots=True)
class ShiftedEcef:
    """ECEF coordinates minus those of an origin: metric, but with the earth's axis as z."""

    lat_deg: float  # geodetic latitude of the origin
    lon_deg: float  # longitude of the origin

    def points_to_enu(self, points: Matrix) -> Matrix:
        """Returns (N, 3) points, metres, turned to east-north-up at the origin."""
        return np.asarray(points @ enu_from_ecef_rotation(self.lat_deg, self.lon_deg).T)

    def pose_to_enu(self, pose: Pose) -> Pose:
        """Returns the pose with its world turned to east-north-up at the origin."""
        rotation = enu_from_ecef_rotation(self.lat_deg, self.lon_deg)
        return Pose(np.asarray(pose.rotation @ rotation.T), pose.translation)


# The origin of the published Swiss-EPFL files.
SWISS_EPFL_FRAME = ShiftedEcef(lat_deg=46.5191, lon_deg=6.5668)


def grid_convergence_deg(crs: str, easting: float, northing: float) -> float:
    """Returns the clockwise angle in degrees from true to grid north at a point of a projected CRS.

    A grid heading is the true heading minus this angle.
    """
    from pyproj import CRS, Proj, Transformer

    projected = CRS.from_user_input(crs)
    geodetic = projected.geodetic_crs or projected
    lon, lat = Transformer.from_crs(projected, geodetic, always_xy=True).transform(easting, northing)
    # France, Tunis and Madagascar counted in grads from Paris; PROJ takes degrees, from there too.
    unit_deg = math.degrees(geodetic.axis_info[0].unit_conversion_factor)
    return float(Proj(projected).get_factors(lon * unit_deg, lat * unit_deg).meridian_convergence)
