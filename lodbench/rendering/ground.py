"""The ground between buildings: a local plane through their bases, and how well it is known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

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
    """The ground at N places.

    Attributes:
        height_m: (N,) scene frame; NaN where no building is near.
        slope: (N, 2) rise a metre of way east and north.
        sigma_m: (N,) standard deviation of the height.
    """

    height_m: Floats
    slope: Floats
    sigma_m: Floats

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
        found = np.full(len(directions), np.inf)
        falls = np.flatnonzero(directions[:, 2] < 0)
        if center[2] <= low or not len(falls):
            return found
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
        found[falls[is_known]] = away[is_known]
        return found
