"""What placing pixels and regions of a photo gives: plain values, and GeoJSON."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.polygon import orient

from lodbench.citymap.places import Ellipse, LocatedPixel
from lodbench.datasets.exchange.geojson import write_geojson
from lodbench.geometry import Camera, Pose
from lodbench.photos.map_frame import MapFrame

Floats = NDArray[np.float64]

# Of a feature: what it is called, by which an earlier file is known.
KIND = "located"
_DIGITS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Localized:
    """What ``localize`` wrote of a photo.

    Attributes:
        file: The JSON file.
        camera: Of the photo as stored.
        pose: In the city's coordinates.
        covariance: (6, 6), or None.
        crs: Of the city, or None.
        is_trusted: Whether the pose is more likely right than wrong.
        trust: In a word.
        is_laser_used: Whether pose and covariance include a laser's range.
    """

    file: Path
    camera: Camera
    pose: Pose
    covariance: Floats | None
    crs: str | None
    is_trusted: bool
    trust: str
    is_laser_used: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class PlacedFeature:
    """A pixel or a region on the map.

    Attributes:
        name: Of it: ``812 604``, or ``region 1``.
        pixel: (2,) the pixel, or the region's inner point.
        found: Its place, in the city's coordinates.
        outline: Of a region, east and north; None for a pixel.
        heights_m: Lowest and highest of the outline.
        shows: All that it shows.
    """

    name: str
    pixel: Floats
    found: LocatedPixel
    outline: shapely.Geometry | None = None
    heights_m: tuple[float, float] | None = None
    shows: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class PlacedPhoto:
    """Pixels and regions of a photo on the map; ``map`` is the file written, None without a CRS."""

    localized: Localized
    features: tuple[PlacedFeature, ...]
    frame: MapFrame | None
    map: Path | None
    notes: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Returns plain values for JSON, units in the names."""
        return {
            "localized": str(self.localized.file),
            "trusted": self.localized.is_trusted,
            "crs": self.localized.crs,
            "places": [
                {**_properties(each, self.frame, self.localized), **earth_of(each.found, self.frame)}
                for each in self.features
            ],
            "map": None if self.map is None else str(self.map),
            "notes": list(self.notes),
        }


def write_places(
    features: Sequence[PlacedFeature], frame: MapFrame, localized: Localized, path: Path
) -> None:
    """Writes places as points and polygons of GeoJSON."""
    write_geojson([_feature(each, frame, localized) for each in features], path)


def earth_of(found: LocatedPixel, frame: MapFrame | None) -> dict[str, float]:
    """Returns latitude and longitude, WGS 84; nothing without a frame."""
    if frame is None:
        return {}
    latitude, longitude = frame.latitude_longitude(float(found.place[0]), float(found.place[1]))
    return {"latitude_deg": latitude, "longitude_deg": longitude}


def true_ellipse(found: LocatedPixel, frame: MapFrame | None) -> Ellipse | None:
    """Returns the 95 % ellipse, its bearing from true north where a frame says where that is."""
    ellipse = found.ellipse
    if ellipse is None or frame is None:
        return ellipse
    turn = frame.convergence_deg(float(found.place[0]), float(found.place[1]))
    return ellipse._replace(bearing_deg=(ellipse.bearing_deg + turn) % 180.0)


def _properties(each: PlacedFeature, frame: MapFrame | None, localized: Localized) -> dict[str, Any]:
    found, ellipse = each.found, true_ellipse(each.found, frame)
    east, north, height = (round(float(value), 3) for value in found.place)
    values: dict[str, Any] = {
        "kind": KIND,
        "name": each.name,
        "pixel": [round(float(value), 2) for value in each.pixel],
        "surface": found.surface,
        "building": found.building,
        "shows": list(each.shows),
        "east": east,
        "north": north,
        "height_m": height,
        "crs": localized.crs,
        "trust": localized.trust,
    }
    if found.covariance is not None and ellipse is not None:
        values |= {
            "covariance_m2": found.covariance.round(6).tolist(),
            "height_sigma_m": round(float(np.sqrt(found.covariance[2, 2])), 3),
            "ellipse95_major_m": round(ellipse.major_m, 3),
            "ellipse95_minor_m": round(ellipse.minor_m, 3),
            "ellipse95_bearing_deg": round(ellipse.bearing_deg, 2),
        }
    if each.outline is not None and each.heights_m is not None:
        values |= {"area_m2": round(each.outline.area, 3)}
        values |= dict(zip(("lowest_m", "highest_m"), (round(v, 3) for v in each.heights_m), strict=True))
    return {**values, "beside": list(found.beside), "notes": list(found.notes)}


def _feature(each: PlacedFeature, frame: MapFrame, localized: Localized) -> dict[str, Any]:
    """Returns a feature: a point, or the polygons of a region; a point where it has no area on the map."""
    shapes = [] if each.outline is None else list(_polygons(each.outline))
    if shapes:
        rings = [
            [_on_earth(np.array(ring.coords), frame) for ring in (shape.exterior, *shape.interiors)]
            for shape in map(orient, shapes)
        ]
        geometry: dict[str, Any] = {"type": "MultiPolygon", "coordinates": rings}
        if len(rings) == 1:
            geometry = {"type": "Polygon", "coordinates": rings[0]}
    else:
        geometry = {"type": "Point", "coordinates": _on_earth(each.found.place[None, :2], frame)[0]}
    return {"type": "Feature", "geometry": geometry, "properties": _properties(each, frame, localized)}


def _polygons(shape: shapely.Geometry) -> Iterable[shapely.Polygon]:
    for part in getattr(shape, "geoms", [shape]):
        if isinstance(part, shapely.Polygon) and part.area > 0:
            yield part


def _on_earth(points: Floats, frame: MapFrame) -> list[list[float]]:
    places = [frame.latitude_longitude(float(east), float(north)) for east, north in points]
    return [[round(longitude, _DIGITS), round(latitude, _DIGITS)] for latitude, longitude in places]
