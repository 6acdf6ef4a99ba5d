"""Pixels and regions of a localised photo on the map: as GeoJSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.polygon import orient

from lodbench.citymap.places import (
    PIXEL_SIGMA_PX,
    Ellipse,
    LocatedPixel,
    Uncertainty,
    nowhere,
    places_of,
    require_pixels,
    shifted,
)
from lodbench.citymodel.options import ReadOptions
from lodbench.datasets.exchange.geojson import write_geojson
from lodbench.errors import DatasetError
from lodbench.execution import Progress
from lodbench.geometry import Camera
from lodbench.harness.city import open_city
from lodbench.harness.photo.localized import Localized, read_localized
from lodbench.harness.photo.outputs import on_earth
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.metadata import read_photo_metadata
from lodbench.rendering.surfaces import MAP_SIGMA_M, Surfaces
from lodbench.segmentation import check_mask
from lodbench.segmentation.masks import MaskPolygon, polygons_of, read_mask
from lodbench.storage.json_text import parse_json

Floats = NDArray[np.float64]

# Sides of regions are cut to this share of the photo's width, that they follow the surfaces they cross;
# corners nearer than this to a straight line are left out on the map, metres.
_SIDE, _STRAIGHT_M = 0.02, 0.02
# A mask's pixels are halved, so that outlines through their middles pass nearer to the true ones.
_FINER = 2
# Of a feature: what it is called, by which an earlier file is known.
_KIND = "located"


@dataclass(frozen=True, slots=True, eq=False)
class PlacedFeature:
    """A pixel or a region on the map."""

    name: str  # of it: ``812 604``, or ``region 1``
    pixel: Floats  # (2,) the pixel, or the region's inner point
    point: LocatedPixel  # its place, in the city's coordinates
    outline: shapely.Geometry | None = None  # of a region, east and north; None for a pixel
    heights_m: tuple[float, float] | None = None  # lowest and highest of the outline
    shows: tuple[str, ...] = ()  # all that it shows


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
                {**_properties(each, self.frame, self.localized), **earth_of(each.point, self.frame)}
                for each in self.features
            ],
            "map": None if self.map is None else str(self.map),
            "notes": list(self.notes),
        }


def earth_of(point: LocatedPixel, frame: MapFrame | None) -> dict[str, float]:
    """Returns latitude and longitude, WGS 84; nothing without a frame."""
    if frame is None:
        return {}
    latitude, longitude = frame.latitude_longitude(float(point.place[0]), float(point.place[1]))
    return {"latitude_deg": latitude, "longitude_deg": longitude}


def true_ellipse(point: LocatedPixel, frame: MapFrame | None) -> Ellipse | None:
    """Returns the 95 % ellipse, its bearing from true north where a frame says where that is."""
    ellipse = point.ellipse
    if ellipse is None or frame is None:
        return ellipse
    turn = frame.convergence_deg(float(point.place[0]), float(point.place[1]))
    return ellipse._replace(bearing_deg=(ellipse.bearing_deg + turn) % 180.0)


def _properties(each: PlacedFeature, frame: MapFrame | None, localized: Localized) -> dict[str, Any]:
    point, ellipse = each.point, true_ellipse(each.point, frame)
    east, north, height = (round(float(value), 3) for value in point.place)
    values: dict[str, Any] = {
        "kind": _KIND,
        "name": each.name,
        "pixel": [round(float(value), 2) for value in each.pixel],
        "surface": point.surface,
        "building": point.building,
        "shows": list(each.shows),
        "east": east,
        "north": north,
        "height_m": height,
        "crs": localized.crs,
        "trust": localized.trust,
    }
    if point.covariance is not None and ellipse is not None:
        values |= {
            "covariance_m2": point.covariance.round(6).tolist(),
            "height_sigma_m": round(float(np.sqrt(point.covariance[2, 2])), 3),
            "ellipse95_major_m": round(ellipse.major_m, 3),
            "ellipse95_minor_m": round(ellipse.minor_m, 3),
            "ellipse95_bearing_deg": round(ellipse.bearing_deg, 2),
        }
    if each.outline is not None and each.heights_m is not None:
        values |= {"area_m2": round(each.outline.area, 3)}
        values |= dict(zip(("lowest_m", "highest_m"), (round(v, 3) for v in each.heights_m), strict=True))
    return {**values, "beside": list(point.beside), "notes": list(point.notes)}


def _feature(each: PlacedFeature, frame: MapFrame, localized: Localized) -> dict[str, Any]:
    """Returns a feature: a point, or the polygons of a region; a point where it has no area on the map."""
    parts = getattr(each.outline, "geoms", [each.outline])
    shapes = [part for part in parts if isinstance(part, shapely.Polygon) and part.area > 0]
    if shapes:
        rings = [
            [on_earth(np.array(ring.coords), frame) for ring in (shape.exterior, *shape.interiors)]
            for shape in map(orient, shapes)
        ]
        geometry: dict[str, Any] = {"type": "MultiPolygon", "coordinates": rings}
        if len(rings) == 1:
            geometry = {"type": "Polygon", "coordinates": rings[0]}
    else:
        geometry = {"type": "Point", "coordinates": on_earth(each.point.place[None, :2], frame)[0]}
    return {"type": "Feature", "geometry": geometry, "properties": _properties(each, frame, localized)}


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacesRequest:
    """What to place."""

    photo: Path  # the photo, as it was localised
    found: Path  # folder that ``localize`` wrote
    city: Path  # city model
    pixels: Sequence[tuple[float, float]] = ()  # columns and rows, in the photo as stored
    mask: Path | None = None  # its white regions are placed; None for none
    out: Path | None = None  # GeoJSON to write; None for a file in ``found``
    lod: str | None = None  # level of detail, or None for the lowest
    options: ReadOptions = field(default_factory=ReadOptions)  # how to read the city
    roof_height: str | None = None  # rule by which an absent level 1 is derived, or None
    pixel_sigma_px: float = PIXEL_SIGMA_PX  # as of ``locate``; so are the other sigmas
    map_sigma_m: float = MAP_SIGMA_M  # see there
    ground_sigma_m: float | None = None  # see there


def place_photo(request: PlacesRequest) -> PlacedPhoto:
    """Returns the places of pixels and regions, and writes them as GeoJSON.

    Raises:
        LodbenchError: The photo was not localised, the city is another or cannot be read, a pixel is outside
            the photo or shows no place, or the mask is no mask of it.
    """
    localized = read_localized(request.photo, request.found)
    stated = read_photo_metadata(request.photo)
    pixels = np.array(request.pixels, dtype=np.float64).reshape(-1, 2)
    require_pixels(localized.camera, pixels)
    regions = [] if request.mask is None else _regions(request.mask, localized.camera)
    scene = open_city(request.city, request.lod, request.options, request.roof_height).scene
    if scene.crs != localized.crs:
        raise DatasetError(
            f"{request.city.name} is in {scene.crs or 'no reference system'}, the photo was localised in "
            f"{localized.crs or 'none'}.",
            "Give the `--city`, and the `--crs`, that it was localised with.",
        )
    frame = None if scene.crs is None else MapFrame(scene.crs)
    out = request.out or localized.file.with_name(f"{localized.file.stem}_places.geojson")
    _require_own(out)
    placer = _Placer(
        Surfaces(scene, request.map_sigma_m, request.ground_sigma_m),
        localized,
        Uncertainty(localized.covariance, pixel_sigma_px=request.pixel_sigma_px),
        None if localized.is_laser_used else stated.laser,
    )
    features = placer.pixels(pixels)
    notes = _notes(localized, stated.orientation, frame)
    with Progress("regions", len(regions)) as progress:
        for number, region in enumerate(regions, start=1):
            placed = placer.region(f"region {number}", region)
            features += [] if placed is None else [placed]
            notes += [f"region {number} reaches the sky: left out"] if placed is None else []
            progress.advance()
    if not features:
        raise DatasetError(f"All of {request.mask} shows the sky.", "Is it a mask of this photo?")
    if frame is not None:
        write_geojson([_feature(each, frame, localized) for each in features], out)
    return PlacedPhoto(localized, tuple(features), frame, None if frame is None else out, tuple(notes))


@dataclass(frozen=True, slots=True, eq=False)
class _Placer:
    surfaces: Surfaces
    localized: Localized
    known: Uncertainty
    laser: Any

    def _places(self, pixels: Floats, known: Uncertainty | None = None) -> list[LocatedPixel | None]:
        origin, where = self.surfaces.scene.origin, self.localized
        pose = where.pose.shifted(-origin)
        points = places_of(self.surfaces, where.camera, pose, pixels, known or self.known, self.laser)
        return [None if each is None else shifted(each, origin) for each in points]

    def pixels(self, pixels: Floats) -> list[PlacedFeature]:
        """Returns the places of (N, 2) pixels.

        Raises:
            LodbenchError: One shows no place.
        """
        features = []
        for pixel, point in zip(pixels, self._places(pixels), strict=True):
            if point is None:
                raise nowhere(pixel)
            features.append(PlacedFeature(f"{pixel[0]:g} {pixel[1]:g}", pixel, point, shows=(point.shows,)))
        return features

    def region(self, name: str, region: shapely.Polygon) -> PlacedFeature | None:
        """Returns a region of the photo on the map; None where it reaches the sky."""
        inner = np.array(region.representative_point().coords)
        middle = self._places(inner)[0]
        outline = [self._ring(ring) for ring in (region.exterior, *region.interiors)]
        rings = [ring for ring in outline if ring is not None]
        if middle is None or len(rings) < len(outline):
            return None
        corners = [each for ring in rings for each in ring]
        heights = [float(each.place[2]) for each in corners]
        shell, *holes = (np.array([corner.place[:2] for corner in ring]) for ring in rings)
        shape = shapely.make_valid(shapely.Polygon(shell, holes).simplify(_STRAIGHT_M))
        shows = tuple(dict.fromkeys([middle.shows, *(each.shows for each in corners)]))
        return PlacedFeature(name, inner[0], middle, shape, (min(heights), max(heights)), shows)

    def _ring(self, ring: shapely.LinearRing) -> list[LocatedPixel] | None:
        points = self._places(np.array(ring.coords), Uncertainty(None))
        places = [each for each in points if each is not None]
        return places if len(places) == len(points) else None


def _regions(path: Path, camera: Camera) -> list[shapely.Polygon]:
    """Returns the connected regions of a mask as polygons of the photo's pixels, largest first."""
    mask = check_mask(read_mask(path), camera) >= 0.5
    finer = mask.repeat(_FINER, axis=0).repeat(_FINER, axis=1)
    scale = np.array([camera.width, camera.height]) / finer.shape[::-1]
    regions = [_polygon(part, scale, _SIDE * camera.width) for part in polygons_of(finer)]
    if not regions:
        raise DatasetError(f"The mask {path} is black.", "White is what is to be placed.")
    return regions


def _polygon(part: MaskPolygon, scale: Floats, side_px: float) -> shapely.Polygon:
    outer, *holes = ((_simple(ring) + 0.5) * scale for ring in (part.outer, *part.holes))
    return shapely.segmentize(shapely.Polygon(outer, holes), side_px)


def _simple(ring: NDArray[np.int32]) -> NDArray[Any]:
    """Returns a ring of pixels without the steps of slanted sides, where that leaves one."""
    simple = np.asarray(cv2.approxPolyDP(ring[:, None], 1.0, True))[:, 0]
    return simple if len(simple) > 2 else ring


def _require_own(path: Path) -> None:
    """Makes sure that no other program's file is replaced."""
    try:
        features = parse_json(path.read_text(encoding="utf-8"))["features"]
        is_own = all(each["properties"]["kind"] == _KIND for each in features)
    except FileNotFoundError:
        return
    except (OSError, ValueError, KeyError, TypeError):
        is_own = False
    if not is_own:
        raise DatasetError(f"{path} is another file and would be written over.", "Name another: `--out FILE`")


def _notes(localized: Localized, orientation: int, frame: MapFrame | None) -> list[str]:
    notes = []
    if not localized.is_trusted:
        notes.append(f"the photo's pose is unreliable ({localized.file}), and so are these places")
    if localized.covariance is None:
        notes.append("the method that localised the photo states no covariance: nor is there one here")
    if orientation > 1:
        notes.append("EXIF rotates this photo for display: pixels refer to it as stored")
    if frame is None:
        notes.append("the city names no reference system: no GeoJSON was written (--crs names it)")
    return notes
