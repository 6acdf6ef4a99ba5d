"""Where the map's lines fall on the photo's edges at all: starts where regions have no top.

A street of roofs as dark as its yards has its best silhouette elsewhere; edges along its roofs are where they
are. Every sample of a fine grid is tried with a blurred photo (docs/adr/0057).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Query
from lodbench.geometry import Camera
from lodbench.geometry.angles import rotations_from_euler
from lodbench.methods.protocol import Streams
from lodbench.methods.region.evidence import Evidence
from lodbench.methods.region.evolution import Cloud, climb
from lodbench.methods.region.lines import LineFit, points_on_lines, worth_of_levels
from lodbench.methods.region.params import Params
from lodbench.methods.region.photo import Photo
from lodbench.methods.region.roofs import RaisedRoofs
from lodbench.methods.region.search import samples, tops_of
from lodbench.methods.region.unknowns import ALL, BESIDE_POSE, ROOFS
from lodbench.rendering.edge_levels import Levels
from lodbench.rendering.line_sums import LinePoints, sum_along_lines

Floats = NDArray[np.float64]

# Width and blur of the photo, pixels: lines a stride beside the right place still meet its edges.
_WIDTH, _BLUR_PX = 320, 2.5
# How far samples of the grid are apart, metres in place and in height, and degrees; farther where there would
# be more of them than so many.
_STRIDE_M, _STRIDE_Z_M, _STRIDE_YAW_DEG, _MOST_SAMPLES = 2.5, 6.0, 1.5, 100_000
# Lines are those seen from the prior in a picture so many times as wide; so many of their points are tried.
_WIDER, _MOST_POINTS = 1.6, 600
_STARTS, _GENERATIONS = 20, 14


def line_starts(
    photo: Photo,
    query: Query,
    roofs: RaisedRoofs,
    evidence: Evidence,
    params: Params,
    streams: Streams,
) -> list[Cloud]:
    """Returns poses around which the map's lines lie along edges of the photo, best first.

    Args:
        photo: The query's.
        query: The query.
        roofs: The map around it.
        evidence: Knows the prior.
        params: The method's.
        streams: Of random numbers.
    """
    coarse = _with_strides(params)
    levels = photo.levels(_BLUR_PX, _WIDTH)
    grid = coarse.grid()
    vectors = samples(grid, query.prior)
    sums = _sums_at(vectors.reshape(-1, grid.z.count, 6), levels, query.camera, roofs)
    found = vectors[tops_of(sums, grid, coarse.turns_around(), _STARTS)]
    # What the grid leaves open: half a stride, and tilt.
    half_m, half_z_m = 0.5 * coarse.stride_m, 0.5 * coarse.stride_z_m
    tilts_deg = params.prior_sigmas()[3:5]
    open_to_it = np.diag(np.square([half_m, half_m, half_z_m, *tilts_deg, 0.5 * coarse.stride_yaw_deg]))
    clouds = []
    for k, start in enumerate(found):
        lines = LineFit(levels, query, roofs, np.append(start, np.zeros(BESIDE_POSE)), coarse)
        if len(lines):
            value, cloud = _posterior(lines, evidence), Cloud(start, open_to_it)
            clouds.append(climb(value, cloud, _GENERATIONS, params.population, streams("line start", k)))
    return clouds


def _posterior(lines: LineFit, evidence: Evidence) -> Callable[[Floats], Floats]:
    """Returns what edges and prior say of poses (N, 6), roofs as in the map."""

    def value(vectors: Floats) -> Floats:
        whole = np.column_stack([vectors, np.zeros((len(vectors), BESIDE_POSE))])
        return lines(whole) + evidence.log_prior(vectors)

    return value


def _with_strides(params: Params) -> Params:
    """Returns the parameters with the strides of the fine grid, or longer ones that make no more samples."""
    fine = replace(params, stride_m=_STRIDE_M, stride_z_m=_STRIDE_Z_M, stride_yaw_deg=_STRIDE_YAW_DEG)
    longer = max(1.0, (len(fine.grid()) / _MOST_SAMPLES) ** 0.25)
    return replace(
        fine,
        stride_m=longer * _STRIDE_M,
        stride_z_m=longer * _STRIDE_Z_M,
        stride_yaw_deg=longer * _STRIDE_YAW_DEG,
    )


def _sums_at(vectors: Floats, levels: Levels, photo_camera: Camera, roofs: RaisedRoofs) -> Floats:
    """Returns (N * Z,) what edges say along lines, of poses (N, Z, 6) at Z heights."""
    camera = photo_camera.scaled(levels.shape[1], levels.shape[0])
    intrinsics, worth = (camera.fx, camera.fy, camera.cx, camera.cy), worth_of_levels()

    def at(height: int) -> Floats:
        poses = np.ascontiguousarray(vectors[:, height])
        points, each_px = _some_points(roofs, camera, poses[len(poses) // 2])
        rotations, centers = rotations_from_euler(poses[:, 3:]), np.ascontiguousarray(poses[:, :3])
        view = rotations, centers, np.zeros((len(poses), ALL - ROOFS)), intrinsics
        sums = np.zeros((len(poses), 1, 1))
        sum_along_lines(points, *view, levels, np.zeros(1), worth, sums)
        return np.asarray(each_px * sums[:, 0, 0])

    return np.stack(list(roofs.side_by_side(at, range(vectors.shape[1]))), axis=1).ravel()


def _some_points(roofs: RaisedRoofs, camera: Camera, vector: Floats) -> tuple[LinePoints, float]:
    """Returns points of the lines in a wider view, and how many pixels of line one stands for."""
    margins = (round(0.5 * (_WIDER - 1.0) * size) for size in (camera.width, camera.height))
    points, spacing_px = points_on_lines(roofs, 0, camera.with_margins(*margins), vector)
    every = max(1, -(-len(points.kinds) // _MOST_POINTS))
    some = LinePoints._make(np.ascontiguousarray(each[::every]) for each in points)
    return some._replace(buildings=np.zeros(len(some.kinds), dtype=np.int64)), spacing_px * every
