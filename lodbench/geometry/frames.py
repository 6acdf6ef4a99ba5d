"""Frames: shifted earth-centred coordinates into east-north-up, and grid convergence."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry.pose import Pose

Matrix = NDArray[np.float64]


def enu_from_ecef_rotation(lat_deg: float, lon_deg: float) -> Matrix:
    """Returns the (3, 3) rotation whose rows are east, north and up at a geodetic position."""
    phi, lam = math.radians(lat_deg), math.radians(lon_deg)
    sp, cp, sl, cl = math.sin(phi), math.cos(phi), math.sin(lam), math.cos(lam)
    return np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])


@dataclass(frozen=True, slots=True)
class ShiftedEcef:
    """ECEF coordinates minus those of an origin: metric, but with the earth's axis as z.

    Attributes:
        lat_deg: Geodetic latitude of the origin.
        lon_deg: Longitude of the origin.
    """

    lat_deg: float
    lon_deg: float

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
