"""The land of a city: its ground, from the bases of buildings or a terrain raster, and what covers it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene
from lodbench.citymodel.terrain import ground_under
from lodbench.errors import DatasetError
from lodbench.synthesis.objects.mesh_builder import grid_triangles
from lodbench.synthesis.photo import LandCover
from lodbench.synthesis.surroundings.land_cover import MARGIN_M, TopView

Floats = NDArray[np.float64]

_LEAST_CELL_M, _MAX_SIDE = 6.0, 260
_SMOOTH_M = 14.0
_HORIZON_M = 9000.0
# The ground lies a little below the bases: it must not show through floors.
_BELOW_M = 0.05


class Ground(NamedTuple):
    """Ground heights on a grid of points, from the south-west."""

    west: float  # x of the first column, local metres
    south: float  # y of the first row
    cell_m: float  # distance of points
    heights_m: Floats  # (rows, columns)

    @property
    def places(self) -> Floats:
        """Returns the points of the grid, (rows * columns, 2) local metres, row by row."""
        rows, columns = self.heights_m.shape
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        return np.stack([x.ravel(), y.ravel()], axis=1) * self.cell_m + [self.west, self.south]

    def at(self, points: Floats) -> Floats:
        """Returns (N,) heights under points (N, 2 or more), interpolated; at the rim's beyond it."""
        place = (points[:, :2] - [self.west, self.south]) / self.cell_m
        return np.asarray(
            scipy.ndimage.map_coordinates(self.heights_m, place.T[::-1], order=1, mode="nearest")
        )

    def on_ground(self, points: Floats, above_m: float = 0.0) -> Floats:
        """Returns positions, (N, 2), with the height of the ground and a little more, (N, 3)."""
        return np.column_stack([points, self.at(points) + above_m])

    def mesh(self) -> tuple[Floats, NDArray[np.int64]]:
        """Returns vertices and triangles, with a skirt of plain land to the horizon."""
        rows, columns = self.heights_m.shape
        grid = np.column_stack([self.places, self.heights_m.ravel()])
        index = np.arange(rows * columns).reshape(rows, columns)
        rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
        middle = grid[:, :2].mean(axis=0)
        out = grid[rim].copy()
        out[:, :2] = middle + (out[:, :2] - middle) * (_HORIZON_M / np.abs(out[:, :2] - middle).max())
        far = len(grid) + np.arange(len(rim))
        after, far_after = np.roll(rim, -1), np.roll(far, -1)
        skirt = [np.stack([rim, far, far_after], axis=1), np.stack([rim, far_after, after], axis=1)]
        return np.concatenate([grid, out]), np.concatenate([grid_triangles(rows, columns), *skirt])


class Land(NamedTuple):
    """A city from above, its ground heights, and what covers the ground."""

    view: TopView
    ground: Ground
    cover: LandCover

    def at(self, places: Floats) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]:
        """Returns of places, (N, 2): what covers them, metres to the middle of a road and to a building."""
        cell = self.view.cells_of(places)
        return self.cover.classes[cell], np.sqrt(self.cover.road_m2[cell]), self.view.free_m[cell]


def ground_from_bases(view: TopView) -> Ground:
    """Returns ground at the height of the nearest buildings' bases, smoothed."""
    rows, columns = view.tops_m.shape
    wide, high = columns * view.cell_m, rows * view.cell_m
    cell = max(_LEAST_CELL_M, max(wide, high, 2 * MARGIN_M) / _MAX_SIDE)
    level = Ground(view.west, view.south, cell, np.zeros((int(high / cell) + 2, int(wide / cell) + 2)))
    _, nearest = scipy.spatial.cKDTree(view.bases[:, :2]).query(level.places)
    heights = view.bases[nearest, 2].reshape(level.heights_m.shape)
    smooth = scipy.ndimage.gaussian_filter(heights, _SMOOTH_M / cell, mode="nearest")
    return level._replace(heights_m=smooth - _BELOW_M)


def ground_from_raster(view: TopView, scene: Scene, raster: str) -> Ground:
    """Returns ground at the heights of a terrain raster, and beyond it at that of the bases.

    Raises:
        CityModelError: The raster cannot be read.
        DatasetError: It covers no part of the city.
    """
    fallback = ground_from_bases(view)
    places = fallback.places + scene.origin[:2]
    found = ground_under(places, scene.crs or "", ReadOptions(terrain=raster)) - scene.origin[2]
    if not np.isfinite(found).any():
        raise DatasetError(f"The terrain {raster} covers no part of the city.", "Check its reference system.")
    heights = np.where(np.isfinite(found), found, fallback.heights_m.ravel())
    return fallback._replace(heights_m=heights.reshape(fallback.heights_m.shape))
