"""What a ray meets: a roof or a wall of the city model, or the ground between the buildings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap.ground import Ground
from lodbench.citymodel.building_boxes import building_boxes
from lodbench.citymodel.scene import Scene

Floats = NDArray[np.float64]

GROUND = "ground"
# How far a surface of the map may be off along its normal: a standard deviation, metres.
MAP_SIGMA_M = 0.5
# Surfaces whose normal is steeper than this are roofs; the renderers draw the same so.
_ROOF_Z = 0.3
# A hit of a building this many standard deviations below the ground is one of its cellar.
_BURIED = 2.0
# Shares of a triangle that rounding may cost at its edges, and the least way of a ray, in its lengths.
_EDGE, _NEAR = 1e-9, 1e-6


class Hits(NamedTuple):
    """What N rays meet first.

    Attributes:
        places: (N, 3) scene frame; NaN for a ray that meets nothing.
        normals: (N, 3) unit normals of the surfaces, towards the camera.
        sigma_m: (N,) standard deviation of the surface along its normal.
        building: (N,) index into ``scene.building_ids``; -1 for the ground, and for nothing.
        kind: N names: roof, wall or ground; "" for nothing.
    """

    places: Floats
    normals: Floats
    sigma_m: Floats
    building: NDArray[np.int64]
    kind: tuple[str, ...]

    def is_same(self, row: int, other: Hits, other_row: int) -> bool:
        """Tells whether a ray meets the surface that a ray of other hits meets: one plane, or the ground."""
        if (self.kind[row], self.building[row]) != (other.kind[other_row], other.building[other_row]):
            return False
        between = other.places[other_row] - self.places[row]
        normal = self.normals[row]
        is_plane = normal @ other.normals[other_row] > 0.999 and abs(between @ normal) < 0.05
        return self.kind[row] == GROUND or bool(is_plane)


class Surfaces:
    """The surfaces of a city, and the ground, in the scene's frame.

    Args:
        scene: The city.
        map_sigma_m: How far a surface of the map may be off along its normal, a standard deviation.
        ground_sigma_m: The same of the ground's height; None for what the bases nearby say.
    """

    def __init__(
        self, scene: Scene, map_sigma_m: float = MAP_SIGMA_M, ground_sigma_m: float | None = None
    ) -> None:
        self.scene, self.map_sigma_m = scene, map_sigma_m
        self._boxes = building_boxes(scene)
        self.ground = Ground(self._boxes.bases, ground_sigma_m)

    def name(self, hits: Hits, row: int) -> str:
        """Returns what a ray met, in words: ``roof of B1``."""
        kind = hits.kind[row]
        return kind if hits.building[row] < 0 else f"{kind} of {self.scene.building_ids[hits.building[row]]}"

    def hit(self, center: Floats, directions: Floats) -> Hits:
        """Returns what (N, 3) rays from a (3,) centre meet first."""
        count = len(directions)
        met = [self._building_hit(center, ray) for ray in directions]
        away = np.array([each[0] for each in met])
        building, triangle = (np.array([each[k] for each in met], np.int64) for k in (1, 2))
        with np.errstate(invalid="ignore"):
            points = center + away[:, None] * directions
        is_hit = np.isfinite(away)
        beneath = self.ground.at(points[is_hit, :2])
        is_hit[is_hit] = ~(points[is_hit, 2] < beneath.height_m - _BURIED * beneath.sigma_m)
        down = np.where(is_hit, np.inf, self.ground.distances(center, directions))
        is_ground = np.isfinite(down)
        with np.errstate(invalid="ignore"):
            points = np.where(is_ground[:, None], center + down[:, None] * directions, points)
        points[~is_hit & ~is_ground] = np.nan
        normals, sigma = np.full((count, 3), np.nan), np.full(count, self.map_sigma_m)
        normals[is_hit] = self._normals(triangle[is_hit], directions[is_hit])
        ground = self.ground.at(points[is_ground, :2])
        normals[is_ground], sigma[is_ground] = ground.normals, ground.sigma_m
        roofs = np.where(np.abs(normals[:, 2]) > _ROOF_Z, "roof", "wall")
        kind = np.where(is_hit, roofs, np.where(is_ground, GROUND, ""))
        return Hits(points, normals, sigma, np.where(is_hit, building, -1), tuple(map(str, kind)))

    def _building_hit(self, center: Floats, ray: Floats) -> tuple[float, int, int]:
        """Returns how many of its lengths away a ray meets a building, which, and which triangle."""
        boxes, scene = self._boxes, self.scene
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (boxes.low - center) / ray, (boxes.high - center) / ray
        # 0 / 0, a ray along a box's side, bounds nothing.
        enters = np.nan_to_num(np.minimum(one, other), nan=-np.inf, posinf=np.inf, neginf=-np.inf).max(axis=1)
        leaves = np.nan_to_num(np.maximum(one, other), nan=np.inf, posinf=np.inf, neginf=-np.inf).min(axis=1)
        near = boxes.building[(enters <= leaves) & (leaves > 0)]
        spans = [np.arange(scene.triangle_starts[b], scene.triangle_starts[b + 1]) for b in near]
        rows = np.concatenate(spans) if spans else np.zeros(0, np.int64)
        away = _triangle_distances(center, ray, scene.vertices[scene.triangles[rows]].astype(np.float64))
        if not np.isfinite(away).any():
            return np.inf, -1, -1
        first = int(rows[away.argmin()])
        return float(away.min()), int(np.searchsorted(scene.triangle_starts, first, side="right")) - 1, first

    def _normals(self, triangles: NDArray[np.int64], rays: Floats) -> Floats:
        corners = self.scene.vertices[self.scene.triangles[triangles]].astype(np.float64)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        # The order of corners in published models is not to be trusted.
        towards = -np.sign((normals * rays).sum(axis=1, keepdims=True))
        return np.asarray(towards * normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _triangle_distances(center: Floats, ray: Floats, corners: Floats) -> Floats:
    """Returns (T,) how many of its lengths away a ray meets each of (T, 3, 3) triangles; inf for not."""
    start, one, two = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(ray, two)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / (one * across).sum(axis=1)
        from_start = center - start
        u = (from_start * across).sum(axis=1) * inverse
        beside = np.cross(from_start, one)
        v = (beside @ ray) * inverse
        away = (two * beside).sum(axis=1) * inverse
        is_met = (u >= -_EDGE) & (v >= -_EDGE) & (u + v <= 1 + _EDGE) & (away > _NEAR)
    return np.where(is_met & np.isfinite(away), away, np.inf)
