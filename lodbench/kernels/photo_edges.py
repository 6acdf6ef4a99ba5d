"""Edges of a photo by direction, and what a model's lines find in them, for many poses at a time."""

from __future__ import annotations

import numpy as np

from lodbench.kernels.arguments import DIRECTIONS, FINE_STEPS, FINEST
from lodbench.kernels.compiled import inlined, kernel, per_pixel, uncounted


@inlined
def _room(count):
    """Returns room for what so many poses see of a point.

    x, y, z of a line's point in camera axes and z of its nearer end; a direction in the picture across the
    line; where in the picture the camera's axis is taken to be, pixels; which of the 12 directions the line
    has; and which of all levels the point meets, or -1.
    """
    # Made here: of arrays that are handed in a compiler cannot know that they do not overlap, and works on
    # one pose at a time.
    seen = (np.empty(count), np.empty(count), np.empty(count), np.empty(count))
    across, starts = (np.empty(count), np.empty(count)), (np.empty(count), np.empty(count))
    return seen, across, starts, np.empty(count, np.int64), np.empty(count, np.int64)


@uncounted
def looked_up(forms, turns, table, levels):
    """Writes (H, W, 12) uint8 levels of quadratic forms (H, W, 3) of directions (12, 3)."""
    height, width = forms.shape[:2]
    for row in range(height):
        for column in range(width):
            form = forms[row, column]
            for k in range(len(turns)):
                square = form[0] * turns[k, 0] + form[1] * turns[k, 1] + form[2] * turns[k, 2]
                step = np.sqrt(max(square, 0.0)) * FINE_STEPS
                levels[row, column, k] = table[int(min(step, FINEST))]


# Cosine and sine of the angles between one direction and the next.
_COSINES, _SINES = (turn((np.arange(DIRECTIONS) + 0.5) * (np.pi / DIRECTIONS)) for turn in (np.cos, np.sin))
# What is nearer is not looked at, metres.
_NEAREST_M = 1.0


@kernel
def sum_along_lines(lines, poses, intrinsics, levels, shape, own_m, worth, sums):
    """Adds up what the levels are worth that points of lines meet in a photo; outside is worth nothing.

    For N poses, and for each building by itself at D heights of its roof.

    Args:
        lines: Their P points.
        poses: LinePoses, N of them.
        intrinsics: fx, fy, cx, cy.
        levels: (H * W * 12,) uint8 of ``directed_edge_levels``.
        shape: H, W, 12.
        own_m: (D,) how much higher than that the building's own roof is, metres.
        worth: (K, 16) float64 of each level, by the points' kinds.
        sums: (N, B, D) float64 to add to.
    """
    points, rises, lifts, outward, kinds, buildings = lines
    turns, places, of_all = poses
    count = len(turns[0])
    seen, across, starts, directions, cells = _room(count)
    for n in range(count):
        starts[0][n], starts[1][n] = intrinsics[2], intrinsics[3]
    for i in range(len(points)):
        rise, building, values = rises[i, 0], buildings[i], worth[kinds[i]]
        _see_lines(points[i], rises[i], lifts[i], outward[i], turns, places, of_all, intrinsics, seen, across)
        _find_directions(across, directions)
        # Feet of walls stay where they are, however high the roof.
        heights = len(own_m) if rise != 0.0 else 1
        for d in range(heights):
            _find_cells(own_m[d], rise, turns, seen, starts, directions, intrinsics, shape, cells)
            if heights == len(own_m):
                for n in range(count):
                    if cells[n] >= 0:
                        sums[n, building, d] += values[levels[cells[n]]]
            else:
                for n in range(count):
                    if cells[n] >= 0:
                        value = values[levels[cells[n]]]
                        for k in range(len(own_m)):
                            sums[n, building, k] += value


@kernel
def count_along_lines(lines, pose, intrinsics, levels, shape, offset_px, own_m, counts):
    """Counts the points of lines that meet each level in a photo, as seen from one pose.

    Args:
        lines: As of ``sum_along_lines``, and so is all else.
        pose: One.
        intrinsics: See there.
        levels: See there.
        shape: See there.
        offset_px: How far beside the line to look.
        own_m: See there.
        counts: (K, B, D, 16) int64 to add to, by kind, building and height of its roof.
    """
    points, rises, lifts, outward, kinds, buildings = lines
    turns, places, of_all = pose
    seen, across, starts, directions, cells = _room(1)
    for i in range(len(points)):
        of_point = counts[kinds[i], buildings[i]]
        _see_lines(points[i], rises[i], lifts[i], outward[i], turns, places, of_all, intrinsics, seen, across)
        _find_directions(across, directions)
        _step_aside(offset_px, intrinsics, across, starts)
        for d in range(len(own_m)):
            _find_cells(own_m[d], rises[i, 0], turns, seen, starts, directions, intrinsics, shape, cells)
            if cells[0] >= 0:
                of_point[d, levels[cells[0]]] += 1


@per_pixel
def _see_lines(ends, rises, lifts, outward, turns, centers, of_all, intrinsics, seen, across):
    """Writes where a line's point and its nearer end are in the axes of each camera, and what is across it.

    The former in metres, the latter a direction in the picture.
    """
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = turns
    (c0, c1, c2), (all_roofs, all_feet, all_eaves) = centers, of_all
    p0, p1, p2 = ends[0, 0], ends[0, 1], ends[0, 2]
    q0, q1, q2 = ends[1, 0], ends[1, 1], ends[1, 2]
    rise_p, rise_q, lift_p, lift_q = rises[0], rises[1], lifts[0], lifts[1]
    out_x, out_y = outward[0], outward[1]
    focal_x, focal_y = intrinsics[0], intrinsics[1]
    (to_x, to_y, to_z, nearer), (across_u, across_v) = seen, across
    for n in range(len(r0)):
        # Lines move out without turning.
        east, north = all_eaves[n] * out_x, all_eaves[n] * out_y
        dx, dy = p0 + east - c0[n], p1 + north - c1[n]
        dz = p2 + rise_p * all_roofs[n] + lift_p * all_feet[n] - c2[n]
        x = (r0[n] * dx + r1[n] * dy) + r2[n] * dz
        y = (r3[n] * dx + r4[n] * dy) + r5[n] * dz
        z = (r6[n] * dx + r7[n] * dy) + r8[n] * dz
        dx, dy = q0 + east - c0[n], q1 + north - c1[n]
        dz = q2 + rise_q * all_roofs[n] + lift_q * all_feet[n] - c2[n]
        s = (r0[n] * dx + r1[n] * dy) + r2[n] * dz
        t = (r3[n] * dx + r4[n] * dy) + r5[n] * dz
        r = (r6[n] * dx + r7[n] * dy) + r8[n] * dz
        to_x[n], to_y[n], to_z[n], nearer[n] = x, y, z, min(z, r)
        # A roof of another height shifts its lines; that it turns them is left out.
        across_u[n], across_v[n] = focal_y * (y * r - t * z), focal_x * (s * z - x * r)


@per_pixel
def _find_directions(across, directions):
    """Writes which of the directions over half a turn is nearest to each line's across, without its angle."""
    across_u, across_v = across
    for n in range(len(directions)):
        u, v = across_u[n], across_v[n]
        sign = -1.0 if (v < 0.0 or (v == 0.0 and u < 0.0)) else 1.0
        passed = 0
        for k in range(DIRECTIONS):
            passed += 1 if _COSINES[k] * (sign * v) >= _SINES[k] * (sign * u) else 0
        directions[n] = 0 if passed == DIRECTIONS else passed


@per_pixel
def _step_aside(offset_px, intrinsics, across, starts):
    """Writes where in the picture each camera's axis is taken to be, so far beside the line, pixels."""
    (across_u, across_v), (left, top) = across, starts
    for n in range(len(left)):
        u, v = across_u[n], across_v[n]
        share = offset_px / max(np.sqrt(u * u + v * v), 1e-12)
        left[n], top[n] = intrinsics[2] + share * u, intrinsics[3] + share * v


@per_pixel
def _find_cells(own_m, rise, turns, seen, starts, directions, intrinsics, shape, cells):
    """Writes which of all levels, one after the other, each pose meets; -1 outside the picture."""
    height, width, count = shape
    focal_x, focal_y = intrinsics[0], intrinsics[1]
    (x, y, z, nearer), (left, top) = seen, starts
    up_x, up_y, up_z = turns[2], turns[5], turns[8]
    for n in range(len(cells)):
        depth = z[n] + own_m * (rise * up_z[n])
        near = 1.0 / depth
        u = left[n] + focal_x * (x[n] + own_m * (rise * up_x[n])) * near
        v = top[n] + focal_y * (y[n] + own_m * (rise * up_y[n])) * near
        is_in = (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height)
        is_in &= (depth >= _NEAREST_M) & (nearer[n] >= _NEAREST_M)
        # What is outside may be beyond any integer.
        row, column = np.int32(v if is_in else 0.0), np.int32(u if is_in else 0.0)
        cell = (row * np.int32(width) + column) * np.int32(count) + directions[n]
        cells[n] = cell if is_in else -1
