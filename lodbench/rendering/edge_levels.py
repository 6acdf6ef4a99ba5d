"""How strongly a photo changes along every direction at every pixel, and what a model's lines find there."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from lodbench.rendering.mean_around import mean_around
from lodbench.rendering.projection import camera_axes

Floats = NDArray[np.float64]
Levels = NDArray[np.uint8]

# Levels of strength, equally full over all pixels and directions, and directions over half a turn.
EDGE_LEVELS, DIRECTIONS = 16, 12
# The part of the width that the mean strength is taken over.
_AROUND_SHARE = 12.0
# Every so many-th row and column says where one level ends and the next begins.
_STEP = 3
# Steps of strength per mean strength, and how many are told apart.
_FINE_STEPS, _FINEST = 256.0, 4095
# Cosine and sine of the angles between one direction and the next.
_BOUNDS = np.stack(
    [turn((np.arange(DIRECTIONS) + 0.5) * (np.pi / DIRECTIONS)) for turn in (np.cos, np.sin)], axis=1
)


class LinePoints(NamedTuple):
    """P points of lines, for the kernel.

    Attributes:
        points: (P, 2, 3) float64 a point and another farther along its line, scene metres.
        rises: (P, 2) float64 by how much either moves up where roofs are a metre higher, metres.
        lifts: (P, 2) float64 by how much either moves up where walls end a metre higher, metres.
        outward: (P, 2) float64 how far the first moves along x and y where eaves stand out a metre farther.
        kinds: (P,) int64 which worth its levels have.
        buildings: (P,) int64 whose sum it is added to.
    """

    points: Floats
    rises: Floats
    lifts: Floats
    outward: Floats
    kinds: NDArray[np.int64]
    buildings: NDArray[np.int64]


def directed_edge_levels(photo: NDArray[Any], size: tuple[int, int], blur_px: float) -> Levels:
    """Returns (H, W, 12) uint8 how strongly brightness and colour change along each direction, 0 to 15.

    Gradients of L, a and b (CIE Lab) are taken after a blur and divided by their mean around the pixel, so
    that a sharp foreground does not outweigh what lies in haze. Direction ``k`` is ``k * pi / 12`` from the
    picture's x axis towards its y axis.

    Args:
        photo: (H, W) or (H, W, 3) BGR, 8 bits.
        size: Width and height to work at, pixels.
        blur_px: Standard deviation of the blur, pixels of that size.
    """
    small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    if small.ndim == 2:
        small = np.repeat(small[..., None], 3, axis=2)
    lab = cv2.GaussianBlur(cv2.cvtColor(small / np.float32(255), cv2.COLOR_BGR2LAB), (0, 0), blur_px)
    across, down = (cv2.Sobel(lab, cv2.CV_32F, *axis, scale=0.125) for axis in ((1, 0), (0, 1)))
    # The strength along a direction is a quadratic form of it: three sums over the channels say all.
    xx, xy, yy = (_over_channels(*pair) for pair in ((across, across), (across, down), (down, down)))
    around = mean_around(np.sqrt(xx + yy), size[0] / _AROUND_SHARE) + np.float32(1e-3)
    angles = np.arange(DIRECTIONS) * (np.pi / DIRECTIONS)
    turns = np.stack(
        [np.cos(angles) ** 2, 2.0 * np.cos(angles) * np.sin(angles), np.sin(angles) ** 2], axis=1
    )
    forms = np.ascontiguousarray(np.stack([xx, xy, yy], axis=2) / (around**2)[..., None])
    some = np.sqrt(np.maximum(forms[::_STEP, ::_STEP] @ turns.T, 0.0)) * _FINE_STEPS
    levels: Levels = _looked_up(forms, turns, _level_table(np.minimum(some, _FINEST).astype(np.int64)))
    return levels


def _over_channels(one: NDArray[Any], other: NDArray[Any]) -> NDArray[np.float32]:
    """Returns the (H, W) sums of products over three channels; numpy's own over so short an axis are slow."""
    product = one * other
    return np.asarray(product[..., 0] + product[..., 1] + product[..., 2])


def _level_table(steps: NDArray[np.int64]) -> Levels:
    """Returns (4096,) the level of each fine step of strength, so that levels are equally full.

    A search for the level of each strength would take longer than all else.

    Args:
        steps: Some of a photo, in fine steps.
    """
    up_to = np.bincount(steps.ravel(), minlength=_FINEST + 1).cumsum()
    places = np.arange(1, EDGE_LEVELS) / EDGE_LEVELS * (steps.size - 1)
    low, high = (np.searchsorted(up_to, whole(places), side="right") for whole in (np.floor, np.ceil))
    ends = low + (high - low) * (places - np.floor(places))
    return np.searchsorted(ends, np.arange(_FINEST + 1), side="right").astype(np.uint8)


@njit(cache=True, nogil=True, error_model="numpy")
def _looked_up(forms, turns, table):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns (H, W, 12) uint8 levels of quadratic forms (H, W, 3) of directions (12, 3)."""
    height, width = forms.shape[:2]
    levels = np.empty((height, width, len(turns)), dtype=np.uint8)
    for row in range(height):
        for column in range(width):
            form = forms[row, column]
            for k in range(len(turns)):
                square = form[0] * turns[k, 0] + form[1] * turns[k, 1] + form[2] * turns[k, 2]
                step = np.sqrt(max(square, 0.0)) * _FINE_STEPS
                levels[row, column, k] = table[int(min(step, _FINEST))]
    return levels


@njit(cache=True, nogil=True, error_model="numpy")
def sum_along_lines(lines, rotations, centers, of_all_m, intrinsics, levels, offset_px, own_m, worth, sums):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Adds up what the levels are worth that points of lines meet in a photo; outside is worth nothing.

    For N poses, and for each building by itself at D heights of its roof.

    Args:
        lines: Their P points.
        rotations: (N, 3, 3) cam_from_world.
        centers: (N, 3) metres.
        of_all_m: (N, 3) how much higher than the points say all roofs and the feet of all walls are taken to
            be, and how much farther all eaves to stand out, metres.
        intrinsics: fx, fy, cx, cy.
        levels: (H, W, 12) uint8 of ``directed_edge_levels``.
        offset_px: How far beside the line to look.
        own_m: (D,) how much higher than that the building's own roof is, metres.
        worth: (K, 16) float64 of each level, by the points' kinds.
        sums: (N, B, D) float64 to add to.
    """
    points, rises, lifts, outward, kinds, buildings = lines
    height, width = levels.shape[:2]
    focal_x, focal_y, middle_x, middle_y = intrinsics
    # Poses in the inner loop: they are close together, and so is what they look up of one point.
    for i in range(len(points)):
        p, q, building, values = points[i, 0], points[i, 1], buildings[i], worth[kinds[i]]
        rise, rise_along, out_x, out_y = rises[i, 0], rises[i, 1], outward[i, 0], outward[i, 1]
        lift, lift_along = lifts[i, 0], lifts[i, 1]
        for n in range(len(rotations)):
            roofs_m, feet_m, eaves_m = of_all_m[n, 0], of_all_m[n, 1], of_all_m[n, 2]
            p_z = p[2] + rise * roofs_m + lift * feet_m
            q_z = q[2] + rise_along * roofs_m + lift_along * feet_m
            # Lines move out without turning.
            east, north = eaves_m * out_x, eaves_m * out_y
            x, y, z = camera_axes(p[0] + east, p[1] + north, p_z, rotations[n], centers[n])
            s, t, r = camera_axes(q[0] + east, q[1] + north, q_z, rotations[n], centers[n])
            if z < 1.0 or r < 1.0:
                continue
            # A roof of another height shifts its lines; that it turns them is left out.
            across_u, across_v = focal_y * (y * r - t * z), focal_x * (s * z - x * r)
            direction = _direction(across_u, across_v)
            left, top = middle_x, middle_y
            if offset_px != 0.0:
                share = offset_px / max(np.sqrt(across_u * across_u + across_v * across_v), 1e-12)
                left, top = left + share * across_u, top + share * across_v
            up_x, up_y, up_z = rise * rotations[n, 0, 2], rise * rotations[n, 1, 2], rise * rotations[n, 2, 2]
            for d in range(len(own_m)):
                depth = z + own_m[d] * up_z
                if depth < 1.0:
                    continue
                near = 1.0 / depth
                u = left + focal_x * (x + own_m[d] * up_x) * near
                v = top + focal_y * (y + own_m[d] * up_y) * near
                if 0.0 <= u < width and 0.0 <= v < height:
                    sums[n, building, d] += values[levels[int(v), int(u), direction]]


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _direction(across_u, across_v):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Returns which of the directions over half a turn is nearest to a vector's, without its angle."""
    if across_v < 0.0 or (across_v == 0.0 and across_u < 0.0):
        across_u, across_v = -across_u, -across_v
    first, last = 0, DIRECTIONS
    while first < last:
        middle = (first + last) // 2
        if _BOUNDS[middle, 0] * across_v >= _BOUNDS[middle, 1] * across_u:
            first = middle + 1
        else:
            last = middle
    return first % DIRECTIONS
