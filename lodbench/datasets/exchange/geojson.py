"""GeoJSON (RFC 7946) of cameras on a map: where each stands, and a line the way it looks.

Positions are longitude and latitude, WGS 84. Heights stay in the city's own system and so are a
property, not a third coordinate, which would mean heights above the ellipsoid.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lodbench.datasets.map_frame import MapFrame
from lodbench.geometry import Pose
from lodbench.storage import write_text

# A camera's line ends where the ray through the picture's middle is this much lower, or this far away.
_DROP_M, _REACH_M = 100.0, 150.0
# Latitudes and longitudes to about a millimetre.
_DIGITS = 8


def camera_feature(frame: MapFrame, pose: Pose, properties: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a camera as a point feature: its place, heights and angles among the properties."""
    place = frame.place_of(pose)
    stated = {
        **properties,
        "height_m": round(place.height_m, 3),
        "heading_deg": round(place.heading_deg, 3),
        "pitch_deg": round(place.pitch_deg, 3),
        "roll_deg": round(place.roll_deg, 3),
        "crs": frame.crs,
    }
    point = [round(place.longitude_deg, _DIGITS), round(place.latitude_deg, _DIGITS)]
    return _feature({"type": "Point", "coordinates": point}, stated)


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


def nowhere_feature(properties: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a feature without a place: a photo that was not found."""
    return _feature(None, properties)


def write_geojson(features: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Writes a feature collection."""
    values = {"type": "FeatureCollection", "features": list(features)}
    write_text(path, json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def _feature(geometry: dict[str, Any] | None, properties: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": dict(properties)}
