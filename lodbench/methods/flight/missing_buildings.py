"""Buildings that the map lacks: what masks of several photos hold and no building explains.

It is looked up in space: a place that nearly all photos that see it past the map's buildings call a building
is one (a visual hull over a grid of voxels). Patches that one photo makes up agree with no other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.methods.flight.map_views import View

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Voxels: their width, their heights above ground, metres; and what makes a place of them a building.
_CELL_M, _HEIGHTS_M = 2.0, (1.0, 3.0, 5.0, 8.0, 12.0, 17.0, 23.0, 30.0)
_SHARE, _FEWEST_PHOTOS, _LEAST_M2 = 0.8, 3, 24.0
# What lies this near to a building's silhouette is its own, badly drawn; what lies further is seen too small.
_MARGIN_PX, _FURTHEST_M = 4, 400.0


def missing_buildings(views: Sequence[View], city_map: CityMap) -> list[dict[str, Any]]:
    """Returns places that photos show buildings at and the map has none, the largest first.

    Each with its ``outline``: rings of (east, north) in the city's coordinates, ``area_m2``, ``top_m`` above
    the ground, the ``share`` of photos that show it of those that could, and the ``photos``.
    """
    if len(views) < _FEWEST_PHOTOS:
        return []
    known = [_known(view, city_map) for view in views]
    corner, counts, ground = _grid(views, city_map)
    places = corner + _CELL_M * (np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1) + 0.5)
    flat = places.reshape(-1, 2)
    hits = np.zeros((len(_HEIGHTS_M), len(flat)))
    looks = np.zeros_like(hits)
    for view, covered in zip(views, known, strict=True):
        near = np.flatnonzero(np.linalg.norm(flat - view.pose.center[:2], axis=1) < _FURTHEST_M)
        for level, height in enumerate(_HEIGHTS_M):
            points = np.column_stack([flat[near], np.full(len(near), ground + height)])
            rows, pixels = _pixels(view, points)
            is_free = ~covered[pixels[:, 1], pixels[:, 0]]
            chosen = near[rows[is_free]]
            looks[level, chosen] += 1
            hits[level, chosen] += view.mask[pixels[is_free, 1], pixels[is_free, 0]]
    shares = np.where(looks >= _FEWEST_PHOTOS, hits / np.maximum(looks, 1), 0.0)
    low = (shares[:2].max(axis=0) >= _SHARE).reshape(counts)
    return _components(low, shares.reshape(-1, *counts), corner, ground, views, known, city_map)


def _known(view: View, city_map: CityMap) -> Mask:
    """Returns the pixels that the map explains, with a margin."""
    shown = city_map.render(view.camera, view.pose).view(np.uint8)
    size = 2 * _MARGIN_PX + 1
    return np.asarray(cv2.dilate(shown, np.ones((size, size), np.uint8)) > 0)


def _grid(views: Sequence[View], city_map: CityMap) -> tuple[Floats, tuple[int, int], float]:
    """Returns the corner of the ground that photos show, (2,) metres, cells each way, and its height."""
    scene = city_map.scene
    ground = float(np.percentile(_floors(scene.vertices, scene.vertex_starts), 30))
    hits = []
    for view in views:
        rays = np.array([[u, v] for u in (0.0, 1.0) for v in (0.3, 1.0)]) * [
            view.camera.width,
            view.camera.height,
        ]
        away = (rays - [view.camera.cx, view.camera.cy]) / [view.camera.fx, view.camera.fy]
        down = np.column_stack([away, np.ones(4)]) @ view.pose.rotation
        depth = np.where(
            down[:, 2] < -1e-3, (ground - view.pose.center[2]) / np.minimum(down[:, 2], -1e-3), np.inf
        )
        reach = _FURTHEST_M / np.maximum(np.linalg.norm(down[:, :2], axis=1), 1e-6)
        # In a valley a camera may be below the city's usual ground, which is then behind it.
        hits.append(view.pose.center[:2] + down[:, :2] * np.clip(depth, 0.0, reach)[:, None])
    spots = np.concatenate(hits)
    low, high = spots.min(axis=0), spots.max(axis=0)
    count = np.maximum(np.ceil((high - low) / _CELL_M), 1).astype(int)
    return low, (int(count[0]), int(count[1])), ground


def _floors(vertices: NDArray[np.float32], starts: NDArray[np.int64]) -> Floats:
    filled = np.flatnonzero(np.diff(starts) > 0)
    return np.minimum.reduceat(vertices[:, 2].astype(np.float64), starts[filled])


def _pixels(view: View, points: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns which of (N, 3) points a photo shows, and their pixels, (M, 2)."""
    local = (points - view.pose.center) @ view.pose.rotation.T
    ahead = np.flatnonzero(local[:, 2] > 1.0)
    focal = np.array([view.camera.fx, view.camera.fy])
    seen = local[ahead, :2] / local[ahead, 2:] * focal + [view.camera.cx, view.camera.cy]
    inside = ((seen >= 0) & (seen < [view.camera.width, view.camera.height])).all(axis=1)
    return ahead[inside], np.floor(seen[inside]).astype(np.int64)


def _components(
    low: Mask,
    shares: Floats,
    corner: Floats,
    ground: float,
    views: Sequence[View],
    known: Sequence[Mask],
    city_map: CityMap,
) -> list[dict[str, Any]]:
    """Returns the connected places of a grid, (X, Y), that are large enough."""
    count, labels = cv2.connectedComponents(low.astype(np.uint8), connectivity=4)
    found = []
    for label in range(1, count):
        cells = np.argwhere(labels == label)
        area = len(cells) * _CELL_M**2
        if area < _LEAST_M2:
            continue
        middle = corner + _CELL_M * (cells.mean(axis=0) + 0.5)
        levels = shares[:, cells[:, 0], cells[:, 1]].max(axis=1) >= _SHARE
        top = float(np.array(_HEIGHTS_M)[levels].max())
        place = np.array([[*middle, ground + _HEIGHTS_M[0]]])
        photos = []
        for view, covered in zip(views, known, strict=True):
            _, pixels = _pixels(view, place)
            if (
                len(pixels)
                and view.mask[pixels[0, 1], pixels[0, 0]]
                and not covered[pixels[0, 1], pixels[0, 0]]
            ):
                photos.append(view.name)
        share = float(shares[:2, cells[:, 0], cells[:, 1]].mean())
        outline = [(ring + corner + city_map.scene.origin[:2]).tolist() for ring in _outline(labels == label)]
        found.append(
            {
                "kind": "missing",
                "outline": outline,
                "area_m2": area,
                "top_m": top,
                "share": share,
                "photos": photos,
            }
        )
    return sorted(found, key=lambda change: -change["area_m2"])


def _outline(cells: Mask) -> list[Floats]:
    """Returns the rings around cells, (N, 2) metres from the grid's corner, closed."""
    # Twice as fine and one cell wider, so that outlines run along cells' edges and not through their middles.
    fine = np.kron(np.pad(cells, 1), np.ones((4, 4), np.uint8)).astype(np.uint8)
    rings, _ = cv2.findContours(fine, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    closed = []
    for ring in rings:
        # OpenCV's x runs along the second axis: north here.
        points = (ring[:, 0, ::-1].astype(np.float64) + 0.5) / 4.0 - 1.0
        closed.append(np.vstack([points, points[:1]]) * _CELL_M)
    return closed
