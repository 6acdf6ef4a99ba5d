"""The map's errors that flights show, as outlines of buildings: for GeoJSON and for pages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shapely import Polygon, polygons, union_all
from shapely.geometry.polygon import orient

from lodbench.citymodel.scene import Scene
from lodbench.photos.map_frame import MapFrame
from lodbench.reporting.flight_words import doubted_buildings, map_rows
from lodbench.reporting.map_figure import Marked

# Polygons, each its rings, (N, 2) east and north.
Outline = list[list[NDArray[np.float64]]]
# Digits of a degree, a millimetre or so; triangles smaller than this from above are walls, square metres; and
# points nearer than this are one, metres.
_DIGITS, _LEAST_M2, _SAME_M = 8, 1e-3, 0.01


def building_outline(scene: Scene, building: int) -> Outline:
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


def contradictions(scene: Scene, findings: Mapping[str, Any]) -> list[tuple[dict[str, Any], Outline]]:
    """Returns what a flight contradicts in the map, the surest of each kind first: what, and where.

    ``kind`` is ``height``, ``demolished`` or ``unmapped``; the rest is as in the flight's findings. Outlines
    are polygons, each its rings, in the city's coordinates; of buildings that this map has not there is none.
    """
    rows = {name: row for row, name in enumerate(scene.building_ids)}

    def outline(name: str) -> Outline:
        return building_outline(scene, rows[name]) if name in rows else []

    found: list[tuple[dict[str, Any], Outline]] = [
        ({"kind": "height", **each}, outline(each["id"]))
        for each in doubted_buildings(findings.get("buildings", []))
    ]
    for change in findings.get("changes", []):
        said = {key: value for key, value in change.items() if key != "outline"}
        if change["kind"] == "demolished":
            found.append((said, outline(change["id"])))
        else:
            found.append((said, [[np.array(ring, dtype=np.float64)] for ring in change["outline"]]))
    return found


def contradiction_features(
    scene: Scene, frame: MapFrame, findings: Mapping[str, Any], flight: str
) -> list[dict[str, Any]]:
    """Returns what a flight contradicts in the map, as features of GeoJSON.

    Args:
        scene: The map.
        frame: Its coordinates on Earth.
        findings: Of the flight.
        flight: Its name.
    """
    features = []
    for said, outline in contradictions(scene, findings):
        rings = [[_on_earth(ring, frame) for ring in polygon] for polygon in outline]
        geometry = {"type": "MultiPolygon", "coordinates": rings}
        features.append({"type": "Feature", "geometry": geometry, "properties": {"flight": flight, **said}})
    return features


def city_and_marks(
    scene: Scene, findings: Mapping[str, Any]
) -> tuple[tuple[NDArray[np.float64], NDArray[np.int32]], list[Marked]]:
    """Returns the city in its coordinates for a page, and what a flight contradicts in it."""
    outlines = [outline for _, outline in contradictions(scene, findings)]
    marks = [
        Marked(f"{name}: {said}", [ring for polygon in outline for ring in polygon])
        for (name, said, _), outline in zip(map_rows(findings), outlines, strict=True)
    ]
    return (scene.vertices + scene.origin, scene.triangles), marks


def _on_earth(ring: NDArray[np.float64], frame: MapFrame) -> list[list[float]]:
    places = [frame.latitude_longitude(float(east), float(north)) for east, north in ring]
    return [[round(longitude, _DIGITS), round(latitude, _DIGITS)] for latitude, longitude in places]
