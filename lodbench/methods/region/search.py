"""From a wide prior to a few distinct poses: a grid, climbs from its best samples, refinement."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.datasets.query import Query
from lodbench.geometry import Pose, PoseGrid
from lodbench.geometry.pose_vector import pose_from_vector, rotation_derivatives
from lodbench.kernels.arguments import EdgeArrays
from lodbench.methods.contour_alignment.outline import OutlinePoints, sample_outline
from lodbench.methods.fits import nothing_fits
from lodbench.methods.protocol import Streams
from lodbench.methods.region.evidence import Evidence
from lodbench.methods.region.evolution import Cloud, maximize_abreast
from lodbench.methods.region.params import POSE, Params
from lodbench.rendering import Scorer

Floats = NDArray[np.float64]

# Tops of climbs nearer to each other than this are the same one: metres, degrees.
_SAME_M, _SAME_DEG = 3.0, 3.0
# Distance between the points of an outline that say how it moves with the pose, pixels.
_SPACING_PX = 4.0


class Mode(NamedTuple):
    """A top of the posterior.

    Attributes:
        cloud: Its pose and the shape of its surroundings.
        log_posterior: At the pose, up to a constant.
    """

    cloud: Cloud
    log_posterior: float


def grid_starts(query: Query, evidence: Evidence, params: Params) -> tuple[Floats, float]:
    """Returns the tops of the grid, best first, none another's neighbour, (N, 6), and the best fit.

    Raises:
        QueryFault: The photo fits no sample at all.
    """
    grid = params.grid()
    vectors = samples(grid, query.prior)
    fits = evidence.fits(vectors)
    best = float(fits.max())
    if best <= 0:
        raise nothing_fits("the photo fits no view of the map")
    return vectors[local_maxima(fits, grid, params.turns_around(), params.num_starts())], best


def samples(grid: PoseGrid, prior: Pose) -> Floats:
    """Returns the (N, 6) poses of a grid around a prior, in the grid's order; metres and degrees."""
    centers, yaws = grid.around(prior)
    pitch, roll, _ = prior.euler
    return np.column_stack([centers, np.broadcast_to([pitch, roll], (len(yaws), 2)), yaws])


def local_maxima(fits: Floats, grid: PoseGrid, turns_around: bool, most: int) -> list[int]:
    """Returns which samples of a grid to climb from, best first, none another's neighbour.

    Tops first, one of each hill: a broad false one shall not take every start. Then the best besides.

    Args:
        fits: (N,) of the samples.
        grid: They are of.
        turns_around: Whether the first heading is the last one's neighbour.
        most: How many at most.
    """
    values = fits.reshape([axis.count for axis in (grid.yaw, grid.x, grid.y, grid.z)])
    ends = ["wrap" if turns_around else "nearest", "nearest", "nearest", "nearest"]
    is_top = (values >= scipy.ndimage.maximum_filter(values, size=3, mode=ends)).ravel()
    places = np.stack(np.unravel_index(np.arange(len(fits)), values.shape), axis=1)
    chosen: list[int] = []
    for i in np.lexsort([-fits, ~is_top]):
        gaps = np.abs(places[chosen] - places[i])
        if turns_around:
            gaps[:, 0] = np.minimum(gaps[:, 0], grid.yaw.count - gaps[:, 0])
        if (gaps.max(axis=1, initial=0) > 1).all():
            chosen.append(int(i))
        if len(chosen) == most:
            break
    return chosen


def refine_candidates(
    starts: Floats,
    evidence: Evidence,
    around: OutlineJacobian,
    generations: int,
    spread_px: float,
    streams: Streams,
    hopeless: float = math.inf,
) -> list[Mode]:
    """Returns the distinct tops that climbs from some poses (N, 6) end on, best first.

    Args:
        starts: The poses.
        evidence: What they climb by.
        around: How the outline moves.
        generations: How many.
        spread_px: How far outlines lie apart in the first, pixels.
        streams: Of random numbers.
        hopeless: By how many nats a climb that is given up is behind the best after four generations.
    """
    clouds = {k: around.cloud(start, evidence, spread_px) for k, start in enumerate(starts)}
    shapes = {k: shape for k, shape in clouds.items() if shape is not None}
    generators = [streams(f"climb {spread_px:g}", k) for k in shapes]
    climbs = maximize_abreast(
        evidence.log_posterior, list(shapes.values()), generations, around.population, generators, hopeless
    )
    modes_found = modes_of(climbs, evidence)
    modes_found.sort(key=lambda top: -top.log_posterior)
    distinct: list[Mode] = []
    for top in modes_found:
        if not any(_is_same(top.cloud.mean, other.cloud.mean) for other in distinct):
            distinct.append(top)
    return distinct


def _is_same(one: Floats, other: Floats) -> bool:
    gap = one - other
    turned = np.abs((gap[3:] + 180.0) % 360.0 - 180.0)
    return bool(np.linalg.norm(gap[:3]) <= _SAME_M and turned.max() <= _SAME_DEG)


def rescore(modes: list[Mode], evidence: Evidence) -> list[Mode]:
    """Returns the same tops as another evidence sees them, best first."""
    return sorted(modes_of([mode.cloud for mode in modes], evidence), key=lambda mode: -mode.log_posterior)


def modes_of(clouds: list[Cloud], evidence: Evidence) -> list[Mode]:
    """Returns what an evidence says of the means of some clouds."""
    if not clouds:
        return []
    logs = evidence.log_posterior(np.array([cloud.mean for cloud in clouds]))
    return [Mode(cloud, float(log)) for cloud, log in zip(clouds, logs, strict=True)]


class OutlineJacobian:
    """How the outline moves around a pose, which shapes the first generation of a climb."""

    def __init__(self, edges: EdgeArrays, scorer: Scorer, params: Params) -> None:
        self.population = params.population
        self._edges, self._scorer = edges, scorer

    def outline(self, vector: Floats, evidence: Evidence) -> OutlinePoints:
        """Returns points of the outline that a pose shows, at the evidence's size."""
        camera, pose = evidence.camera, pose_from_vector(vector)
        silhouette = self._scorer.render(camera, pose)
        turns = rotation_derivatives(vector)
        return sample_outline(self._edges, camera, pose, turns, silhouette, _SPACING_PX)

    def cloud(
        self, vector: Floats, evidence: Evidence, spread_px: float, prior: Floats | None = None
    ) -> Cloud | None:
        """Returns poses whose outlines lie about ``spread_px`` apart, or the prior allows no more.

        Eq. (R8) of docs/methods/region.md.

        None where no outline is in view.

        Args:
            vector: (6,) the pose in the middle; or more of ``unknowns`` with it, as far as (9,): feet.
            evidence: Knows the prior of poses and the working size.
            spread_px: How far apart.
            prior: Information beforehand, of as many.
        """
        points = self.outline(vector[POSE], evidence)
        if not len(points):
            return None
        if prior is None:
            prior = evidence.prior_information()
        slopes = (points.moves[:, : len(vector)] * points.normals[:, None, :]).sum(axis=2)
        weights = points.lengths / points.lengths.sum()
        information = (slopes * weights[:, None]).T @ slopes / spread_px**2 + prior
        covariance = np.linalg.inv(information)
        return Cloud(vector, np.asarray(0.5 * (covariance + covariance.T)))
