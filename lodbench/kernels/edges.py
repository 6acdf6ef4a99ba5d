"""Edges of a scene in a view, and points along the outline of a silhouette."""

from __future__ import annotations

import numpy as np

from lodbench.kernels.compiled import kernel, part, uncounted
from lodbench.kernels.projection import camera_axes
from lodbench.kernels.raster_rule import NEAR_M

# Pixels between two places of an edge whose depth is looked at.
_STEP_PX = 1.0
# How much nearer than an edge a surface beside it may be without hiding it: so many pixels' footprints, as
# a surface seen at a slant recedes from pixel to pixel; and metres.
_SLACK_PX, _SLACK_M = 3.0, 0.02
# Steps: as far as the 3 x 3 pixels looked at may see past a rim, at a slant.
_LEAST_RUN = 3
# Faces have planes from this height over their edge on.
_NARROWEST_M = 1e-6


@part
def _clipped(a, b, f, width, height):
    """Returns the shares of an edge, camera axes, between which it is in the picture; first > last: never."""
    first, last = 0.0, 1.0
    for plane in range(5):
        if plane == 0:
            da, db = a[2] - NEAR_M, b[2] - NEAR_M
        elif plane < 3:
            da, db = f[0] * a[0] + f[2] * a[2], f[0] * b[0] + f[2] * b[2]
            if plane == 2:
                da, db = width * a[2] - da, width * b[2] - db
        else:
            da, db = f[1] * a[1] + f[3] * a[2], f[1] * b[1] + f[3] * b[2]
            if plane == 4:
                da, db = height * a[2] - da, height * b[2] - db
        if da < 0.0 and db < 0.0:
            return 1.0, 0.0
        if da < 0.0:
            first = max(first, da / (da - db))
        elif db < 0.0:
            last = min(last, da / (da - db))
    return first, last


@part
def _is_contour(a, b, c, d, is_lone):
    """Tells whether both faces beside an edge lie on one side of it as seen; camera axes.

    Faces of published models are oriented at random, so their normals are not asked.
    """
    if is_lone:
        return True
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return (x * c[0] + y * c[1] + z * c[2]) * (x * d[0] + y * d[1] + z * d[2]) > 0.0


@part
def _is_flat(a, b, c, d, cosine):
    """Tells whether the planes of the faces beside an edge meet at an angle of a larger cosine; camera axes.

    A face without a height over the edge is no continuation of the other.
    """
    x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    u, v, w = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    r, s, t = d[0] - a[0], d[1] - a[1], d[2] - a[2]
    p0, p1, p2 = y * w - z * v, z * u - x * w, x * v - y * u
    q0, q1, q2 = y * t - z * s, z * r - x * t, x * s - y * r
    # The faces lie on either side of the edge: normals of those that continue each other are opposite.
    size = np.sqrt((p0 * p0 + p1 * p1 + p2 * p2) * (q0 * q0 + q1 * q1 + q2 * q2))
    # Of a face narrower than a micrometre rounding would decide.
    least = _NARROWEST_M**2 * (x * x + y * y + z * z)
    return p0 * q0 + p1 * q1 + p2 * q2 < -cosine * max(size, least)


@part
def _is_seen(u, v, z, focal, depth):
    """Tells whether nothing hides a place of the picture at a depth: see ``edges_in_view``."""
    least = z - _SLACK_M - _SLACK_PX * z / focal
    row, column = int(np.floor(v)), int(np.floor(u))
    for i in range(row - 1, row + 2):
        for j in range(column - 1, column + 2):
            is_inside = 0 <= i < depth.shape[0] and 0 <= j < depth.shape[1]
            if is_inside and (depth[i, j] == 0.0 or depth[i, j] >= least):
                return True
    return False


@part
def _look_along(line, steps, focal, depth, seen):
    """Writes for each step along a line of the picture whether it is seen.

    Args:
        line: Column, row and depth where it begins, and where it ends.
        steps: How many.
        focal: Pixels.
        depth: (H, W) metres.
        seen: (steps or more,) bool.
    """
    ua, va, za, ub, vb, zb = line
    for k in range(steps):
        place = (k + 0.5) / steps
        z = 1.0 / ((1.0 - place) / za + place / zb)
        seen[k] = _is_seen(ua + place * (ub - ua), va + place * (vb - va), z, focal, depth)
    # What shows for no longer than the neighbourhood looked at is beside the rim of what hides the rest.
    run = 0
    for k in range(steps + 1):
        if k < steps and seen[k]:
            run += 1
            continue
        if run <= _LEAST_RUN and run < steps:
            for i in range(k - run, k):
                seen[i] = False
        run = 0


@uncounted
def cut_and_test(edges, buildings, rotation, center, f, depth, crease_deg, seen, shares, pixels, rows):
    """Writes of each piece: shares of its edge, pixels, (edge, is visible, kind, building); returns how many.

    Pieces beyond the room in ``rows`` are counted and not written. ``seen`` is (H + W + 2) bool or more.
    """
    count = 0
    height, width = depth.shape
    flattest = np.cos(np.radians(crease_deg))
    for building in buildings:
        for e in range(edges.starts[building], edges.starts[building + 1]):
            p, q = edges.ends[e, 0], edges.ends[e, 1]
            a = camera_axes(p[0], p[1], p[2], rotation, center)
            b = camera_axes(q[0], q[1], q[2], rotation, center)
            first, last = _clipped(a, b, f, width, height)
            if first >= last:
                continue
            s, t = edges.beside[e, 0], edges.beside[e, 1]
            c = camera_axes(s[0], s[1], s[2], rotation, center)
            d = camera_axes(t[0], t[1], t[2], rotation, center)
            is_contour = _is_contour(a, b, c, d, edges.is_lone[e])
            is_certain = is_contour or edges.is_crowded[e] or crease_deg <= 0.0
            if not is_certain and _is_flat(a, b, c, d, flattest):
                continue
            za, zb = a[2] + first * (b[2] - a[2]), a[2] + last * (b[2] - a[2])
            ua = f[0] * (a[0] + first * (b[0] - a[0])) / za + f[2]
            va = f[1] * (a[1] + first * (b[1] - a[1])) / za + f[3]
            ub = f[0] * (a[0] + last * (b[0] - a[0])) / zb + f[2]
            vb = f[1] * (a[1] + last * (b[1] - a[1])) / zb + f[3]
            line = (ua, va, za, ub, vb, zb)
            steps = max(1, int(np.ceil(np.hypot(ub - ua, vb - va) / _STEP_PX)))
            _look_along(line, steps, min(f[0], f[1]), depth, seen)
            begin = 0
            for k in range(1, steps + 1):
                if k < steps and seen[k] == seen[begin]:
                    continue
                for end in range(2 if count < rows.shape[0] else 0):
                    place = (k if end else begin) / steps
                    # Along the line in the picture 1 / z is linear; the share of the edge follows it.
                    z = 1.0 / ((1.0 - place) / za + place / zb)
                    shares[count, end] = first + (last - first) * place * z / zb
                    pixels[count, end, 0] = ua + place * (ub - ua)
                    pixels[count, end, 1] = va + place * (vb - va)
                if count < rows.shape[0]:
                    rows[count, 0], rows[count, 1], rows[count, 2] = e, seen[begin], is_contour
                    rows[count, 3] = building
                count += 1
                begin = k
    return count


# Edges that come nearer to the camera than this are left out, metres.
_NEAREST_EDGE_M = 1.0
# Points keep this far from the image's border, where an outline ends for no reason of its own, pixels.
_BORDER_PX = 2.0


@part
def _is_candidate(edges, e, center):
    """Tells whether the triangles beside an edge do not cancel out, seen from a centre."""
    total = np.int64(0)
    for k in range(2):
        plane = edges.planes[edges.sides[e, k]]
        height = plane[0] * center[0] + plane[1] * center[1] + plane[2] * center[2] + plane[3]
        sign = np.int64(height > 0.0) - np.int64(height < 0.0)
        total += sign if k == 0 else np.int64(edges.second_weight[e]) * sign
    return total != 0


@part
def _clip(u, v, du, dv, width, height):
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


@part
def _write_moves(rotation, derivatives, f, world, share, row):
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


@uncounted
def sample_edges(edges, visible, rotation, center, derivatives, f, silhouette, spacing, rows, buildings):
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
            if min(za, zb) < _NEAREST_EDGE_M:
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


@uncounted
def measure_distances(pixels, normals, moves, distance, residuals, slopes, agreement):
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


@kernel
def building_sums(residuals, slopes, weights, buildings, count):
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
