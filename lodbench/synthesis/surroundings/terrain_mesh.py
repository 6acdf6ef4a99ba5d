"""The ground under a city as a mesh: from the bases of its buildings, or from a terrain raster."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.terrain import ground_under
from lodbench.errors import DatasetError
from lodbench.synthesis.surroundings.land import MARGIN_M, Plan

Floats = NDArray[np.float64]

_LEAST_CELL_M, _MAX_SIDE = 6.0, 260
_SMOOTH_M = 14.0
_HORIZON_M = 9000.0
# The ground lies a little below the bases: it must not show through floors.
_BELOW_M = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Ground heights on a grid of points, from the south-west.

    Attributes:
        west: x of the first column, local metres.
        south: y of the first row.
        cell_m: Distance of points.
        heights_m: (rows, columns).
    """

    west: float
    south: float
    cell_m: float
    heights_m: Floats

    def at(self, points: Floats) -> Floats:
        """Returns (N,) heights under points (N, 2 or more), interpolated; at the rim's beyond it."""
        rows, columns = self.heights_m.shape
        fx = np.clip((points[:, 0] - self.west) / self.cell_m, 0, columns - 1.001)
        fy = np.clip((points[:, 1] - self.south) / self.cell_m, 0, rows - 1.001)
        i, j = fx.astype(np.int64), fy.astype(np.int64)
        u, v, h = fx - i, fy - j, self.heights_m
        low, high = h[j, i] * (1 - u) + h[j, i + 1] * u, h[j + 1, i] * (1 - u) + h[j + 1, i + 1] * u
        return np.asarray(low * (1 - v) + high * v)

    def mesh(self) -> tuple[Floats, NDArray[np.int64]]:
        """Returns vertices and triangles, with a skirt of plain land to the horizon."""
        rows, columns = self.heights_m.shape
        x = self.west + np.arange(columns) * self.cell_m
        y = self.south + np.arange(rows) * self.cell_m
        grid = np.dstack([*np.meshgrid(x, y), self.heights_m]).reshape(-1, 3)
        index = np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
        inner = np.concatenate([np.dstack([a, b, c]).reshape(-1, 3), np.dstack([a, c, d]).reshape(-1, 3)])
        rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
        middle = grid[:, :2].mean(axis=0)
        out = grid[rim].copy()
        out[:, :2] = middle + (out[:, :2] - middle) * (_HORIZON_M / np.abs(out[:, :2] - middle).max())
        far = len(grid) + np.arange(len(rim))
        after, far_after = np.roll(rim, -1), np.roll(far, -1)
        skirt = [np.stack([rim, far, far_after], axis=1), np.stack([rim, far_after, after], axis=1)]
        return np.concatenate([grid, out]), np.concatenate([inner, *skirt])


def ground_from_bases(plan: Plan) -> Ground:
    """Returns ground at the height of the nearest buildings' bases, smoothed."""
    ground = _blank(plan)
    rows, columns = ground.heights_m.shape
    column = np.clip(np.round((plan.bases[:, 0] - ground.west) / ground.cell_m).astype(int), 0, columns - 1)
    row = np.clip(np.round((plan.bases[:, 1] - ground.south) / ground.cell_m).astype(int), 0, rows - 1)
    lowest = np.full((rows, columns), np.inf)
    np.minimum.at(lowest, (row, column), plan.bases[:, 2])
    empty = ~np.isfinite(lowest)
    _, nearest = cv2.distanceTransformWithLabels(
        empty.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    height_of = np.zeros(int(nearest.max()) + 1)
    height_of[nearest[~empty]] = lowest[~empty]
    heights = np.asarray(cv2.GaussianBlur(height_of[nearest], (0, 0), _SMOOTH_M / ground.cell_m), np.float64)
    return Ground(ground.west, ground.south, ground.cell_m, heights - _BELOW_M)


def ground_from_raster(plan: Plan, scene: Scene, raster: str) -> Ground:
    """Returns ground at the heights of a terrain raster, and beyond it at that of the bases.

    Raises:
        CityModelError: The raster cannot be read.
        DatasetError: It covers no part of the city.
    """
    fallback = ground_from_bases(plan)
    rows, columns = fallback.heights_m.shape
    x = fallback.west + np.arange(columns) * fallback.cell_m + scene.origin[0]
    y = fallback.south + np.arange(rows) * fallback.cell_m + scene.origin[1]
    points = np.stack([axis.ravel() for axis in np.meshgrid(x, y)], axis=1)
    found = ground_under(points, scene.crs or "", ReadOptions(terrain=raster)) - scene.origin[2]
    if not np.isfinite(found).any():
        raise DatasetError(f"The terrain {raster} covers no part of the city.", "Check its reference system.")
    heights = np.where(np.isfinite(found), found, fallback.heights_m.ravel()).reshape(rows, columns)
    return Ground(fallback.west, fallback.south, fallback.cell_m, heights)


def _blank(plan: Plan) -> Ground:
    rows, columns = plan.tops_m.shape
    wide, high = columns * plan.cell_m, rows * plan.cell_m
    cell = max(_LEAST_CELL_M, max(wide, high, 2 * MARGIN_M) / _MAX_SIDE)
    shape = int(high / cell) + 2, int(wide / cell) + 2
    return Ground(plan.west, plan.south, cell, np.zeros(shape))
