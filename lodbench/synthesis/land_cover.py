"""What lies between the buildings of a city that says nothing about it: ground, roads, yards, fields."""

from __future__ import annotations

from typing import NamedTuple, cast

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.citymodel.options import ReadOptions
from lodbench.citymodel.scene import Scene, building_boxes
from lodbench.citymodel.surface.ground import ground_under
from lodbench.errors import DatasetError
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.kernels.looks import LandCover, SurfaceClass
from lodbench.rendering.raster import RasterRenderer
from lodbench.synthesis.objects import grid_triangles

Floats = NDArray[np.float64]

_LEAST_GROUND_CELL_M, _MAX_GROUND_SIDE = 6.0, 260
_GROUND_SMOOTH_M = 14.0
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
    rows, columns = view.surface_m.shape
    wide, high = columns * view.cell_m, rows * view.cell_m
    cell = max(_LEAST_GROUND_CELL_M, max(wide, high, 2 * MARGIN_M) / _MAX_GROUND_SIDE)
    level = Ground(view.west, view.south, cell, np.zeros((int(high / cell) + 2, int(wide / cell) + 2)))
    _, nearest = scipy.spatial.cKDTree(view.bases[:, :2]).query(level.places)
    heights = view.bases[nearest, 2].reshape(level.heights_m.shape)
    smooth = scipy.ndimage.gaussian_filter(heights, _GROUND_SMOOTH_M / cell, mode="nearest")
    return level._replace(heights_m=smooth - _BELOW_M)


def ground_from_raster(view: TopView, scene: Scene, raster: str) -> Ground:
    """Returns ground at the heights of a terrain raster, and beyond it at that of the bases.

    Raises:
        CityModelError: The raster cannot be read.
        DatasetError: It covers no part of the city.
    """
    fallback = ground_from_bases(view)
    places = fallback.places + scene.origin[:2]
    terrain_m = ground_under(places, scene.crs or "", ReadOptions(terrain=raster)) - scene.origin[2]
    if not np.isfinite(terrain_m).any():
        raise DatasetError(f"The terrain {raster} covers no part of the city.", "Check its reference system.")
    heights = np.where(np.isfinite(terrain_m), terrain_m, fallback.heights_m.ravel())
    return fallback._replace(heights_m=heights.reshape(fallback.heights_m.shape))


Grid = NDArray[np.float32]

MARGIN_M = 220.0  # land beyond the outermost buildings
_LEAST_CELL_M, _MAX_SIDE = 0.5, 3000
_MAX_SPAN_M = 60_000.0  # cells of 20 m: no street is reported on wider ones, and trees take the memory
_ABOVE_M = 20_000.0  # the camera that looks down on the city, so far that its rays are parallel

_JOINED_M = 11.0  # buildings nearer than this share a block
_LEAST_BLOCK_M2 = 500.0  # a smaller group of buildings has no streets of its own
_STREET_M = (4.0, 200.0)  # a street keeps at least so far from buildings, and is at most so far from them
_FIELD_M = 55.0  # further from buildings than this are fields
_DENSE = 0.55  # share of a block that is built on, above which its yards are paved
_SMOOTH_M = 2.0  # roads are smoothed by this much
_ROUND_M = 2.5  # corners of what covers the ground are rounded by this much


class TopView(NamedTuple):
    """A city viewed from above, on a grid from the south-west; its margin included."""

    west: float  # left edge, local metres
    south: float  # lower edge
    cell_m: float  # size of a cell
    surface_m: Grid  # (rows, columns) height of the highest surface, NaN where there is no building
    bases: Floats  # (B, 3) middle of each building's lowest points, local metres; empty ones are left out

    @property
    def is_built(self) -> NDArray[np.bool_]:
        """Returns (rows, columns) whether a building covers a cell."""
        return np.asarray(np.isfinite(self.surface_m))

    @property
    def free_m(self) -> Grid:
        """Returns (rows, columns) float32 distance from the nearest building, metres."""
        return distance_in(~self.is_built, self.cell_m)

    def jittered(self, spacing_m: float, generator: np.random.Generator) -> Floats:
        """Returns places all over the grid, about a spacing apart, (N, 2)."""
        rows, columns = self.surface_m.shape
        axes = [
            np.arange(start + 0.5 * spacing_m, start + count * self.cell_m, spacing_m)
            for start, count in ((self.west, columns), (self.south, rows))
        ]
        grid = np.stack([axis.ravel() for axis in np.meshgrid(*axes)], axis=1)
        return np.asarray(grid + generator.uniform(-0.45, 0.45, size=grid.shape) * spacing_m)

    def cells_of(self, points: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Returns rows and columns of points, (N, 2), those of the rim for points beyond it."""
        rows, columns = self.surface_m.shape
        column, row = np.floor((points - [self.west, self.south]) / self.cell_m).astype(np.int64).T
        return np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)


def look_down(scene: Scene) -> TopView:
    """Returns a city from above: its highest surfaces, drawn from straight above.

    Raises:
        DatasetError: It is so wide that no land can be made up for it.
    """
    low, high = scene.extent_m
    span = high[:2] - low[:2] + 2 * MARGIN_M
    if span.max() > _MAX_SPAN_M:
        wide_km, most_km = span.max() / 1000, _MAX_SPAN_M / 1000
        raise DatasetError(
            f"The city is {wide_km:,.0f} km wide: land is made up for at most {most_km:.0f} km.",
            "lodbench city check FILE names strays; lodbench city convert --bbox W S E N FILE OUT cuts.",
        )
    cell = max(_LEAST_CELL_M, float(span.max()) / _MAX_SIDE)
    columns, rows = (int(length / cell) + 1 for length in span)
    west, south = (float(value) for value in low[:2] - MARGIN_M)
    middle = np.array([west + 0.5 * columns * cell, south + 0.5 * rows * cell, _ABOVE_M])
    focal = (_ABOVE_M - float(low[2])) / cell
    camera = Camera(columns, rows, focal, focal, 0.5 * columns, 0.5 * rows)
    pose = Pose.from_euler(EulerAngles(0.0, 0.0, 0.0), middle)
    depth = RasterRenderer(scene, threads=1).depth(camera, pose)
    surface_m = np.ascontiguousarray(np.where(depth > 0, _ABOVE_M - depth, np.nan)[::-1], dtype=np.float32)
    return TopView(west, south, cell, surface_m, building_boxes(scene).bases)


def draw_land_cover(view: TopView, generator: np.random.Generator) -> LandCover:
    """Returns a made-up land cover that fits the buildings of a view.

    Streets run midway between blocks, as Voronoi edges of what stands close together; yards are paved
    where blocks are dense and green where they are not; beyond are fields, and water in places.
    """
    cell, built = view.cell_m, view.is_built
    block, away_m, built_share = _blocks(view)
    half = float(generator.uniform(2.6, 4.2))
    road_m2, road_rad = _streets(block, away_m, cell)
    ground = np.full(built.shape, SurfaceClass.GRASS, dtype=np.uint8)
    lots = generator.random(int(block.max()) + 1)
    paved = (built_share > _DENSE) | (lots < 0.12)
    bare = (lots > 0.93) & ~paved
    # Smooth noise in about -1 to 1, some 100 m across.
    coarse = [max(2, int(side * cell / 70.0) + 2) for side in built.shape]
    noise = generator.uniform(-1.0, 1.0, size=coarse).astype(np.float32)
    relief = cv2.resize(noise, built.shape[::-1], interpolation=cv2.INTER_CUBIC)
    distance = view.free_m
    ground[paved[block] & (distance < 9.0 + 7.0 * relief)] = SurfaceClass.PAVEMENT
    ground[bare[block] & (distance < 25.0)] = SurfaceClass.GROUND
    near = distance < 2.5 + 2.0 * relief
    ground[near & (lots[block] < 0.6)] = SurfaceClass.PAVEMENT
    ground[distance > _FIELD_M + 25.0 * relief] = SurfaceClass.FIELD
    # Low places away from buildings and streets, in every second city.
    low = relief < float(generator.uniform(-1.4, -0.35))
    ground[low & (distance > 22.0) & (road_m2 > 100.0)] = SurfaceClass.WATER
    # Each place as most around it: blobs keep their shape and lose the corners of cells.
    ground = np.asarray(cv2.medianBlur(ground, 2 * max(1, round(_ROUND_M / cell)) + 1), dtype=np.uint8)
    pavement = float(generator.uniform(0.8, 2.2))
    return LandCover(ground, road_m2, road_rad, view.west, view.south, cell, half, pavement)


def distance_in(mask: NDArray[np.bool_], cell_m: float) -> Grid:
    """Returns the distance of each cell of a mask from the nearest cell outside it, metres."""
    return cast("Grid", cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) * np.float32(cell_m))


def _blocks(view: TopView) -> tuple[NDArray[np.int32], Grid, Floats]:
    """Returns the block each cell is nearest to, how far that is, and the built share of every block."""
    cell, built = view.cell_m, view.is_built
    joined = view.free_m < 0.5 * _JOINED_M
    joined = distance_in(joined, cell) > 0.5 * _JOINED_M - cell
    joined |= built
    _, labels, stats, _ = cv2.connectedComponentsWithStats(joined.astype(np.uint8), connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] * cell * cell >= _LEAST_BLOCK_M2
    large[0] = False
    if not large.any():
        large[1:] = True
    core = large[labels]
    away, nearest = cv2.distanceTransformWithLabels(
        (~core).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_CCOMP
    )
    number = int(nearest.max()) + 1
    area = np.bincount(nearest[core], minlength=number)
    share = np.bincount(nearest[core & built], minlength=number) / np.maximum(area, 1)
    return nearest, cast("Grid", away * np.float32(cell)), share


def _streets(block: NDArray[np.int32], away_m: Grid, cell_m: float) -> tuple[Grid, Grid]:
    """Returns the squared distance from the middle of the nearest street, and its direction, radians."""
    edge = np.zeros(block.shape, dtype=bool)
    edge[:, 1:] |= block[:, 1:] != block[:, :-1]
    edge[1:] |= block[1:] != block[:-1]
    edge &= (away_m > _STREET_M[0]) & (away_m < _STREET_M[1])
    if not edge.any():
        return np.full(block.shape, 1e6, dtype=np.float32), np.zeros(block.shape, dtype=np.float32)
    sigma = _SMOOTH_M / cell_m
    away = cv2.GaussianBlur(distance_in(~edge, cell_m), (0, 0), sigma)
    # Near a line the blurred distance is that of a hyperbola; squared, what it is off by is a constant.
    square = np.maximum(0.0, away**2 - 2.0 / np.pi * _SMOOTH_M**2)
    gx, gy = cv2.Sobel(away, cv2.CV_32F, 1, 0), cv2.Sobel(away, cv2.CV_32F, 0, 1)
    double = cv2.GaussianBlur(np.dstack([gx * gx - gy * gy, 2.0 * gx * gy]), (0, 0), 2.0 * sigma)
    across = 0.5 * np.arctan2(double[:, :, 1], double[:, :, 0])
    return np.minimum(square, 1e6).astype(np.float32), (across + np.pi / 2).astype(np.float32)
