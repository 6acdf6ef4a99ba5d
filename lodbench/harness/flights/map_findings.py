"""The map's errors that flights show, as outlines of buildings: for GeoJSON and for pages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shapely import Polygon, polygons, union_all
from shapely.geometry.polygon import orient

from lodbench.citymodel.scene import Scene
from lodbench.datasets.map_frame import MapFrame
from lodbench.reporting.flight_words import doubted_buildings

# Digits of a degree, a millimetre or so; triangles smaller than this from above are walls, square metres; and
# points nearer than this are one, metres.
_DIGITS, _LEAST_M2, _SAME_M = 8, 1e-3, 0.01


def building_outline(scene: Scene, building: int) -> list[list[NDArray[np.float64]]]:
    """Returns the polygons of a building seen from above, each its rings, the outer one first.

    Rings are (N, 2) east and north in the city's coordinates; the outer one runs counter-clockwise.
    """
    rows = slice(scene.triangle_starts[building], scene.triangle_starts[building + 1])
    corners = scene.vertices[scene.triangles[rows]].astype(np.float64)[:, :, :2] + scene.origin[:2]
    sides = corners[:, 1:] - corners[:, :1]
    doubled = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
    whole = union_all(polygons(corners[np.abs(doubled) > _LEAST_M2]), grid_size=_SAME_M)
    parts = [orient(part) for part in getattr(whole, "geoms", [whole]) if isinstance(part, Polygon)]
    return [
        [np.array(ring.coords) for ring in (part.exterior, *part.interiors)]
        for part in parts
        if not part.is_empty
    ]


def doubt_features(
    scene: Scene, frame: MapFrame, buildings: Sequence[Mapping[str, Any]], flight: str
) -> list[dict[str, Any]]:
    """Returns the buildings whose height a flight contradicts, as features of GeoJSON, the surest first.

    Args:
        scene: The map.
        frame: Its coordinates on Earth.
        buildings: As a flight's findings have them.
        flight: Its name.
    """
    rows = {name: row for row, name in enumerate(scene.building_ids)}
    features = []
    for each in doubted_buildings(buildings):
        outline = building_outline(scene, rows[each["id"]])
        geometry = {
            "type": "MultiPolygon",
            "coordinates": [[_on_earth(ring, frame) for ring in rings] for rings in outline],
        }
        stated = {"kind": "building in doubt", "flight": flight, **each}
        features.append({"type": "Feature", "geometry": geometry, "properties": stated})
    return features


def city_and_doubts(
    scene: Scene, findings: Mapping[str, Any]
) -> tuple[tuple[NDArray[np.float64], NDArray[np.int32]], dict[str, list[NDArray[np.float64]]]]:
    """Returns the city in its coordinates, and the rings of the buildings in doubt."""
    rows = {name: row for row, name in enumerate(scene.building_ids)}
    doubted = [each["id"] for each in doubted_buildings(findings.get("buildings", [])) if each["id"] in rows]
    outlines = {
        name: [ring for rings in building_outline(scene, rows[name]) for ring in rings] for name in doubted
    }
    return (scene.vertices + scene.origin, scene.triangles), outlines


def _on_earth(ring: NDArray[np.float64], frame: MapFrame) -> list[list[float]]:
    places = [frame.latitude_longitude(float(east), float(north)) for east, north in ring]
    return [[round(longitude, _DIGITS), round(latitude, _DIGITS)] for latitude, longitude in places]
