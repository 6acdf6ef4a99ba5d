"""Between a city's coordinates and places on Earth: true north, ellipsoid heights, surveyors' terms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.crs import require_crs
from lodbench.errors import DatasetError
from lodbench.geometry import Pose
from lodbench.geometry.angles import look_covariance, look_from_rotation
from lodbench.geometry.similarity import grid_convergence_deg

if TYPE_CHECKING:
    from pyproj import Transformer

# WGS 84 as GPS receivers state it: two- and three-dimensional.
_WGS84, _WGS84_3D = "EPSG:4326", "EPSG:4979"


class GeoPose(NamedTuple):
    """Where a camera is and how it looks, in the terms people use."""

    latitude_deg: float  # WGS 84
    longitude_deg: float  # WGS 84
    height_m: float  # in the city's own heights
    heading_deg: float  # as of ``LookAngles``, from true north
    pitch_deg: float  # as of ``LookAngles``: -90 is straight down
    roll_deg: float  # as of ``LookAngles``: about the optical axis


class MapFrame:
    """The coordinates of a city with a known, projected reference system.

    Args:
        crs: As a scene states it: ``EPSG:25832+7837``.

    Raises:
        DatasetError: The system is not projected in metres.
    """

    def __init__(self, crs: str) -> None:
        self.crs = crs
        known = require_crs(crs)
        self._horizontal = known.horizontal
        self._has_heights = known.vertical_code is not None
        self._height_to_m = known.vertical_to_m
        if not self._horizontal.is_projected:
            raise DatasetError(f"{crs} has degrees, not metres.", "Name a projected system.")
        unit = self._horizontal.axis_info[0]
        if unit.unit_conversion_factor != 1.0:
            raise DatasetError(f"{crs} counts in {unit.unit_name}, not metres.", "Name a system in metres.")
        if known.counts_west:
            raise DatasetError(f"{crs} counts to the west and south.", "Name one to the east and north.")

    @cached_property
    def _to_map(self) -> Transformer:
        return _to_horizontal(self._horizontal.to_wkt())

    @property
    def accuracy_m(self) -> float | None:
        """How well the step from WGS 84 to the city's datum is known, metres; None where PROJ cannot say."""
        accuracy = float(self._to_map.accuracy)
        return accuracy if accuracy >= 0 else None

    def east_north(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Returns easting and northing, metres.

        Raises:
            DatasetError: The place cannot be projected.
        """
        east, north = self._to_map.transform(longitude_deg, latitude_deg)
        if not (math.isfinite(east) and math.isfinite(north)):
            raise DatasetError(
                f"The place {latitude_deg:.6f}, {longitude_deg:.6f} has no coordinates in {self.crs}.",
                "It is far from the city: is it the right tile? If so, `--crs` names another system.",
            )
        return float(east), float(north)

    def latitude_longitude(self, east: float, north: float) -> tuple[float, float]:
        """Returns latitude and longitude, degrees, WGS 84."""
        longitude, latitude = self._to_map.transform(east, north, direction="INVERSE")
        return float(latitude), float(longitude)

    def convergence_deg(self, east: float, north: float) -> float:
        """Returns the clockwise angle in degrees from true to grid north."""
        return grid_convergence_deg(self._horizontal.to_wkt(), east, north)

    def height_from_ellipsoid(self, latitude_deg: float, longitude_deg: float, ellipsoid_m: float) -> float:
        """Returns a height above the WGS 84 ellipsoid in the city's heights, which are read in metres.

        Raises:
            DatasetError: The city names no height system, or PROJ has no geoid model for it here: a
                height some fifty metres off is never passed on in silence.
        """
        from pyproj.exceptions import ProjError

        hint = (
            "Give `--geoid`, the geoid's height above the ellipsoid there, in metres; or let PROJ fetch the "
            "model: PROJ_NETWORK=ON."
        )
        if not self._has_heights:
            raise DatasetError(
                f"Heights above the ellipsoid cannot be turned into the city's: {self.crs} names no heights.",
                hint,
            )
        try:
            to_heights = _to_heights(self.crs)
            height = float(to_heights.transform(longitude_deg, latitude_deg, ellipsoid_m, errcheck=True)[2])
        except ProjError as error:
            raise DatasetError(
                f"PROJ has no geoid model here to turn ellipsoid heights into those of {self.crs}.", hint
            ) from error
        return height * self._height_to_m

    def place_of(self, pose: Pose) -> GeoPose:
        """Returns where a pose in the city's coordinates is on Earth, and where it looks."""
        east, north, height = (float(v) for v in pose.center)
        latitude, longitude = self.latitude_longitude(east, north)
        look = look_from_rotation(pose.rotation, self.convergence_deg(east, north))
        return GeoPose(latitude, longitude, height, *look)


# Kept for the process: PROJ looks a tenth of a second for the best of the ways between two systems.
@lru_cache(maxsize=16)
def _to_horizontal(wkt: str) -> Transformer:
    from pyproj import Transformer

    return Transformer.from_crs(_WGS84, wkt, always_xy=True)


@lru_cache(maxsize=16)
def _to_heights(crs: str) -> Transformer:
    from pyproj import Transformer

    return Transformer.from_crs(_WGS84_3D, crs, always_xy=True, only_best=True, allow_ballpark=False)


# Columns of a pose, and decimals that tables and maps keep: millimetres on the ground, 0.001 degrees.
POSE_DECIMALS = {
    "easting_m": 3,
    "northing_m": 3,
    "height_m": 3,
    "latitude_deg": 8,
    "longitude_deg": 8,
    "heading_deg": 3,
    "pitch_deg": 3,
    "roll_deg": 3,
}
SIGMA_COLUMNS = (
    "sigma_easting_m", "sigma_northing_m", "sigma_height_m", "sigma_heading_deg", "sigma_pitch_deg",
    "sigma_roll_deg",
)  # fmt: skip
SURVEY_COLUMNS = (*POSE_DECIMALS, *SIGMA_COLUMNS)


def survey_row(
    pose: Pose, place: GeoPose | None, covariance: Sequence[float] | NDArray[np.float64] | None = None
) -> dict[str, float | None]:
    """Returns ``SURVEY_COLUMNS`` of a pose, rounded; None for what is not known.

    Args:
        pose: In the city's coordinates, metres.
        place: Where that is on Earth; None for a local frame: the heading then counts from its y axis.
        covariance: (6, 6) of the error in x, y, z (metres), pitch, roll, yaw (degrees), or the 21 numbers on
            and above its diagonal, row by row; None or empty where it is not known.

    Heading, pitch and roll are those of ``LookAngles``, and so are their standard deviations.
    """
    values: tuple[float | None, ...] = (None, None, *look_from_rotation(pose.rotation))
    if place is not None:
        angles = place.heading_deg, place.pitch_deg, place.roll_deg
        values = (place.latitude_deg, place.longitude_deg, *angles)
    values = (*map(float, pose.center), *values)
    row: dict[str, float | None] = dict.fromkeys(SURVEY_COLUMNS)
    for (name, decimals), value in zip(POSE_DECIMALS.items(), values, strict=True):
        # Adding 0 turns the -0.0 of a rounded small number into 0.0.
        row[name] = None if value is None else round(value, decimals) + 0.0
    if row["heading_deg"] == 360.0:
        row["heading_deg"] = 0.0
    if covariance is not None and len(covariance):
        row |= dict(zip(SIGMA_COLUMNS, survey_sigmas(pose, covariance), strict=True))
    return row


def survey_sigmas(pose: Pose, covariance: Sequence[float] | NDArray[np.float64]) -> list[float]:
    """Returns the standard deviations of easting, northing, height (metres), heading, pitch, roll (degrees).

    Args:
        pose: In the city's coordinates.
        covariance: As of ``survey_row``, and known.
    """
    whole = np.asarray(covariance, np.float64)
    if whole.ndim == 1:
        rows, columns = np.triu_indices(6)
        whole = np.zeros((6, 6))
        whole[rows, columns] = whole[columns, rows] = covariance
    looks = look_covariance(pose.rotation, whole[3:, 3:])
    return [round(float(sigma), 4) for sigma in np.sqrt([*np.diagonal(whole)[:3], *np.diagonal(looks)])]
