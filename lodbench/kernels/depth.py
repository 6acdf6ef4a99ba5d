"""The z-buffer's hot loop: one band of columns of one view, on one core.

Columns lie along memory, because the raster rule gives each triangle one run of rows per column.
"""

from __future__ import annotations

import numpy as np

from lodbench.kernels.arguments import GUARD_PX, NEAR_M
from lodbench.kernels.compiled import checked, inlined, part, uncounted
from lodbench.kernels.projection import camera_axes, clip_polygon, is_outside, snap

# A triangle whose snapped corners all stay this far inside the guard band needs no clipping.
_SAFE_SUBPIXELS = (GUARD_PX - 2.0) * 256.0
# Inverse depths closer than this, relative, are one depth: rounding differs between two copies of a
# face that start at different corners, and the first copy is to win everywhere.
_NEARER_FACTOR = 1.0 + 1e-9


@inlined
def _depth_plane(a, b, c, f):
    """Returns (p, q, s) with 1 / z = p * column + q * row + s over the plane of three corners.

    The corners are not snapped: depth is where the ray through the pixel's centre meets the plane.
    Seen edge-on there is no such place, and s is infinite: the fill then takes the nearest corner.
    """
    e0, e1, e2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    g0, g1, g2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    nx, ny, nz = e1 * g2 - e2 * g1, e2 * g0 - e0 * g2, e0 * g1 - e1 * g0
    scale = 1.0 / (nx * a[0] + ny * a[1] + nz * a[2])
    p, q = nx * scale / f[0], ny * scale / f[1]
    s = nz * scale - p * f[2] - q * f[3]
    if np.isfinite(p) and np.isfinite(q) and np.isfinite(s):
        return p, q, s
    return 0.0, 0.0, np.inf


@inlined
def _first_row(x, ua, va, ub, vb):
    """Returns the first row whose centre is at or below where an edge, ua < ub, crosses column centre x.

    It is ``ceil(n / d)`` of integers, found exactly: see ``set_up_lines``.
    """
    du = ub - ua
    d = 256.0 * du
    n = (va - 128.0) * du + (x - ua) * (vb - va)
    return np.int64(np.floor((n + d - 0.5) * (1.0 / d)))


@part
def _fill_triangle(u, v, z, plane, triangle, band, buffer):
    """Draws a triangle of three snapped corners (raster rule 4); z bounds the depth.

    Rows and columns are bounded as integers, so no corner, however wrong, leads out of the buffer.
    """
    left, middle, right = 0, 1, 2
    if u[left] > u[middle]:
        left, middle = middle, left
    if u[middle] > u[right]:
        middle, right = right, middle
    if u[left] > u[middle]:
        left, middle = middle, left
    nearest, furthest = 1.0 / min(z[0], z[1], z[2]), 1.0 / max(z[0], z[1], z[2])
    first = max(band.first, np.int64(np.ceil((u[left] - 128.0) * (1.0 / 256.0))))
    stop = min(band.stop, np.int64(np.ceil((u[right] - 128.0) * (1.0 / 256.0))))
    for column in range(first, stop):
        x = 256.0 * column + 128.0
        a, b = (left, middle) if x < u[middle] else (middle, right)
        first_row = _first_row(x, u[left], v[left], u[right], v[right])
        second_row = _first_row(x, u[a], v[a], u[b], v[b])
        top, bottom = max(0, min(first_row, second_row)), min(band.height, max(first_row, second_row))
        inverse, triangles = buffer.inverse[column - band.first], buffer.triangle[column - band.first]
        start = plane[0] * (column + 0.5) + plane[2]
        for row in range(top, bottom):
            # Snapping may let a pixel in whose ray just misses the triangle: stay within its depths.
            inverse_depth = min(max(start + plane[1] * (row + 0.5), furthest), nearest)
            is_nearer = inverse_depth > inverse[row] * _NEARER_FACTOR
            inverse[row] = inverse_depth if is_nearer else inverse[row]
            triangles[row] = triangle if is_nearer else triangles[row]


@part
def _fill_clipped(a, b, c, plane, triangle, band, buffer, polygon, scratch):
    """Draws what clipping leaves of a triangle, as a fan (raster rule 2)."""
    f = band.intrinsics
    for axis in range(3):
        polygon[0, axis], polygon[1, axis], polygon[2, axis] = a[axis], b[axis], c[axis]
    corners = clip_polygon(polygon, 3, scratch, f)
    p = polygon
    for i in range(1, corners - 1):
        u0, v0 = snap(p[0, 0], p[0, 1], p[0, 2], f)
        u1, v1 = snap(p[i, 0], p[i, 1], p[i, 2], f)
        u2, v2 = snap(p[i + 1, 0], p[i + 1, 1], p[i + 1, 2], f)
        z = (p[0, 2], p[i, 2], p[i + 1, 2])
        _fill_triangle((u0, u1, u2), (v0, v1, v2), z, plane, triangle, band, buffer)


@part
def _project(vertices, rotation, center, f, points):
    """Writes x, y, z in camera axes and the snapped u, v of each vertex to ``points``."""
    for k in range(vertices.shape[0]):
        x, y, z = camera_axes(vertices[k, 0], vertices[k, 1], vertices[k, 2], rotation, center)
        points[k, 0], points[k, 1], points[k, 2] = x, y, z
        points[k, 3], points[k, 4] = snap(x, y, z, f)


@part
def _draw_triangle(a, b, c, triangle, band, buffer, polygon, scratch):
    """Draws a triangle of three rows of ``_project``, clipped if it reaches out of the safe space."""
    f = band.intrinsics
    left, right = min(a[3], b[3], c[3]), max(a[3], b[3], c[3])
    top, bottom = min(a[4], b[4], c[4]), max(a[4], b[4], c[4])
    is_safe = min(a[2], b[2], c[2]) >= NEAR_M
    is_safe &= min(left, top) >= -_SAFE_SUBPIXELS and max(right, bottom) <= _SAFE_SUBPIXELS
    if not is_safe:
        if max(a[2], b[2], c[2]) >= NEAR_M:
            plane = _depth_plane(a, b, c, f)
            _fill_clipped(a, b, c, plane, triangle, band, buffer, polygon, scratch)
        return
    is_seen = right > 256.0 * band.first and left < 256.0 * band.stop
    if is_seen and bottom > 0.0 and top < 256.0 * band.height:
        plane = _depth_plane(a, b, c, f)
        u, v, z = (a[3], b[3], c[3]), (a[4], b[4], c[4]), (a[2], b[2], c[2])
        _fill_triangle(u, v, z, plane, triangle, band, buffer)


@uncounted
def draw_band(mesh, buildings, rotation, center, band, buffer, points, polygons):
    """Draws some buildings into the blank buffer of a band: the nearest triangle of every pixel.

    Args:
        mesh: Mesh.
        buildings: (N,) int64 indices, ascending; others are not drawn.
        rotation: (3, 3) float64 cam_from_world.
        center: (3,) float64 camera centre, local metres.
        band: Band.
        buffer: Buffer of the band's size.
        points: (V, 5) float64 room for the vertices of the largest building.
        polygons: (2, MAX_CORNERS, 3) float64 room for a triangle that is clipped.
    """
    polygon, scratch = polygons[0], polygons[1]
    for b in buildings:
        s = mesh.spheres[b]
        if is_outside((s[0], s[1], s[2], s[3]), rotation, center, band.planes):
            continue
        v0, v1 = mesh.vertex_starts[b], mesh.vertex_starts[b + 1]
        _project(mesh.vertices[v0:v1], rotation, center, band.intrinsics, points)
        for t in range(mesh.triangle_starts[b], mesh.triangle_starts[b + 1]):
            i, j, k = mesh.triangles[t, 0] - v0, mesh.triangles[t, 1] - v0, mesh.triangles[t, 2] - v0
            _draw_triangle(points[i], points[j], points[k], np.int32(t), band, buffer, polygon, scratch)


@part
def _facing_normal(mesh, triangle, center):
    """Returns a triangle's unit normal on the side of a point, or zeros if it has no area."""
    i, j, k = mesh.triangles[triangle]
    a, b, c = mesh.vertices[i], mesh.vertices[j], mesh.vertices[k]
    e0, e1, e2 = np.float64(b[0]) - a[0], np.float64(b[1]) - a[1], np.float64(b[2]) - a[2]
    g0, g1, g2 = np.float64(c[0]) - a[0], np.float64(c[1]) - a[1], np.float64(c[2]) - a[2]
    x, y, z = e1 * g2 - e2 * g1, e2 * g0 - e0 * g2, e0 * g1 - e1 * g0
    length = np.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return 0.0, 0.0, 0.0
    towards = x * (center[0] - a[0]) + y * (center[1] - a[1]) + z * (center[2] - a[2])
    scale = 1.0 / length if towards >= 0.0 else -1.0 / length
    return x * scale, y * scale, z * scale


@part
def _shade(appearance, building, x, y, z):
    """Returns the RGB of a building's surface of a given normal: Lambert's law and ambient light."""
    # Neighbours in the file are neighbours on the ground: a hash keeps them from looking alike.
    number = (building * 2654435761 >> 8) & 0xFFFF
    table = appearance.roofs if abs(z) > 0.3 else appearance.walls
    rgb = table[number % table.shape[0]]
    sun = appearance.sun
    light = appearance.ambient + (1.0 - appearance.ambient) * max(0.0, x * sun[0] + y * sun[1] + z * sun[2])
    return np.uint8(rgb[0] * light), np.uint8(rgb[1] * light), np.uint8(rgb[2] * light)


@uncounted
def resolve_depth(band, buffer, depth):
    """Writes a band's columns of (H, W) float32 depth."""
    for row in range(band.height):
        for column in range(band.first, band.stop):
            inverse = buffer.inverse[column - band.first, row]
            depth[row, column] = 1.0 / inverse if inverse > 0.0 else 0.0


@uncounted
def resolve_normals(mesh, center, band, buffer, normal):
    """Writes a band's columns of (H, W, 3) float32 normals."""
    last_triangle = np.int32(-1)
    nx = ny = nz = 0.0
    for row in range(band.height):
        for column in range(band.first, band.stop):
            triangle = buffer.triangle[column - band.first, row]
            if triangle != last_triangle:
                last_triangle = triangle
                nx = ny = nz = 0.0
                if triangle >= 0:
                    nx, ny, nz = _facing_normal(mesh, triangle, center)
            normal[row, column, 0], normal[row, column, 1], normal[row, column, 2] = nx, ny, nz


@uncounted
def resolve_buildings(mesh, band, buffer, building):
    """Writes a band's columns of (H, W) int32 indices of buildings, -1 for none."""
    last_triangle, number = np.int32(-1), np.int64(-1)
    for row in range(band.height):
        for column in range(band.first, band.stop):
            triangle = buffer.triangle[column - band.first, row]
            if triangle != last_triangle:
                last_triangle, number = triangle, np.int64(-1)
                if triangle >= 0:
                    number = np.searchsorted(mesh.triangle_starts, triangle, side="right") - 1
            building[row, column] = number


@uncounted
def resolve_layers(mesh, appearance, center, band, buffer, layers):
    """Writes a band's columns of every layer.

    Pixels of a row mostly repeat their left neighbour's triangle, so what belongs to a triangle is
    worked out when it changes.
    """
    resolve_depth(band, buffer, layers.depth)
    last_triangle, building = np.int32(-1), np.int64(-1)
    nx = ny = nz = 0.0
    red, green, blue = appearance.background[0], appearance.background[1], appearance.background[2]
    for row in range(band.height):
        for column in range(band.first, band.stop):
            triangle = buffer.triangle[column - band.first, row]
            if triangle != last_triangle:
                last_triangle, building = triangle, np.int64(-1)
                nx = ny = nz = 0.0
                red, green, blue = appearance.background
                if triangle >= 0:
                    building = np.searchsorted(mesh.triangle_starts, triangle, side="right") - 1
                    nx, ny, nz = _facing_normal(mesh, triangle, center)
                    red, green, blue = _shade(appearance, building, nx, ny, nz)
            layers.triangle[row, column], layers.building[row, column] = triangle, building
            layers.normal[row, column, 0] = nx
            layers.normal[row, column, 1] = ny
            layers.normal[row, column, 2] = nz
            layers.colour[row, column, 0] = red
            layers.colour[row, column, 1] = green
            layers.colour[row, column, 2] = blue


@checked
def fill_rays(x, y, r, center, rays):
    """Writes the rays through columns x and rows y, in camera axes at 1 m, of a pose."""
    for i in range(y.shape[0]):
        for j in range(x.shape[0]):
            for k in range(3):
                # The transposed rotation, applied to (x, y, 1).
                along = x[j] * r[0, k] + y[i] * r[1, k] + r[2, k]
                rays[i, j, k] = center[k] + NEAR_M * along
                rays[i, j, 3 + k] = along
