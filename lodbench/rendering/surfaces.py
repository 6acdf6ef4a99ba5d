"""What a ray meets: a roof or a wall of the city model, or the ground between the buildings."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.citymodel.model import take_segments
from lodbench.citymodel.scene import ROOF_Z, Scene, building_boxes

Floats = NDArray[np.float64]

# Bases a plane is laid through, the nearest; farther from the nearest than this no ground is known, metres.
_NEIGHBOURS, _FURTHEST_M = 12, 2000.0
# Standard deviations of a base from the ground beside it, metres, and of the ground from a plane, metres a
# metre of distance; and of the plane's slopes beforehand.
_BASE_M, _BEND, _SLOPE = 0.3, 0.01, 0.05
# Bases off by more than this many standard deviations (cellars, parts on a roof) hardly count (Geman and
# McClure's weights); rounds of reweighting.
_ODD, _ROUNDS = 2.5, 4
# How far above and below all bases the ground may be, metres; samples along a ray, and steps from plane to
# plane after them.
_BEYOND_M, _SAMPLES, _STEPS = 10.0, 33, 50
# A ray has met the ground at the next plane where the last one was this near, metres.
_MET_M = 0.01


class GroundPlanes(NamedTuple):
    """The ground at N places."""

    height_m: Floats  # (N,) scene frame; NaN where no building is near
    slope: Floats  # (N, 2) rise a metre of way east and north
    sigma_m: Floats  # (N,) standard deviation of the height

    @property
    def normals(self) -> Floats:
        """Returns (N, 3) unit normals, upwards."""
        normals = np.column_stack([-self.slope, np.ones(len(self.slope))])
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


class Ground:
    """Ground heights by the bases of buildings.

    Args:
        bases: (B, 3) middles of the buildings' bases, scene frame.
        sigma_m: Standard deviation of its height; None for what scatter and distance of the bases say.
    """

    def __init__(self, bases: Floats, sigma_m: float | None = None) -> None:
        self._bases, self._sigma_m = bases, sigma_m
        self._tree = scipy.spatial.cKDTree(bases[:, :2])

    def at(self, places: Floats) -> GroundPlanes:
        """Returns the ground at (N, 2) places: robust least squares, near bases counting most."""
        count = min(_NEIGHBOURS, len(self._bases))
        away, rows = self._tree.query(places, k=np.arange(1, count + 1))
        near = self._bases[rows]
        design = np.concatenate([np.ones((*away.shape, 1)), near[..., :2] - places[:, None]], axis=2)
        noise, prior = np.hypot(_BASE_M, _BEND * away), np.diag([0.0, _SLOPE**-2, _SLOPE**-2])
        # From their median on: least squares alone would lay the plane through a cellar that is nearest.
        off = (near[..., 2] - np.median(near[..., 2], axis=1, keepdims=True)) / noise
        for _ in range(_ROUNDS):
            scale = np.maximum(1.0, 1.4826 * np.median(np.abs(off), axis=1, keepdims=True))
            trust = 1.0 / (1.0 + (off / (_ODD * scale)) ** 2) ** 2
            weighted = design * (trust / noise**2)[..., None]
            spread = np.linalg.inv(weighted.transpose(0, 2, 1) @ design + prior)
            plane = spread @ (weighted.transpose(0, 2, 1) @ near[..., 2:])
            off = (near[..., 2] - (design @ plane)[..., 0]) / noise
        scatter = np.maximum(1.0, (trust * off**2).sum(axis=1) / max(count - 1, 1))
        sigma = np.sqrt(scatter * (spread[:, 0, 0] + _BASE_M**2))
        if self._sigma_m is not None:
            sigma = np.full(len(places), self._sigma_m)
        height = np.where(away[:, 0] > _FURTHEST_M, np.nan, plane[:, 0, 0])
        return GroundPlanes(height, plane[:, 1:, 0], sigma)

    def distances(self, center: Floats, directions: Floats) -> Floats:
        """Returns (N,) in how many of its lengths each of (N, 3) rays meets the ground; inf for never."""
        low, high = self._bases[:, 2].min() - _BEYOND_M, self._bases[:, 2].max() + _BEYOND_M
        distances = np.full(len(directions), np.inf)
        falls = np.flatnonzero(directions[:, 2] < 0)
        if center[2] <= low or not len(falls):
            return distances
        rays = directions[falls]
        first = np.maximum(0.0, (high - center[2]) / rays[:, 2])
        last = (low - center[2]) / rays[:, 2]
        steps = first[:, None] + (last - first)[:, None] * np.linspace(0.0, 1.0, _SAMPLES)
        points = center + steps[:, :, None] * rays[:, None]
        # Roughly first: where a ray passes below the nearest base.
        is_below = points[..., 2] <= self._bases[self._tree.query(points[..., :2])[1], 2]
        away = steps[np.arange(len(rays)), is_below.argmax(axis=1)]
        # From plane to plane; every other step halves, as the ground jumps where other bases become near.
        near, far, left = first.copy(), last.copy(), np.arange(len(rays))
        for step in range(_STEPS):
            ends = center + away[left, None] * rays[left]
            plane = self.at(ends[:, :2])
            above = ends[:, 2] - plane.height_m
            is_over = ~(above <= 0)  # where no ground is known, too
            near[left[is_over]], far[left[~is_over]] = away[left[is_over]], away[left[~is_over]]
            falling = (plane.slope * rays[left, :2]).sum(axis=1) - rays[left, 2]
            ahead = away[left] + above / np.maximum(falling, 1e-9)
            is_between = (near[left] < ahead) & (ahead < far[left]) & (step % 2 == 0)
            is_off = ~(np.abs(above) < _MET_M)
            away[left] = np.where(is_between | ~is_off, ahead, 0.5 * (near[left] + far[left]))
            left = left[is_off]
            if not len(left):
                break
        # Not where no building is near, nor at a camera that is in the ground.
        is_known = np.isfinite(self.at((center + away[:, None] * rays)[:, :2]).height_m) & (away > first)
        distances[falls[is_known]] = away[is_known]
        return distances


GROUND = "ground"
# How far a surface of the map may be off along its normal: a standard deviation, metres.
MAP_SIGMA_M = 0.5
# A hit of a building this many standard deviations below the ground is one of its cellar.
_BURIED = 2.0
# Shares of a triangle that rounding may cost at its edges, and the least way of a ray, in its lengths.
_EDGE, _NEAR = 1e-9, 1e-6
# Boxes or triangles that are tested at a time.
_AT_ONCE = 1 << 19


class Hits(NamedTuple):
    """What N rays meet first."""

    places: Floats  # (N, 3) scene frame; NaN for a ray that meets nothing
    normals: Floats  # (N, 3) unit normals of the surfaces, towards the camera
    sigma_m: Floats  # (N,) standard deviation of the surface along its normal
    building: NDArray[np.int64]  # (N,) index into ``scene.building_ids``; -1 for the ground, and for nothing
    kind: tuple[str, ...]  # N names: roof, wall or ground; "" for nothing

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
        away, triangle = self._building_hits(center, directions)
        building = np.searchsorted(self.scene.triangle_starts, triangle, side="right") - 1
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
        roofs = np.where(np.abs(normals[:, 2]) > ROOF_Z, "roof", "wall")
        kind = np.where(is_hit, roofs, np.where(is_ground, GROUND, ""))
        return Hits(points, normals, sigma, np.where(is_hit, building, -1), tuple(map(str, kind)))

    def _building_hits(self, center: Floats, rays: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Returns how many of its lengths away each of (N, 3) rays meets a building, and which triangle.

        inf and -1 for a ray that meets none.
        """
        scene, away, triangle = self.scene, np.full(len(rays), np.inf), np.full(len(rays), -1, np.int64)
        for ray, building in self._boxes_on(center, rays):
            counts = np.diff(scene.triangle_starts)[building]
            # Cut anywhere: a ray's nearest triangle so far is kept.
            for rows in np.split(np.arange(len(ray)), _cuts(counts)):
                tested, _ = take_segments(scene.triangle_starts, building[rows])
                owner = np.repeat(ray[rows], counts[rows])
                corners = scene.vertices[scene.triangles[tested]].astype(np.float64)
                distances = _triangle_distances(center, rays[owner], corners)
                is_near = distances < away[owner]
                order = np.flatnonzero(is_near)[np.argsort(-distances[is_near], kind="stable")]
                away[owner[order]], triangle[owner[order]] = distances[order], tested[order]
        return away, triangle

    def _boxes_on(
        self, center: Floats, rays: Floats
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Yields rays and buildings through whose boxes they pass, both as numbers, some rays at a time."""
        boxes = self._boxes
        for first in range(0, len(rays), max(1, _AT_ONCE // len(boxes.building))):
            some = rays[first : first + max(1, _AT_ONCE // len(boxes.building)), None]
            with np.errstate(divide="ignore", invalid="ignore"):
                one, other = (boxes.low - center) / some, (boxes.high - center) / some
            # 0 / 0, a ray along a box's side, bounds nothing.
            enters = np.fmax.reduce(np.minimum(one, other), axis=2)
            leaves = np.fmin.reduce(np.maximum(one, other), axis=2)
            ray, box = np.nonzero((enters <= leaves) & (leaves > 0))
            yield ray + first, boxes.building[box]

    def _normals(self, triangles: NDArray[np.int64], rays: Floats) -> Floats:
        corners = self.scene.vertices[self.scene.triangles[triangles]].astype(np.float64)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        # The order of corners in published models is not to be trusted.
        towards = -np.sign((normals * rays).sum(axis=1, keepdims=True))
        return np.asarray(towards * normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _cuts(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns where to cut a list so that parts hold some ``_AT_ONCE`` triangles at most, or one entry."""
    return np.flatnonzero(np.diff(np.cumsum(counts) // _AT_ONCE)) + 1


def _triangle_distances(center: Floats, rays: Floats, corners: Floats) -> Floats:
    """Returns (T,) how many of its lengths away each of (T, 3) rays meets its triangle; inf for not.

    Args:
        center: (3,) where the rays start.
        rays: (T, 3).
        corners: (T, 3, 3).
    """
    start, one, two = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(rays, two)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / (one * across).sum(axis=1)
        from_start = center - start
        u = (from_start * across).sum(axis=1) * inverse
        beside = np.cross(from_start, one)
        v = (beside * rays).sum(axis=1) * inverse
        away = (two * beside).sum(axis=1) * inverse
        is_met = (u >= -_EDGE) & (v >= -_EDGE) & (u + v <= 1 + _EDGE) & (away > _NEAR)
    return np.where(is_met & np.isfinite(away), away, np.inf)
