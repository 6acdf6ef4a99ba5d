"""GeoJSON (RFC 7946) of cameras on a map: where each stands, a line the way it looks, what it shows.

Positions are longitude and latitude, WGS 84. Heights stay in the city's own system and so are a
property, not a third coordinate, which would mean heights above the ellipsoid.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.source import OWN_GEOJSON
from lodbench.datasets.exchange.survey import survey_row
from lodbench.geometry import Camera, Pose
from lodbench.photos.map_frame import MapFrame
from lodbench.storage import write_text

# A camera's line ends where the ray through the picture's middle is this much lower, or this far away.
_DROP_M, _REACH_M = 100.0, 150.0
# Points along each side of a footprint, and how far away its far side ends where it meets no ground.
_SIDE, _FURTHEST_M = 8, 600.0
# Latitudes and longitudes to about a millimetre.
_DIGITS = 8


def camera_feature(
    frame: MapFrame,
    pose: Pose,
    properties: Mapping[str, Any],
    covariance: Sequence[float] | NDArray[np.float64] | None = None,
) -> dict[str, Any]:
    """Returns a camera as a point feature, with ``SURVEY_COLUMNS`` that are known among the properties.

    Args:
        frame: The map's coordinates.
        pose: In these.
        properties: More of the feature's.
        covariance: As of ``survey_row``.
    """
    row = survey_row(pose, frame.place_of(pose), covariance)
    stated = {**properties, **{name: value for name, value in row.items() if value is not None}}
    point = [row["longitude_deg"], row["latitude_deg"]]
    return _feature({"type": "Point", "coordinates": point}, {**stated, "crs": frame.crs})


def view_feature(frame: MapFrame, pose: Pose, properties: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a line on the map from below the camera to where the middle of its picture points.

    The ray ends after 100 m of descent or 150 m of way along the ground, whichever is first.
    """
    center, ahead = pose.center, pose.rotation[2]
    along = max(float((ahead[0] ** 2 + ahead[1] ** 2) ** 0.5), 1e-9)
    length = min(_REACH_M / along, _DROP_M / max(-float(ahead[2]), 1e-9))
    ends = [center, center + length * ahead]
    line = []
    for east, north in ((float(point[0]), float(point[1])) for point in ends):
        latitude, longitude = frame.latitude_longitude(east, north)
        line.append([round(longitude, _DIGITS), round(latitude, _DIGITS)])
    return _feature({"type": "LineString", "coordinates": line}, {**properties, "kind": "view"})


def footprint_feature(
    frame: MapFrame, camera: Camera, pose: Pose, ground_m: float, properties: Mapping[str, Any]
) -> dict[str, Any] | None:
    """Returns the part of a level ground that a picture shows, as a polygon; None if it shows none.

    Args:
        frame: The map's coordinates.
        camera: Pinhole of the picture.
        pose: In the map's coordinates.
        ground_m: Height of the ground, in the city's heights.
        properties: Of the feature.

    Beyond 600 m, and above the horizon, it is cut off at 600 m.
    """
    height = float(pose.center[2]) - ground_m
    if height <= 0:
        return None
    steps = np.arange(_SIDE) / _SIDE
    corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], float)
    ends = np.roll(corners, -1, axis=0)
    pixels = (corners[:, None] + steps[None, :, None] * (ends - corners)[:, None]).reshape(-1, 2)
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    rays = np.column_stack([(pixels - middle) / focal, np.ones(len(pixels))]) @ pose.rotation
    if (rays[:, 2] >= 0).all():
        return None
    # Up to the horizon and above it a ray goes on, over the ground, to where it is cut off.
    along = np.linalg.norm(rays[:, :2], axis=1)
    falls = np.minimum(rays[:, 2], -1e-9)
    reach = np.where(rays[:, 2] < 0, height / -falls, np.inf)
    reach = np.minimum(reach, _FURTHEST_M / np.maximum(along, 1e-9))
    ground = pose.center[:2] + rays[:, :2] * reach[:, None]
    ring = []
    # Counter-clockwise, as RFC 7946 wants outer rings.
    for east, north in ground if _area(ground) > 0 else ground[::-1]:
        latitude, longitude = frame.latitude_longitude(float(east), float(north))
        ring.append([round(longitude, _DIGITS), round(latitude, _DIGITS)])
    stated = {**properties, "kind": "footprint", "ground_m": round(ground_m, 3)}
    return _feature({"type": "Polygon", "coordinates": [[*ring, ring[0]]]}, stated)


def _area(ring: NDArray[np.float64]) -> float:
    """Returns the signed area of a polygon, positive if it runs counter-clockwise."""
    x, y = ring.T
    return float(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def nowhere_feature(properties: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a feature without a place: a photo that was not found."""
    return _feature(None, properties)


def write_geojson(features: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Writes a feature collection, which is never taken for a city where it lies among tiles."""
    values = {**OWN_GEOJSON, "features": list(features)}
    write_text(path, json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def _feature(geometry: dict[str, Any] | None, properties: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": dict(properties)}
