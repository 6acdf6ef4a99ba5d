"""How far to trust an answer of any method: covariance, camera, the photo's edges, the search's bounds.

A stated probability is never more than the covariance allows, what is not known of the camera included, and
an answer that the photo's own edges contradict is in doubt (docs/adr/0013, point 5).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymap.laser import RangedPose, pose_by_range
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.estimation.edge_alignment import (
    LensErrors,
    ModelLines,
    PhotoEdges,
    Projected,
    lines_in_view,
    project_lines,
)
from lodbench.estimation.state_vector import probability_within
from lodbench.geometry import Camera, Pose
from lodbench.geometry.camera import UNKNOWN, CameraSigmas
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.fits import EDGES_WIDTH, SearchRange, photo_edges
from lodbench.methods.protocol import Estimate

Floats = NDArray[np.float64]

# Points of lines are so far apart, pixels.
_SPACING_PX, FEWEST_POINTS, _LOWEST_RISE = 4.0, 30, 0.2
# What outlines are off by where they are weighed against the prior, and over which length alike, pixels.
_NOISE_PX, _TOGETHER_PX = 2.0, 40.0
# Covariances of single photos allow for more than errors are: on 98 answers over two real flights and two
# cities this share of them states what is found (docs/adr/0013, point 5).
_COVARIANCE_SHARE = 0.5
# How often a camera is not as declared, and by how many deviations of a nominal one it errs then.
_MISDECLARED, _WORSE = 0.15, 2.0
# A line lies on an edge that is nearer than this; lines laid so far aside say how many do by chance, pixels.
_ON_PX, _ASIDE_PX = 2.5, (-25.0, -17.0, 17.0, 25.0)
# Where no more lines than by chance and this share lie on edges, the photo contradicts the answer.
_LEAST_EXCESS = 0.05
# Of a contradicted answer, or one at a bound of the search: less than what is trusted.
_DOUBTFUL = 0.45
_BOUND = 0.98
# An error of the camera that moves the answer by as much is worth a note, metres.
_NEWS_M = 1.0


def assessed(
    estimate: Estimate, query: Query, city_map: CityMap, params: Any = None, is_camera_solved: bool = False
) -> Estimate:
    """Returns an answer with the uncertainty of the camera in its covariance, and a calibrated probability.

    Eq. (M6) of docs/methods/index.md; where a laser measured a range, pose and covariance are updated by it.

    Args:
        estimate: A method's answer, scene frame.
        query: What it answers.
        city_map: The map.
        params: The method's, for the ranges of its search; of one without ``range_..`` those of the papers'
            priors are taken.
        is_camera_solved: Whether what is not known of the camera stands in the covariance already.
    """
    if estimate.probability is None or estimate.is_assessed:
        return estimate
    vector = vector_from_pose(estimate.pose)
    camera = query.camera.scaled_to_width(min(EDGES_WIDTH, query.camera.width))
    lines, laid = _lines_at(city_map, camera, estimate.pose)
    notes = list(estimate.notes)
    covariance, probability = estimate.covariance, float(estimate.probability)
    if covariance is not None:
        of_camera = [np.zeros((6, 0))]
        if not is_camera_solved:
            per_unit = camera_columns(laid, lines, _prior_sigmas(params, query))
            of_camera = [per_unit * _camera_sigmas(query), per_unit * (_WORSE * _sigmas_of(UNKNOWN))]
            notes += _camera_notes(of_camera[0], query)
        own, before = covariance, covariance + of_camera[0] @ of_camera[0].T
        ranged = _ranged(query, city_map, vector, before)
        covariance = ranged.left_of(before)
        if ranged.note:
            notes.append(ranged.note)
        if ranged.kept is not None:
            vector = ranged.vector
            estimate = replace(estimate, pose=pose_from_vector(vector), is_laser_used=True)
            lines, laid = _lines_at(city_map, camera, estimate.pose)
        spreads = [ranged.left_of(_COVARIANCE_SHARE * own + c @ c.T) for c in of_camera]
        masses = [probability_within(spread, vector) for spread in spreads]
        if not is_camera_solved:
            masses[0] = (1.0 - _MISDECLARED) * masses[0] + _MISDECLARED * min(masses)
        probability = min(probability, masses[0])
    for doubt in (*_bounds(query, vector, params), *_edge_doubts(query, laid, lines, camera)):
        notes.append(doubt)
        probability = min(probability, _DOUBTFUL)
    return replace(
        estimate, covariance=covariance, probability=probability, notes=tuple(notes), is_assessed=True
    )


def _lines_at(city_map: CityMap, camera: Camera, pose: Pose) -> tuple[ModelLines, Projected]:
    """Returns the model's lines above the ground that a pose shows, and where they lie."""
    lines = lines_in_view(city_map, camera, pose, _SPACING_PX)
    lines = lines.of(lines.relative_heights > _LOWEST_RISE)
    return lines, project_lines(lines.points, lines.along, camera, vector_from_pose(pose), LensErrors())


def _ranged(query: Query, city_map: CityMap, vector: Floats, covariance: Floats) -> RangedPose:
    """Returns the pose updated by the laser's range, if one was measured."""
    laser = None if query.measured is None else query.measured.laser
    if laser is None:
        return RangedPose(vector, None, np.zeros((6, 6)), "")
    pose = pose_from_vector(vector)
    return pose_by_range(city_map.surfaces, query.camera, pose, covariance, laser)


def camera_columns(laid: Projected, lines: ModelLines, prior_sigmas: Floats) -> Floats:
    """Returns (6, 4) how far an answer moves per unit that the camera is not as declared.

    Eq. (M5) of docs/methods/index.md. The pose makes up for the camera as far as the model's lines at the
    answer weigh more than the prior, (6,) deviations in metres and degrees: least squares, linearised.
    """
    weights = lines.lengths_px / (_TOGETHER_PX * _NOISE_PX**2)
    by_pose, by_lens = laid.by_camera[:, :6], laid.by_camera[:, 6:]
    information = (by_pose * weights[:, None]).T @ by_pose + np.diag(prior_sigmas**-2.0)
    return np.asarray(-np.linalg.solve(information, (by_pose * weights[:, None]).T @ by_lens))


def edge_excess(edges: PhotoEdges, laid: Projected) -> float | None:
    """Returns which share of lines lies on edges of the photo, less what does by chance.

    Eq. (M7) of docs/methods/index.md. None where there are few lines, or no edge anywhere beside them: such a
    photo contradicts nothing.
    """
    count = len(laid.pixels)
    if count < FEWEST_POINTS:
        return None
    candidates = edges.across(laid.pixels, laid.normals, max(_ASIDE_PX) + _ON_PX)
    if not len(candidates.points):
        return None

    def share(aside_px: float) -> float:
        near = np.zeros(count, dtype=bool)
        near[candidates.points[np.abs(candidates.distances - aside_px) < _ON_PX]] = True
        return float(near.mean())

    return share(0.0) - float(np.mean([share(aside) for aside in _ASIDE_PX]))


def _edge_doubts(query: Query, laid: Projected, lines: ModelLines, camera: Camera) -> Iterator[str]:
    edges = photo_edges(query) if len(lines) >= FEWEST_POINTS else None
    if edges is None:
        return
    inside = ((laid.pixels > 0) & (laid.pixels < (camera.width, camera.height))).all(axis=1)
    shown = replace(
        laid,
        pixels=laid.pixels[inside],
        normals=laid.normals[inside],
        by_camera=laid.by_camera[inside],
        by_place=laid.by_place[inside],
    )
    excess = edge_excess(edges, shown)
    if excess is not None and excess < _LEAST_EXCESS:
        yield "poor fit: edges in the photo match the map's roof edges no better than by chance"


def _prior_sigmas(params: Any, query: Query) -> Floats:
    """Returns (6,) standard deviations of the prior: as stated, or uniform in the search's ranges."""
    usual = UniformPrior()
    half = np.array(
        [usual.x_m, usual.y_m, usual.z_m, usual.pitch_deg, usual.roll_deg, usual.yaw_deg], dtype=np.float64
    )
    names = ("range_x_m", "range_y_m", "range_z_m", "range_tilt_deg", "range_tilt_deg", "range_yaw_deg")
    widths = [getattr(params, name, None) for name in names]
    half = np.array([h if w is None else 0.5 * float(w) for h, w in zip(half, widths, strict=True)])
    sigmas = np.asarray(np.maximum(half, 1e-3) / np.sqrt(3.0))
    return sigmas if query.measured is None else query.measured.over(sigmas)


def _camera_sigmas(query: Query) -> Floats:
    """Returns (4,) deviations in the order of ``LensErrors``, less what the method knows already."""
    if query.camera_sigmas is None:
        return np.zeros(4)
    sigmas, known = _sigmas_of(query.camera_sigmas), 0.01 * (query.lens_percent or 0.0)
    sigmas[0] = np.sqrt(max(sigmas[0] ** 2 - known**2, 0.0))
    return sigmas


def _sigmas_of(sigmas: CameraSigmas) -> Floats:
    return np.array([0.01 * sigmas.focal_percent, sigmas.k1, *[0.01 * sigmas.center_percent] * 2])


def _camera_notes(by_camera: Floats, query: Query) -> Iterator[str]:
    """Yields a sentence on the number of the camera that leaves most open, if that is much."""
    moved_m = np.linalg.norm(by_camera[:3], axis=0)
    worst = int(np.argmax(moved_m))
    sigmas = query.camera_sigmas
    if sigmas is None or moved_m[worst] < _NEWS_M:
        return
    known = (
        f"focal length known to {sigmas.focal_percent:.2g} %",
        f"radial distortion known to {sigmas.k1:.2g}",
        *[f"principal point known to {sigmas.center_percent:.2g} % of the width"] * 2,
    )
    yield f"{known[worst]} is {moved_m[worst]:.1f} m here"


def _bounds(query: Query, vector: Floats, params: Any) -> Iterator[str]:
    """Yields a sentence for a height at the bound of what was searched."""
    if isinstance(params, SearchRange):
        params = params.over_measured(query.measured)
    width_m = getattr(params, "range_z_m", None)
    if not width_m:
        return
    away_m = float(vector[2] - query.prior.center[2])
    if abs(away_m) > _BOUND * 0.5 * float(width_m):
        yield f"the height lies at the bound of the search, {away_m:+.1f} m from the prior"
