"""How much the outlines of wrong masks leave to be found: the best linear estimate, all but the pose known.

It stands at the true pose over the exact map, so search and map cost it nothing, and it knows how masks err:
from many made for the same view, the mean and covariance of the distances between the map's outline and
theirs. Of all estimates that are linear in these distances it has the least variance (Gauss and Markov); a
method that knows none of this, and whose distances are linear only near the truth, will hardly find more.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.estimation.outline_alignment import Aligner, OutlinePoints, smooth_distance
from lodbench.evaluation.pose_errors import PROBABILITY_THRESHOLD, hits_of
from lodbench.geometry import Pose, wrap_deg
from lodbench.geometry.pose import turn_per_angle, vector_from_pose
from lodbench.harness.city import open_city
from lodbench.kernels.edges import measure_distances
from lodbench.methods.contour_alignment.method import ContourAlignment
from lodbench.storage import random_stream
from lodbench.synthesis.mask_degradation import degrade_mask
from lodbench.synthesis.views import FINE_SIZE
from lodbench.synthesis.views_dataset import ViewsParams, open_views

Floats = NDArray[np.float64]

# Distances beyond this are of buildings that a mask misses, and say no more than that, pixels.
_FAR_PX = 12.0
# Points of the outline whose distances are averaged: a wobble is longer.
_TOGETHER = 3
# Share of the masks by which the noise is known; from the rest poses are estimated.
_KNOWN = 0.7
# How much of the covariance comes from Matern's 3/2 with this length instead: few masks leave it singular.
_SMOOTH, _LENGTH_PX, _OWN = 0.3, 40.0, 0.3


def share_within_reach(views: ViewsParams, draws: int) -> float:
    """Returns how many priors the best linear estimate brings to (2 m, 2 deg) at the sensor's tilt, percent.

    Args:
        views: What is drawn; masks are made of the level of detail that they are drawn from, at their IoU. Of
            its world roofs and feet count; lens and tilt are as told.
        draws: Masks of each view.

    Raises:
        LodbenchError: The city cannot be read, or no views can be drawn over it.
    """
    dataset = open_views(views)
    lod = views.mask_lod or views.lod
    scene = open_city(Path(views.city_model), lod, dataset.city_options, views.roof_height).scene
    scene = views.world.perturbed(scene)
    city_map, found = CityMap(scene), []
    for entry in dataset.entries:
        truth = dataset.truth[entry.key].shifted(-scene.origin)
        if entry.camera is not None:
            query = Query(entry.name, entry.split, entry.camera, truth, None, None)
            found.append(_share_of_view(query, city_map, views, draws))
    return 100.0 * float(np.mean(found))


def _share_of_view(query: Query, city_map: CityMap, views: ViewsParams, draws: int) -> float:
    """Returns the share found of a view, whose prior is the truth."""
    truth = query.prior
    clean = city_map.render(query.camera.scaled(*FINE_SIZE), truth)
    told = replace(query, building_probability=clean.astype(np.float32))
    vector = np.append(vector_from_pose(truth), 0.0)
    aligner = Aligner(told, city_map, ContourAlignment().params.outline_model())
    points, _ = aligner.outline(vector, FINE_SIZE)
    if len(points) < 2 * _TOGETHER:
        return 0.0
    masks = (
        degrade_mask(clean, views.mask_iou, random_stream(views.views_seed, "outline limit", query.name, k))[
            0
        ]
        for k in range(draws)
    )
    distances = np.array([_distances(points, mask) for mask in masks])
    slopes = -points.slopes(6)
    together, known = _averages(len(points)), int(_KNOWN * draws)
    generator = random_stream(views.views_seed, "outline limit", query.name, "priors")
    prior = views.prior()
    offsets = np.array([_offset(prior, truth, generator) for _ in range(draws - known)])
    averaged = distances @ together.T
    errors = linear_errors(
        together @ slopes,
        averaged[:known],
        averaged[known:],
        together @ points.pixels,
        offsets,
        _sigmas(prior),
    )
    turned = np.linalg.norm(errors[:, 3:] @ turn_per_angle(vector[:6]).T, axis=1)
    pairs = np.column_stack([np.linalg.norm(errors[:, :3], axis=1), turned])
    return float(hits_of(pairs, PROBABILITY_THRESHOLD).mean())


def linear_errors(
    slopes: Floats, known: Floats, judged: Floats, pixels: Floats, offsets: Floats, sigmas: Floats
) -> Floats:
    """Returns (D, K) how far the best linear estimate of K numbers ends from the truth.

    Args:
        slopes: (N, K) how the distances of N points change with the numbers.
        known: (M, N) distances at the truth by which the noise is known.
        judged: (D, N) those that are estimated from.
        pixels: (N, 2) where the points are.
        offsets: (D, K) of the priors from the truth.
        sigmas: (K,) deviations of such offsets.
    """
    inverse = np.linalg.inv(_covariance(known, pixels))
    weighted = slopes.T @ inverse
    gain = np.linalg.solve(weighted @ slopes + np.diag(sigmas**-2.0), weighted)
    noise = judged - known.mean(axis=0)
    return np.asarray(noise @ gain.T + offsets @ (np.eye(len(sigmas)) - gain @ slopes).T)


def _covariance(distances: Floats, pixels: Floats) -> Floats:
    away = distances - distances.mean(axis=0)
    found = away.T @ away / len(away)
    lags = np.sqrt(3.0) * np.linalg.norm(pixels[:, None] - pixels[None], axis=2) / _LENGTH_PX
    smooth = (1.0 - _OWN) * (1.0 + lags) * np.exp(-lags) + _OWN * np.eye(len(lags))
    # An outline that never errs has a variance that no inverse feels.
    level = max(float(np.diagonal(found).mean()), 1e-6)
    return np.asarray((1.0 - _SMOOTH) * found + _SMOOTH * level * smooth)


def _distances(points: OutlinePoints, mask: NDArray[np.bool_]) -> Floats:
    """Returns (N,) how far points lie inside a mask's outline, pixels, far ones cut off."""
    distances, slopes, agreement = np.empty(len(points)), np.empty((len(points), 1)), np.empty(len(points))
    moves = np.ascontiguousarray(points.moves[:, :1])
    measure_distances(
        points.pixels, points.normals, moves, smooth_distance(mask), distances, slopes, agreement
    )
    return np.clip(distances, -_FAR_PX, _FAR_PX)


def _averages(count: int) -> Floats:
    """Returns (M, N) the matrix that averages N points in runs of a few."""
    runs = np.arange(count) // _TOGETHER
    of_run = runs == np.arange(runs[-1] + 1)[:, None]
    return np.asarray(of_run / of_run.sum(axis=1, keepdims=True))


def _offset(prior: UniformPrior, truth: Pose, generator: np.random.Generator) -> Floats:
    offset = vector_from_pose(prior.draw(truth, generator)) - vector_from_pose(truth)
    offset[5] = wrap_deg(float(offset[5]))
    return np.asarray(offset)


def _sigmas(prior: UniformPrior) -> Floats:
    widths = (prior.x_m, prior.y_m, prior.z_m, prior.pitch_deg, prior.roll_deg, prior.yaw_deg)
    return np.asarray(np.maximum(np.array(widths) / np.sqrt(3.0), 1e-6))
