"""Edges of a scene in a view, and points along the outline of a silhouette."""

from __future__ import annotations

import numpy as np

from lodbench.kernels.arguments import NEAR_M
from lodbench.kernels.compiled import kernel, part, uncounted
from lodbench.kernels.projection import camera_axes

# Distance of the samples along an edge whose depth is tested, pixels.
_SAMPLE_PX = 1.0
# How much nearer than an edge a surface beside it may be without hiding it: so many pixels' footprints, as
# a surface seen at a slant recedes from pixel to pixel; and metres.
_SLACK_PX, _SLACK_M = 3.0, 0.02
# Samples that may be visible past the rim of what hides the rest, through the 3 x 3 pixels of a test.
_MIN_RUN = 3
# A face of less height over its edge has no plane.
_MIN_FACE_HEIGHT_M = 1e-6


@part
def _clip_to_frustum(a, b, f, width, height):
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
def _is_contour(a, b, c, d, is_boundary):
    """Tells whether both faces beside an edge lie on one side of it as seen; camera axes.

    Faces of published models are oriented at random, so their normals are not asked.
    """
    if is_boundary:
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
    least = _MIN_FACE_HEIGHT_M**2 * (x * x + y * y + z * z)
    return p0 * q0 + p1 * q1 + p2 * q2 < -cosine * max(size, least)


@part
def _is_visible(u, v, z, focal, depth):
    """Tells whether nothing hides a point of the picture at a depth: see ``edges_in_view``."""
    min_depth = z - _SLACK_M - _SLACK_PX * z / focal
    row, column = int(np.floor(v)), int(np.floor(u))
    for i in range(row - 1, row + 2):
        for j in range(column - 1, column + 2):
            is_inside = 0 <= i < depth.shape[0] and 0 <= j < depth.shape[1]
            if is_inside and (depth[i, j] == 0.0 or depth[i, j] >= min_depth):
                return True
    return False


@part
def _test_visibility(line, steps, focal, depth, visible):
    """Writes for each step along a line of the picture whether it is visible.

    Args:
        line: Column, row and depth where it begins, and where it ends.
        steps: How many.
        focal: Pixels.
        depth: (H, W) metres.
        visible: (steps or more,) bool.
    """
    ua, va, za, ub, vb, zb = line
    for k in range(steps):
        fraction = (k + 0.5) / steps
        z = 1.0 / ((1.0 - fraction) / za + fraction / zb)
        visible[k] = _is_visible(ua + fraction * (ub - ua), va + fraction * (vb - va), z, focal, depth)
    # What shows for no longer than the neighbourhood tested is beside the rim of what hides the rest.
    run = 0
    for k in range(steps + 1):
        if k < steps and visible[k]:
            run += 1
            continue
        if run <= _MIN_RUN and run < steps:
            for i in range(k - run, k):
                visible[i] = False
        run = 0


@uncounted
def split_edges(edges, buildings, rotation, center, f, depth, crease_deg, visible, fractions, pixels, rows):
    """Writes each piece's edge fractions, pixels, (edge, is visible, kind, building); returns how many.

    Pieces beyond the room in ``rows`` are counted and not written. ``visible`` is (H + W + 2) bool or more.
    """
    count = 0
    height, width = depth.shape
    min_cosine = np.cos(np.radians(crease_deg))
    for building in buildings:
        for e in range(edges.starts[building], edges.starts[building + 1]):
            p, q = edges.ends[e, 0], edges.ends[e, 1]
            a = camera_axes(p[0], p[1], p[2], rotation, center)
            b = camera_axes(q[0], q[1], q[2], rotation, center)
            first, last = _clip_to_frustum(a, b, f, width, height)
            if first >= last:
                continue
            s, t = edges.opposite[e, 0], edges.opposite[e, 1]
            c = camera_axes(s[0], s[1], s[2], rotation, center)
            d = camera_axes(t[0], t[1], t[2], rotation, center)
            is_contour = _is_contour(a, b, c, d, edges.is_boundary[e])
            is_kept = is_contour or edges.is_non_manifold[e] or crease_deg <= 0.0
            if not is_kept and _is_flat(a, b, c, d, min_cosine):
                continue
            za, zb = a[2] + first * (b[2] - a[2]), a[2] + last * (b[2] - a[2])
            ua = f[0] * (a[0] + first * (b[0] - a[0])) / za + f[2]
            va = f[1] * (a[1] + first * (b[1] - a[1])) / za + f[3]
            ub = f[0] * (a[0] + last * (b[0] - a[0])) / zb + f[2]
            vb = f[1] * (a[1] + last * (b[1] - a[1])) / zb + f[3]
            segment = (ua, va, za, ub, vb, zb)
            steps = max(1, int(np.ceil(np.hypot(ub - ua, vb - va) / _SAMPLE_PX)))
            _test_visibility(segment, steps, min(f[0], f[1]), depth, visible)
            begin = 0
            for k in range(1, steps + 1):
                if k < steps and visible[k] == visible[begin]:
                    continue
                for end in range(2 if count < rows.shape[0] else 0):
                    fraction = (k if end else begin) / steps
                    # Along the line in the picture 1 / z is linear; the fraction of the edge follows it.
                    z = 1.0 / ((1.0 - fraction) / za + fraction / zb)
                    fractions[count, end] = first + (last - first) * fraction * z / zb
                    pixels[count, end, 0] = ua + fraction * (ub - ua)
                    pixels[count, end, 1] = va + fraction * (vb - va)
                if count < rows.shape[0]:
                    rows[count, 0], rows[count, 1], rows[count, 2] = e, visible[begin], is_contour
                    rows[count, 3] = building
                count += 1
                begin = k
    return count


# Edges that come nearer to the camera than this are left out, metres.
_MIN_EDGE_DEPTH_M = 1.0
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
def _clip_to_image(u, v, du, dv, width, height):
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
def _write_pixel_derivatives(rotation, rotation_slopes, f, offset, roof_share, row):
    """Writes the derivatives of a point's pixel by the pose, the focal length and the map's heights.

    Args:
        rotation: (3, 3) cam_from_world.
        rotation_slopes: (3, 3, 3) of it.
        f: fx, fy, cx, cy.
        offset: The point less the camera's centre, metres.
        roof_share: How much of a metre that the roof is higher the point moves up; with the base the rest.
        row: (18,) to write, u and v in turn: six of the pose, focal length (per cent), roof, base (metres).
    """
    x, y, z = camera_axes(offset[0], offset[1], offset[2], rotation, (0.0, 0.0, 0.0))
    row[12], row[13] = 0.01 * f[0] * x / z, 0.01 * f[1] * y / z
    for k in (0, 1, 2, 3, 4, 5, 7, 8):
        if k < 3:
            dx, dy, dz = -rotation[0, k], -rotation[1, k], -rotation[2, k]
        elif k < 6:
            dx, dy, dz = camera_axes(offset[0], offset[1], offset[2], rotation_slopes[k - 3], (0.0, 0.0, 0.0))
        else:
            share = roof_share if k == 7 else 1.0 - roof_share
            dx, dy, dz = rotation[0, 2] * share, rotation[1, 2] * share, rotation[2, 2] * share
        row[2 * k] = f[0] * (dx - x / z * dz) / z
        row[2 * k + 1] = f[1] * (dy - y / z * dz) / z


@uncounted
def sample_edges(edges, visible, rotation, center, rotation_slopes, f, silhouette, spacing, rows, buildings):
    """Writes a row per point on the silhouette's outline; returns how many there are.

    Rows hold u, v, the normal, the length, the pixel's derivatives and the point's east and north, metres.
    Points beyond the room in ``rows`` are counted and not written.
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
            if min(za, zb) < _MIN_EDGE_DEPTH_M:
                continue
            ua, va = f[0] * xa / za + f[2], f[1] * ya / za + f[3]
            du, dv = f[0] * xb / zb + f[2] - ua, f[1] * yb / zb + f[3] - va
            length = np.sqrt(du * du + dv * dv)
            first, last = _clip_to_image(ua, va, du, dv, width, height)
            if first >= last or length < 1e-6:
                continue
            steps = max(1, int(length * (last - first) / spacing + 0.5))
            nx, ny = -dv / length, du / length
            for k in range(steps):
                t = first + (last - first) * (k + 0.5) / steps
                u, v = ua + t * du, va + t * dv
                is_set_ahead = silhouette[int(v + ny), int(u + nx)]
                if is_set_ahead == silhouette[int(v - ny), int(u - nx)]:
                    continue
                if count < rows.shape[0]:
                    row = rows[count]
                    sign = -1.0 if is_set_ahead else 1.0
                    row[0], row[1], row[2], row[3] = u, v, nx * sign, ny * sign
                    row[4] = length * (last - first) / steps
                    # Halfway on the screen is not halfway in space.
                    s = t * za / (t * za + (1.0 - t) * zb)
                    offset = (
                        tail[0] + s * (head[0] - tail[0]) - center[0],
                        tail[1] + s * (head[1] - tail[1]) - center[1],
                        tail[2] + s * (head[2] - tail[2]) - center[2],
                    )
                    height_m, above_base_m = edges.heights[b], offset[2] + center[2] - edges.base_heights[b]
                    roof_share = above_base_m / height_m if height_m > 0.0 else 0.0
                    _write_pixel_derivatives(rotation, rotation_slopes, f, offset, roof_share, row[5:23])
                    row[23], row[24] = offset[0] + center[0], offset[1] + center[1]
                    buildings[count] = b
                count += 1
    return count


@uncounted
def measure_distances(pixels, normals, pixel_derivatives, distance, residuals, slopes, agreement):
    """Writes how far inside the query's outline each point lies, and how that changes with the pose.

    Args:
        pixels: (N, 2).
        normals: (N, 2).
        pixel_derivatives: (N, 9, 2), see ``OutlinePoints.moves``.
        distance: (H, W) float32 signed distance to the query's outline, pixels, positive inside.
        residuals: (N,) to write: distance at the point, bilinear.
        slopes: (N, 9) to write: its derivatives by the same parameters.
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
            slopes[i, k] = gx * pixel_derivatives[i, k, 0] + gy * pixel_derivatives[i, k, 1]


@kernel
def normal_equations(residuals, slopes, weights, buildings, count):
    """Returns the normal equations of each building: (B, K, K) matrices, (B, K) gradients."""
    num_slopes = slopes.shape[1]
    normal_matrices, gradients = np.zeros((count, num_slopes, num_slopes)), np.zeros((count, num_slopes))
    for i in range(len(residuals)):
        b = buildings[i]
        for j in range(num_slopes):
            weighted_slope = weights[i] * slopes[i, j]
            gradients[b, j] += weighted_slope * residuals[i]
            for k in range(num_slopes):
                normal_matrices[b, j, k] += weighted_slope * slopes[i, k]
    return normal_matrices, gradients
