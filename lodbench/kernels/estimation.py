"""Least squares under correlated errors, votes for places, and the least total variation."""

from __future__ import annotations

import numpy as np

from lodbench.kernels.compiled import checked, kernel

# Columns that are eliminated at once: a matrix of 250 rows is larger than a core's first cache, and each pass
# over it fetches all of it anew. Each number is changed in the same order as one by one.
_BLOCK = 4


@kernel
def error_covariance(pixels, rises, feet, buildings, noise, lengths, errors):
    """Returns the lower half of the points' error covariance, (N, N) square pixels.

    The mask's outline errs alike at points near each other in the picture: a curve that bends, without
    kinks (Matern's correlation of order 3/2). A building's roof errs as a
    whole, and by parts: alike at points near each other. So does where its walls end, as a whole.

    Args:
        pixels: (N, 2) points.
        rises: (N,) how a distance changes per metre that the roof is higher.
        feet: (N,) how it changes per metre that the base is.
        buildings: (N,) which.
        noise: Square pixels of the outline's error that goes together, and of its rest.
        lengths: Pixels over which the outline's error goes together, and a roof's.
        errors: Square metres of a roof's error as a whole, by parts, and of a base's.
    """
    count = len(pixels)
    matrix = np.zeros((count, count))
    for i in range(count):
        for j in range(i + 1):
            dx, dy = pixels[i, 0] - pixels[j, 0], pixels[i, 1] - pixels[j, 1]
            apart = np.sqrt(dx * dx + dy * dy)
            lags = np.sqrt(3.0) * apart / lengths[0]
            value = noise[0] * (1.0 + lags) * np.exp(-lags)
            if buildings[i] == buildings[j]:
                value += rises[i] * rises[j] * (errors[0] + errors[1] * np.exp(-apart / lengths[1]))
                value += feet[i] * feet[j] * errors[2]
            matrix[i, j] = value
        matrix[i, i] += noise[1]
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
    one, two, three, four = factors
    first, second, third, fourth = rows[0][start:], rows[1][start:], rows[2][start:], rows[3][start:]
    rest = target[start:]
    # Loops from 0 on are vectorised.
    for k in range(len(rest)):
        value = rest[k] - one * first[k]
        value -= two * second[k]
        value -= three * third[k]
        rest[k] = value - four * fourth[k]


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
def add_votes(places, ground, heights, rotation, center, lens, covered, shown, furthest_m, looks, hits):
    """Counts where a photo sees places past the map's buildings, and where its mask holds them; in place.

    Args:
        places: (N, 2) east and north, scene metres.
        ground: (N,) heights of the ground there, scene metres.
        heights: (H,) above it at which each is looked for, metres.
        rotation: (3, 3) cam_from_world.
        center: (3,) of the camera.
        lens: Focal lengths and principal point, fx, fy, cx, cy, pixels.
        covered: (rows, columns) what the map explains.
        shown: (rows, columns) the mask.
        furthest_m: Places further off on the ground are left out.
        looks: (H, N) added to where the place is seen.
        hits: (H, N) added to where the mask holds it.
    """
    rows, columns = covered.shape
    for n in range(len(places)):
        east, north = places[n, 0] - center[0], places[n, 1] - center[1]
        if east * east + north * north >= furthest_m * furthest_m:
            continue
        x = rotation[0, 0] * east + rotation[0, 1] * north
        y = rotation[1, 0] * east + rotation[1, 1] * north
        z = rotation[2, 0] * east + rotation[2, 1] * north
        for level in range(len(heights)):
            up = ground[n] + heights[level] - center[2]
            depth = z + rotation[2, 2] * up
            if depth <= 1.0:
                continue
            u = lens[0] * (x + rotation[0, 2] * up) / depth + lens[2]
            v = lens[1] * (y + rotation[1, 2] * up) / depth + lens[3]
            if u < 0.0 or v < 0.0 or u >= columns or v >= rows or covered[int(v), int(u)]:
                continue
            looks[level, n] += 1.0
            if shown[int(v), int(u)]:
                hits[level, n] += 1.0


@checked
def least_total(against, beside, upright, iterations):
    """Returns (H, W) in [0, 1] with the least sum of ``against`` times it and the costs of its steps."""
    height, width = against.shape
    step, one, zero = np.float32(0.35), np.float32(1), np.float32(0)
    answer, ahead = np.zeros_like(against), np.zeros_like(against)
    across, down = np.zeros_like(against), np.zeros_like(against)
    for _ in range(iterations):
        for y in range(height):
            for x in range(width):
                a = across[y, x] + step * (ahead[y, x + 1] - ahead[y, x]) if x < width - 1 else zero
                b = down[y, x] + step * (ahead[y + 1, x] - ahead[y, x]) if y < height - 1 else zero
                norm = max(one, np.sqrt((a / beside[y, x]) ** 2 + (b / upright[y, x]) ** 2))
                across[y, x], down[y, x] = a / norm, b / norm
        for y in range(height):
            for x in range(width):
                flow = across[y, x] + down[y, x]
                if x > 0:
                    flow -= across[y, x - 1]
                if y > 0:
                    flow -= down[y - 1, x]
                value = min(max(answer[y, x] + step * (flow - against[y, x]), zero), one)
                ahead[y, x] = np.float32(2) * value - answer[y, x]
                answer[y, x] = value
    return answer
