"""Edges of a photo by direction, and what a model's lines find in them, for many poses at a time."""

from __future__ import annotations

import numpy as np

from lodbench.kernels.arguments import DIRECTIONS, MAX_STRENGTH, STRENGTH_STEPS
from lodbench.kernels.compiled import inlined, kernel, per_pixel, uncounted


@inlined
def _allocate(count):
    """Returns arrays for what so many poses see of a line's point.

    x, y, z of the point in camera axes and the lesser z of the line's two; the line's normal in the picture;
    the principal point, pixels; which of the 12 directions the line has; and the index of the level that the
    point meets, or -1.
    """
    # Made here: of arrays that are handed in a compiler cannot know that they do not overlap, and works on
    # one pose at a time.
    in_camera = (np.empty(count), np.empty(count), np.empty(count), np.empty(count))
    normals, principal = (np.empty(count), np.empty(count)), (np.empty(count), np.empty(count))
    return in_camera, normals, principal, np.empty(count, np.int64), np.empty(count, np.int64)


@uncounted
def quantise_edges(forms, rotations, table, levels):
    """Writes (H, W, 12) uint8 levels of quadratic forms (H, W, 3) of directions (12, 3)."""
    height, width = forms.shape[:2]
    for row in range(height):
        for column in range(width):
            form = forms[row, column]
            for k in range(len(rotations)):
                square = form[0] * rotations[k, 0] + form[1] * rotations[k, 1] + form[2] * rotations[k, 2]
                step = np.sqrt(max(square, 0.0)) * STRENGTH_STEPS
                levels[row, column, k] = table[int(min(step, MAX_STRENGTH))]


# Cosine and sine of the angles between one direction and the next.
_COSINES, _SINES = (turn((np.arange(DIRECTIONS) + 0.5) * (np.pi / DIRECTIONS)) for turn in (np.cos, np.sin))
# Points nearer than this are left out, metres.
_MIN_DEPTH_M = 1.0


@kernel
def sum_along_lines(lines, poses, intrinsics, levels, shape, roofs_m, level_scores, sums):
    """Adds up the scores of the levels that points of lines meet in a photo; 0 outside of it.

    For N poses, and for each building by itself at D heights of its roof.

    Args:
        lines: Their P points.
        poses: LinePoses, N of them.
        intrinsics: fx, fy, cx, cy.
        levels: (H * W * 12,) uint8 of ``directed_edge_levels``.
        shape: H, W, 12.
        roofs_m: (D,) how much higher than that the building's own roof is tried, metres.
        level_scores: (K, 16) float64 score of each level, by the points' kinds.
        sums: (N, B, D) float64 to add to.
    """
    points, roof_shares, base_shares, overhangs, kinds, buildings = lines
    rotations, centers, offsets_m = poses
    count = len(rotations[0])
    in_camera, normals, principal, directions, indices = _allocate(count)
    for n in range(count):
        principal[0][n], principal[1][n] = intrinsics[2], intrinsics[3]
    for i in range(len(points)):
        roof_share, building, values = roof_shares[i, 0], buildings[i], level_scores[kinds[i]]
        _project_points(
            points[i], roof_shares[i], base_shares[i], overhangs[i], rotations, centers, offsets_m,
            intrinsics, in_camera, normals,
        )  # fmt: skip
        _nearest_directions(normals, directions)
        # Bases of walls stay where they are, however high the roof.
        num_heights = len(roofs_m) if roof_share != 0.0 else 1
        for d in range(num_heights):
            _find_levels(
                roofs_m[d],
                roof_share,
                rotations,
                in_camera,
                principal,
                directions,
                intrinsics,
                shape,
                indices,
            )
            if num_heights == len(roofs_m):
                for n in range(count):
                    if indices[n] >= 0:
                        sums[n, building, d] += values[levels[indices[n]]]
            else:
                for n in range(count):
                    if indices[n] >= 0:
                        value = values[levels[indices[n]]]
                        for k in range(len(roofs_m)):
                            sums[n, building, k] += value


@kernel
def count_along_lines(lines, pose, intrinsics, levels, shape, offset_px, roofs_m, counts):
    """Counts the points of lines that meet each level in a photo, as seen from one pose.

    Args:
        lines: As of ``sum_along_lines``, and so is all else.
        pose: One.
        intrinsics: See there.
        levels: See there.
        shape: See there.
        offset_px: Distance of the points from the line, along its normal, pixels.
        roofs_m: See there.
        counts: (K, B, D, 16) int64 to add to, by kind, building and height of its roof.
    """
    points, roof_shares, base_shares, overhangs, kinds, buildings = lines
    rotations, centers, offsets_m = pose
    in_camera, normals, principal, directions, indices = _allocate(1)
    for i in range(len(points)):
        roof_share, point_counts = roof_shares[i, 0], counts[kinds[i], buildings[i]]
        _project_points(
            points[i], roof_shares[i], base_shares[i], overhangs[i], rotations, centers, offsets_m,
            intrinsics, in_camera, normals,
        )  # fmt: skip
        _nearest_directions(normals, directions)
        _offset_centers(offset_px, intrinsics, normals, principal)
        for d in range(len(roofs_m)):
            _find_levels(
                roofs_m[d],
                roof_share,
                rotations,
                in_camera,
                principal,
                directions,
                intrinsics,
                shape,
                indices,
            )
            if indices[0] >= 0:
                point_counts[d, levels[indices[0]]] += 1


@per_pixel
def _project_points(
    ends, roof_shares, base_shares, overhangs, rotations, centers, offsets_m, intrinsics, in_camera, normals
):
    """Writes a line's point and the lesser depth of its two in each camera's axes, and the line's normal.

    The former in metres, the latter in the picture, of any length.
    """
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotations
    (c0, c1, c2), (roof_offset, base_offset, overhang_offset) = centers, offsets_m
    p0, p1, p2 = ends[0, 0], ends[0, 1], ends[0, 2]
    q0, q1, q2 = ends[1, 0], ends[1, 1], ends[1, 2]
    roof_p, roof_q, base_p, base_q = roof_shares[0], roof_shares[1], base_shares[0], base_shares[1]
    out_x, out_y = overhangs[0], overhangs[1]
    focal_x, focal_y = intrinsics[0], intrinsics[1]
    (x_m, y_m, z_m, min_depth), (normal_u, normal_v) = in_camera, normals
    for n in range(len(r0)):
        # Lines move out without turning.
        east, north = overhang_offset[n] * out_x, overhang_offset[n] * out_y
        dx, dy = p0 + east - c0[n], p1 + north - c1[n]
        dz = p2 + roof_p * roof_offset[n] + base_p * base_offset[n] - c2[n]
        x = (r0[n] * dx + r1[n] * dy) + r2[n] * dz
        y = (r3[n] * dx + r4[n] * dy) + r5[n] * dz
        z = (r6[n] * dx + r7[n] * dy) + r8[n] * dz
        dx, dy = q0 + east - c0[n], q1 + north - c1[n]
        dz = q2 + roof_q * roof_offset[n] + base_q * base_offset[n] - c2[n]
        s = (r0[n] * dx + r1[n] * dy) + r2[n] * dz
        t = (r3[n] * dx + r4[n] * dy) + r5[n] * dz
        r = (r6[n] * dx + r7[n] * dy) + r8[n] * dz
        x_m[n], y_m[n], z_m[n], min_depth[n] = x, y, z, min(z, r)
        # A roof of another height shifts its lines; that it turns them is left out.
        normal_u[n], normal_v[n] = focal_y * (y * r - t * z), focal_x * (s * z - x * r)


@per_pixel
def _nearest_directions(normals, directions):
    """Writes which of the directions over half a turn is nearest to each line's normal, without its angle."""
    normal_u, normal_v = normals
    for n in range(len(directions)):
        u, v = normal_u[n], normal_v[n]
        sign = -1.0 if (v < 0.0 or (v == 0.0 and u < 0.0)) else 1.0
        num_passed = 0
        for k in range(DIRECTIONS):
            num_passed += 1 if _COSINES[k] * (sign * v) >= _SINES[k] * (sign * u) else 0
        directions[n] = 0 if num_passed == DIRECTIONS else num_passed


@per_pixel
def _offset_centers(offset_px, intrinsics, normals, principal):
    """Writes each camera's principal point moved along the line's normal by an offset, pixels."""
    (normal_u, normal_v), (left, top) = normals, principal
    for n in range(len(left)):
        u, v = normal_u[n], normal_v[n]
        share = offset_px / max(np.sqrt(u * u + v * v), 1e-12)
        left[n], top[n] = intrinsics[2] + share * u, intrinsics[3] + share * v


@per_pixel
def _find_levels(roof_m, roof_share, rotations, in_camera, principal, directions, intrinsics, shape, indices):
    """Writes the index into all levels, laid end to end, that each pose meets; -1 outside the picture."""
    height, width, count = shape
    focal_x, focal_y = intrinsics[0], intrinsics[1]
    (x, y, z, min_depth), (left, top) = in_camera, principal
    up_x, up_y, up_z = rotations[2], rotations[5], rotations[8]
    for n in range(len(indices)):
        depth = z[n] + roof_m * (roof_share * up_z[n])
        near = 1.0 / depth
        u = left[n] + focal_x * (x[n] + roof_m * (roof_share * up_x[n])) * near
        v = top[n] + focal_y * (y[n] + roof_m * (roof_share * up_y[n])) * near
        is_inside = (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height)
        is_inside &= (depth >= _MIN_DEPTH_M) & (min_depth[n] >= _MIN_DEPTH_M)
        # What is outside may be beyond any integer.
        row, column = np.int32(v if is_inside else 0.0), np.int32(u if is_inside else 0.0)
        index = (row * np.int32(width) + column) * np.int32(count) + directions[n]
        indices[n] = index if is_inside else -1
