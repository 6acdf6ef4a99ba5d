"""The loops over edges and outline points, on one core."""

from __future__ import annotations

import numpy as np
from numba import njit

from lodbench.rendering.projection import camera_axes

# Edges that come nearer to the camera than this are left out, metres.
_NEAR_M = 1.0
# Points keep this far from the image's border, where an outline ends for no reason of its own, pixels.
_BORDER_PX = 2.0


@njit(cache=True, nogil=True, error_model="numpy")
def _is_candidate(edges, e, center):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Tells whether the triangles beside an edge do not cancel out, seen from a centre."""
    total = np.int64(0)
    for k in range(2):
        plane = edges.planes[edges.sides[e, k]]
        height = plane[0] * center[0] + plane[1] * center[1] + plane[2] * center[2] + plane[3]
        sign = np.int64(height > 0.0) - np.int64(height < 0.0)
        total += sign if k == 0 else np.int64(edges.second_weight[e]) * sign
    return total != 0


@njit(cache=True, nogil=True, error_model="numpy")
def _clip(u, v, du, dv, width, height):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns the part (from, to) of a segment that lies well inside the image; empty if from >= to."""
    first, last = 0.0, 1.0
    for step, low, high in (
        (du, _BORDER_PX - u, width - _BORDER_PX - u),
        (dv, _BORDER_PX - v, height - _BORDER_PX - v),
    ):
        if step == 0.0:
            if low > 0.0 or high < 0.0:
                return 1.0, 0.0
            continue
        a, b = low / step, high / step
        first, last = max(first, min(a, b)), min(last, max(a, b))
    return first, last


@njit(cache=True, nogil=True, error_model="numpy")
def _write_moves(rotation, derivatives, f, world, share, row):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Writes how a point's pixel moves with each of the six numbers, and with what else may be wrong.

    Args:
        rotation: (3, 3) cam_from_world.
        derivatives: (3, 3, 3) of it.
        f: fx, fy, cx, cy.
        world: The point less the camera's centre, metres.
        share: How much of a change of the roof's height the point takes part in; the rest is the base's.
        row: (18,) to write into, u and v in turn: the pose, the focal length, roof and base.
    """
    x, y, z = camera_axes(world[0], world[1], world[2], rotation, (0.0, 0.0, 0.0))
    row[12], row[13] = 0.01 * f[0] * x / z, 0.01 * f[1] * y / z
    for k in (0, 1, 2, 3, 4, 5, 7, 8):
        if k < 3:
            dx, dy, dz = -rotation[0, k], -rotation[1, k], -rotation[2, k]
        elif k < 6:
            dx, dy, dz = camera_axes(world[0], world[1], world[2], derivatives[k - 3], (0.0, 0.0, 0.0))
        else:
            part = share if k == 7 else 1.0 - share
            dx, dy, dz = rotation[0, 2] * part, rotation[1, 2] * part, rotation[2, 2] * part
        row[2 * k] = f[0] * (dx - x / z * dz) / z
        row[2 * k + 1] = f[1] * (dy - y / z * dz) / z


@njit(cache=True, nogil=True, error_model="numpy")
def sample_edges(edges, visible, rotation, center, derivatives, f, silhouette, spacing, rows, buildings):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Writes a row per point on the silhouette's outline; returns how many there are.

    Rows hold u, v, the normal, the length, the moves and where the point is east and north, metres. Points
    beyond the room in ``rows`` are counted and not written.
    """
    height, width = silhouette.shape
    count = 0
    for b in visible:
        for e in range(edges.starts[b], edges.starts[b + 1]):
            if not _is_candidate(edges, e, center):
                continue
            tail, head = edges.vertices[edges.corners[e, 0]], edges.vertices[edges.corners[e, 1]]
            xa, ya, za = camera_axes(tail[0], tail[1], tail[2], rotation, center)
            xb, yb, zb = camera_axes(head[0], head[1], head[2], rotation, center)
            if min(za, zb) < _NEAR_M:
                continue
            ua, va = f[0] * xa / za + f[2], f[1] * ya / za + f[3]
            du, dv = f[0] * xb / zb + f[2] - ua, f[1] * yb / zb + f[3] - va
            length = np.sqrt(du * du + dv * dv)
            first, last = _clip(ua, va, du, dv, width, height)
            if first >= last or length < 1e-6:
                continue
            steps = max(1, int(length * (last - first) / spacing + 0.5))
            nx, ny = -dv / length, du / length
            for k in range(steps):
                t = first + (last - first) * (k + 0.5) / steps
                u, v = ua + t * du, va + t * dv
                ahead = silhouette[int(v + ny), int(u + nx)]
                if ahead == silhouette[int(v - ny), int(u - nx)]:
                    continue
                if count < rows.shape[0]:
                    row = rows[count]
                    out = -1.0 if ahead else 1.0
                    row[0], row[1], row[2], row[3] = u, v, nx * out, ny * out
                    row[4] = length * (last - first) / steps
                    # Halfway on the screen is not halfway in space.
                    s = t * za / (t * za + (1.0 - t) * zb)
                    world = (
                        tail[0] + s * (head[0] - tail[0]) - center[0],
                        tail[1] + s * (head[1] - tail[1]) - center[1],
                        tail[2] + s * (head[2] - tail[2]) - center[2],
                    )
                    rise = edges.rises[b]
                    share = (world[2] + center[2] - edges.floors[b]) / rise if rise > 0.0 else 0.0
                    _write_moves(rotation, derivatives, f, world, share, row[5:23])
                    row[23], row[24] = world[0] + center[0], world[1] + center[1]
                    buildings[count] = b
                count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def measure_distances(pixels, normals, moves, distance, residuals, slopes, agreement):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Writes how far inside the query's outline each point lies, and how that changes with the pose.

    Args:
        pixels: (N, 2).
        normals: (N, 2).
        moves: (N, 9, 2).
        distance: (H, W) float32 signed distance to the query's outline, pixels, positive inside.
        residuals: (N,) to write: distance at the point, bilinear.
        slopes: (N, 9) to write: its change per unit of each of the moves.
        agreement: (N,) to write: 1 where the query's outline runs as the silhouette's does, 0 across or
            against it.
    """
    height, width = distance.shape
    for i in range(len(pixels)):
        u, v = pixels[i, 0] - 0.5, pixels[i, 1] - 0.5
        x = min(max(int(np.floor(u)), 0), width - 2)
        y = min(max(int(np.floor(v)), 0), height - 2)
        a, b = u - x, v - y
        d00, d01 = distance[y, x], distance[y, x + 1]
        d10, d11 = distance[y + 1, x], distance[y + 1, x + 1]
        residuals[i] = (1 - b) * ((1 - a) * d00 + a * d01) + b * ((1 - a) * d10 + a * d11)
        gx, gy = (1 - b) * (d01 - d00) + b * (d11 - d10), (1 - a) * (d10 - d00) + a * (d11 - d01)
        agreement[i] = min(1.0, max(0.0, -(gx * normals[i, 0] + gy * normals[i, 1])))
        for k in range(slopes.shape[1]):
            slopes[i, k] = gx * moves[i, k, 0] + gy * moves[i, k, 1]


@njit(cache=True, nogil=True, error_model="numpy")
def building_sums(residuals, slopes, weights, buildings, count):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Returns the sums of weighted products by building: (B, K, K) of slopes, (B, K) with residuals."""
    width = slopes.shape[1]
    products, gradients = np.zeros((count, width, width)), np.zeros((count, width))
    for i in range(len(residuals)):
        b = buildings[i]
        for j in range(width):
            weighted = weights[i] * slopes[i, j]
            gradients[b, j] += weighted * residuals[i]
            for k in range(width):
                products[b, j, k] += weighted * slopes[i, k]
    return products, gradients
