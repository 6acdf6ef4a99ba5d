"""Least squares under correlated errors, votes for places, and the least total variation."""

from __future__ import annotations

import numpy as np

from lodbench.kernels.compiled import checked, kernel

# Columns that are eliminated at once: a matrix of 250 rows is larger than a core's first cache, and each pass
# over it fetches all of it anew. Each number is changed in the same order as one by one.
_BLOCK = 4


@kernel
def error_covariance(
    pixels, roof_slopes, base_slopes, buildings, mask_variances, correlation_px, map_variances
):
    """Returns the lower half of the points' error covariance, (N, N) square pixels.

    The mask's outline errs alike at points near each other in the picture: a curve that bends, without
    kinks (Matern's correlation of order 3/2). A building's roof errs as a whole, and by parts: alike at
    points near each other. The base of its walls errs as a whole.

    Args:
        pixels: (N, 2) points.
        roof_slopes: (N,) change of a distance per metre that the roof is higher, pixels.
        base_slopes: (N,) its change per metre that the base of walls is higher, pixels.
        buildings: (N,) which.
        mask_variances: Of the mask's outline, its correlated and its independent part, square pixels.
        correlation_px: Correlation lengths of the outline's error and of a roof's by parts, pixels.
        map_variances: Of a roof as a whole, of its parts, and of the base of walls, square metres.
    """
    count = len(pixels)
    matrix = np.zeros((count, count))
    for i in range(count):
        for j in range(i + 1):
            dx, dy = pixels[i, 0] - pixels[j, 0], pixels[i, 1] - pixels[j, 1]
            distance_px = np.sqrt(dx * dx + dy * dy)
            scaled_px = np.sqrt(3.0) * distance_px / correlation_px[0]
            value = mask_variances[0] * (1.0 + scaled_px) * np.exp(-scaled_px)
            if buildings[i] == buildings[j]:
                roof = map_variances[0] + map_variances[1] * np.exp(-distance_px / correlation_px[1])
                value += roof_slopes[i] * roof_slopes[j] * roof
                value += base_slopes[i] * base_slopes[j] * map_variances[2]
            matrix[i, j] = value
        matrix[i, i] += mask_variances[1]
    return matrix


@kernel
def whiten(matrix, columns):
    """Divides columns by the Cholesky factor of a matrix, both in place; returns the log determinant.

    On one core and in one order, so that the answer depends on no library's threads.

    Args:
        matrix: (N, N) positive definite; its lower half is overwritten by the factor.
        columns: (N, M) overwritten.
    """
    count = len(matrix)
    pivots = np.empty((_BLOCK, count))
    log_determinant = 0.0
    for first in range(0, count, _BLOCK):
        last = min(first + _BLOCK, count)
        for j in range(first, last):
            root = np.sqrt(matrix[j, j])
            log_determinant += 2.0 * np.log(root)
            columns[j] /= root
            for i in range(j + 1, count):
                matrix[i, j] /= root
                pivots[j - first, i] = matrix[i, j]
                for k in range(j + 1, min(i + 1, last)):
                    matrix[i, k] -= matrix[i, j] * pivots[j - first, k]
            for i in range(j + 1, last):
                _subtract(matrix[i, j], columns[j], 0, columns[i])
        if last - first < _BLOCK:
            break
        for i in range(last, count):
            factors = matrix[i, first], matrix[i, first + 1], matrix[i, first + 2], matrix[i, first + 3]
            _subtract_four(factors, pivots, last, matrix[i, : i + 1])
            _subtract_four(factors, columns[first:last], 0, columns[i])
    return log_determinant


@kernel
def _subtract(factor, row, start, target):
    for k in range(start, len(target)):
        target[k] -= factor * row[k]


@kernel
def _subtract_four(factors, rows, start, target):
    """Takes four multiples of rows from a target in place, one after the other, from some place on."""
    f0, f1, f2, f3 = factors
    r0, r1, r2, r3 = rows[0][start:], rows[1][start:], rows[2][start:], rows[3][start:]
    tail = target[start:]
    # Loops from 0 on are vectorised.
    for k in range(len(tail)):
        value = tail[k] - f0 * r0[k]
        value -= f1 * r1[k]
        value -= f2 * r2[k]
        tail[k] = value - f3 * r3[k]


@kernel
def add_products(columns, share, products):
    """Adds ``share`` times the products of all pairs of columns to the upper half of a matrix in place.

    On one core and in one order, as ``whiten``: matrices this small cost a library more in waking threads.

    Args:
        columns: (N, M).
        share: How much of them.
        products: (M, M).
    """
    count, width = columns.shape
    for first in range(0, count - count % _BLOCK, _BLOCK):
        rows = columns[first : first + _BLOCK]
        for j in range(width):
            factors = -share * rows[0, j], -share * rows[1, j], -share * rows[2, j], -share * rows[3, j]
            _subtract_four(factors, rows, j, products[j])
    for i in range(count - count % _BLOCK, count):
        for j in range(width):
            _subtract(-share * columns[i, j], columns[i], j, products[j])


@kernel
def add_votes(
    positions, ground, heights, rotation, center, intrinsics, mapped, mask, max_range_m, num_views, num_hits
):
    """Counts where a photo sees positions past the map's buildings, and where its mask holds them; in place.

    Args:
        positions: (N, 2) east and north, scene metres.
        ground: (N,) heights of the ground there, scene metres.
        heights: (H,) above the ground that are tried, metres.
        rotation: (3, 3) cam_from_world.
        center: (3,) of the camera.
        intrinsics: Focal lengths and principal point, fx, fy, cx, cy, pixels.
        mapped: (rows, columns) pixels that the map's buildings cover.
        mask: (rows, columns) the mask.
        max_range_m: Positions further off on the ground are left out.
        num_views: (H, N) counts to raise where the position is in view.
        num_hits: (H, N) counts to raise where the mask holds it.
    """
    rows, columns = mapped.shape
    for n in range(len(positions)):
        east, north = positions[n, 0] - center[0], positions[n, 1] - center[1]
        if east * east + north * north >= max_range_m * max_range_m:
            continue
        x = rotation[0, 0] * east + rotation[0, 1] * north
        y = rotation[1, 0] * east + rotation[1, 1] * north
        z = rotation[2, 0] * east + rotation[2, 1] * north
        for level in range(len(heights)):
            up = ground[n] + heights[level] - center[2]
            depth = z + rotation[2, 2] * up
            if depth <= 1.0:
                continue
            u = intrinsics[0] * (x + rotation[0, 2] * up) / depth + intrinsics[2]
            v = intrinsics[1] * (y + rotation[1, 2] * up) / depth + intrinsics[3]
            if u < 0.0 or v < 0.0 or u >= columns or v >= rows or mapped[int(v), int(u)]:
                continue
            num_views[level, n] += 1.0
            if mask[int(v), int(u)]:
                num_hits[level, n] += 1.0


@checked
def minimise_total_variation(costs, column_costs, row_costs, iterations):
    """Returns (H, W) labels in [0, 1] of the least sum of costs times labels and of weighted total variation.

    By the primal-dual algorithm of Chambolle and Pock (2011).

    Args:
        costs: (H, W) float32 of a label of 1.
        column_costs: (H, W) float32 of a step from a column to the next; likewise row_costs.
        row_costs: See column_costs.
        iterations: How many.
    """
    height, width = costs.shape
    step, one, zero = np.float32(0.35), np.float32(1), np.float32(0)
    labels, ahead = np.zeros_like(costs), np.zeros_like(costs)
    column_dual, row_dual = np.zeros_like(costs), np.zeros_like(costs)
    for _ in range(iterations):
        for y in range(height):
            for x in range(width):
                a = column_dual[y, x] + step * (ahead[y, x + 1] - ahead[y, x]) if x < width - 1 else zero
                b = row_dual[y, x] + step * (ahead[y + 1, x] - ahead[y, x]) if y < height - 1 else zero
                norm = max(one, np.sqrt((a / column_costs[y, x]) ** 2 + (b / row_costs[y, x]) ** 2))
                column_dual[y, x], row_dual[y, x] = a / norm, b / norm
        for y in range(height):
            for x in range(width):
                divergence = column_dual[y, x] + row_dual[y, x]
                if x > 0:
                    divergence -= column_dual[y, x - 1]
                if y > 0:
                    divergence -= row_dual[y - 1, x]
                value = min(max(labels[y, x] + step * (divergence - costs[y, x]), zero), one)
                ahead[y, x] = np.float32(2) * value - labels[y, x]
                labels[y, x] = value
    return labels
