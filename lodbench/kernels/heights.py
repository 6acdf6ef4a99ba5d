"""Compiled passes over heights on a grid: planes grown over cells, triangles drawn from above."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.kernels.arguments import UNLABELLED
from lodbench.kernels.compiled import checked


@checked
def _add_cell(sums: NDArray[np.float64], r: float, c: float, z: float) -> None:  # pragma: no cover - compiled
    """Adds a cell to the sums n, r, c, rr, rc, cc, z, rz, cz."""
    sums[0] += 1.0
    sums[1] += r
    sums[2] += c
    sums[3] += r * r
    sums[4] += r * c
    sums[5] += c * c
    sums[6] += z
    sums[7] += r * z
    sums[8] += c * z


@checked
def _fit_plane(sums: NDArray[np.float64], plane: NDArray[np.float64]) -> bool:  # pragma: no cover - compiled
    """Fills the least squares plane of sums; False where there is none."""
    n, r, c, rr, rc, cc, z, rz, cz = sums
    a, b, d = rr - r * r / n, rc - r * c / n, cc - c * c / n
    e, f = rz - r * z / n, cz - c * z / n
    det = a * d - b * b
    if det <= 1e-9 * max(a * d, 1e-9):
        return False
    plane[0], plane[1] = (d * e - b * f) / det, (a * f - b * e) / det
    plane[2] = (z - plane[0] * r - plane[1] * c) / n
    return True


@checked
def _fit_seed(
    heights: NDArray[np.float32],
    labels: NDArray[np.int32],
    row0: int,
    column0: int,
    sums: NDArray[np.float64],
    plane: NDArray[np.float64],
) -> bool:  # pragma: no cover - compiled
    """Fills the plane of the unlabelled cells next to a seed, in offsets from it; False where too few."""
    z0 = float(heights[row0, column0])
    sums[:] = 0.0
    for row in range(row0 - 1, row0 + 2):
        for column in range(column0 - 1, column0 + 2):
            if labels[row, column] == UNLABELLED:
                _add_cell(sums, float(row - row0), float(column - column0), heights[row, column] - z0)
    return bool(sums[0] >= 6 and _fit_plane(sums, plane))


@checked
def _grow_region(
    heights: NDArray[np.float32],
    labels: NDArray[np.int32],
    seed: int,
    label: int,
    tolerance_m: float,
    queue: NDArray[np.int64],
    sums: NDArray[np.float64],
    plane: NDArray[np.float64],
) -> int:  # pragma: no cover - compiled
    """Labels cells within the tolerance of the plane, fitted again as the region grows; returns how many."""
    rows, columns = heights.shape
    row0, column0 = seed // columns, seed % columns
    z0 = float(heights[row0, column0])
    sums[:] = 0.0
    _add_cell(sums, 0.0, 0.0, 0.0)
    queue[0] = seed
    labels[row0, column0] = label
    size, position, refit = 1, 0, 16
    while position < size:
        row, column = queue[position] // columns, queue[position] % columns
        position += 1
        for step in range(4):
            r, c = row + (step == 0) - (step == 1), column + (step == 2) - (step == 3)
            if r < 0 or c < 0 or r >= rows or c >= columns or labels[r, c] != UNLABELLED:
                continue
            dr, dc, dz = float(r - row0), float(c - column0), heights[r, c] - z0
            if abs(plane[0] * dr + plane[1] * dc + plane[2] - dz) > tolerance_m:
                continue
            labels[r, c] = label
            queue[size] = r * columns + c
            size += 1
            _add_cell(sums, dr, dc, dz)
            if size == refit:
                _fit_plane(sums, plane)
                refit *= 2
    return size


@checked
def _remove_outliers(
    heights: NDArray[np.float32],
    labels: NDArray[np.int32],
    seed: int,
    size: int,
    tolerance_m: float,
    queue: NDArray[np.int64],
    plane: NDArray[np.float64],
) -> tuple[int, float]:  # pragma: no cover - compiled
    """Unlabels the outliers of a piece's last plane; returns how many inliers, and their square sum."""
    columns = heights.shape[1]
    row0, column0 = seed // columns, seed % columns
    kept, square_sum = 0, 0.0
    for k in range(size):
        row, column = queue[k] // columns, queue[k] % columns
        z = plane[0] * (row - row0) + plane[1] * (column - column0) + plane[2] + heights[row0, column0]
        residual = z - heights[row, column]
        if abs(residual) <= tolerance_m:
            kept += 1
            square_sum += residual * residual
        else:
            labels[row, column] = UNLABELLED
    return kept, square_sum


@checked
def grow_planes(
    heights: NDArray[np.float32],
    labels: NDArray[np.int32],
    seeds: NDArray[np.int64],
    tolerance_m: float,
    min_cells: int,
    max_slope: float,
    planes: NDArray[np.float64],
    counts: NDArray[np.int64],
    rms: NDArray[np.float64],
) -> int:  # pragma: no cover - compiled
    """Fills labels, planes, counts and rms of the plane pieces of some cells; returns how many there are.

    Seeds are cells inside the rim, in the order in which they are tried.
    """
    columns = heights.shape[1]
    queue = np.empty(heights.size, np.int64)
    sums, plane = np.zeros(9), np.zeros(3)
    num_planes = 0
    for seed in seeds:
        row0, column0 = seed // columns, seed % columns
        if labels[row0, column0] != UNLABELLED or not _fit_seed(heights, labels, row0, column0, sums, plane):
            continue
        if max(abs(plane[0]), abs(plane[1])) > max_slope:
            continue
        size = _grow_region(heights, labels, seed, num_planes + 1, tolerance_m, queue, sums, plane)
        kept, square_sum = 0, 0.0
        if size >= min_cells and _fit_plane(sums, plane) and max(abs(plane[0]), abs(plane[1])) <= max_slope:
            kept, square_sum = _remove_outliers(heights, labels, seed, size, tolerance_m, queue, plane)
        if kept < min_cells:
            for k in range(size):
                labels[queue[k] // columns, queue[k] % columns] = UNLABELLED
            continue
        planes[num_planes, :2] = plane[:2]
        planes[num_planes, 2] = plane[2] + heights[row0, column0]
        planes[num_planes, 2] -= plane[0] * (row0 + 0.5) + plane[1] * (column0 + 0.5)
        counts[num_planes], rms[num_planes] = kept, np.sqrt(square_sum / kept)
        num_planes += 1
    return num_planes


@checked
def draw_from_above(
    corners: NDArray[np.float64], heights: NDArray[np.float32], triangle: NDArray[np.int32]
) -> None:  # pragma: no cover - compiled
    """Fills the highest of triangles, (T, 3, 3) column, row, height, at cells' middles, and which it is."""
    rows, columns = heights.shape
    for t in range(len(corners)):
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners[t]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if abs(area) < 1e-9:
            continue
        top, bottom = int(max(min(ay, by, cy) - 0.5, 0.0)), int(min(max(ay, by, cy) + 0.5, rows))
        left, right = int(max(min(ax, bx, cx) - 0.5, 0.0)), int(min(max(ax, bx, cx) + 0.5, columns))
        for row in range(top, bottom):
            for column in range(left, right):
                x, y = column + 0.5, row + 0.5
                u = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / area
                v = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / area
                if u < 0.0 or v < 0.0 or u + v > 1.0:
                    continue
                z = u * az + v * bz + (1.0 - u - v) * cz
                if not z <= heights[row, column]:
                    heights[row, column] = z
                    triangle[row, column] = t
