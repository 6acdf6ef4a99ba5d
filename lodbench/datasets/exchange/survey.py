"""A pose in a surveyor's terms: coordinates, angles and their standard deviations, as columns of a table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import Pose
from lodbench.geometry.looking import look_covariance, look_from_rotation
from lodbench.photos.map_frame import Place

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
    pose: Pose, place: Place | None, covariance: Sequence[float] | NDArray[np.float64] | None = None
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
