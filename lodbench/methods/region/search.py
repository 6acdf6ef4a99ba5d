"""From a wide prior to a few distinct poses: a grid, searches from its best samples, refinement."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymap.laser import range_log_densities
from lodbench.datasets.query import Query
from lodbench.estimation.optimization import maximize_abreast
from lodbench.estimation.outline import OutlinePoints, sample_outline
from lodbench.estimation.state_vector import POSE, Gaussian
from lodbench.geometry import Pose, PoseGrid, wrap_deg
from lodbench.geometry.pose import pose_from_vector
from lodbench.kernels.arguments import EdgeArrays
from lodbench.methods.protocol import Streams
from lodbench.methods.region.evidence import Photo, PosePosterior
from lodbench.methods.region.params import RegionParams
from lodbench.methods.region.roofs import RaisedRoofs
from lodbench.methods.search import nothing_fits
from lodbench.rendering import Scorer

Floats = NDArray[np.float64]

# Modes nearer to each other than this are the same one: metres, degrees.
_SAME_M, _SAME_DEG = 3.0, 3.0
# Distance between the points of an outline that say how it moves with the pose, pixels.
_SPACING_PX = 4.0


class Mode(NamedTuple):
    """A mode of the posterior.

    Attributes:
        gaussian: Its pose, and the shape of the posterior around it.
        log_posterior: At the pose, up to a constant.
    """

    gaussian: Gaussian
    log_posterior: float


def grid_starts(query: Query, posterior: PosePosterior, params: RegionParams) -> tuple[Floats, float]:
    """Returns the local maxima of the grid, best first, (N, 6), and the best fit.

    Raises:
        QueryFault: The photo fits no sample at all.
    """
    grid = params.grid()
    vectors = samples(grid, query.prior)
    fits = posterior.fits(vectors)
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
    """Returns which samples of a grid to start from, best first, none another's neighbour.

    Local maxima come first, so that a broad wrong mode does not take every start; then the best besides.

    Args:
        fits: (N,) of the samples.
        grid: They are of.
        turns_around: Whether the first heading is the last one's neighbour.
        most: How many at most.
    """
    values = fits.reshape([axis.count for axis in (grid.yaw, grid.x, grid.y, grid.z)])
    highest = values
    for axis in range(values.ndim):
        around = [(1, 1) if axis == k else (0, 0) for k in range(values.ndim)]
        padded = np.pad(highest, around, mode="wrap" if turns_around and axis == 0 else "edge")
        highest = np.lib.stride_tricks.sliding_window_view(padded, 3, axis).max(axis=-1)
    is_maximum = (values >= highest).ravel()
    places = np.stack(np.unravel_index(np.arange(len(fits)), values.shape), axis=1)
    chosen: list[int] = []
    for i in np.lexsort([-fits, ~is_maximum]):
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
    posterior: PosePosterior,
    jacobian: OutlineJacobian,
    generations: int,
    spread_px: float,
    streams: Streams,
    prune_gap: float = math.inf,
) -> list[Mode]:
    """Returns the distinct modes that local searches from some poses (N, 6) end at, best first.

    Args:
        starts: The poses.
        posterior: What is maximised.
        jacobian: How the outline moves.
        generations: Of each search.
        spread_px: How far outlines lie apart in the first, pixels.
        streams: Of random numbers.
        prune_gap: Searches so many nats behind the best after four generations are given up.
    """
    spreads = {k: jacobian.spread(start, posterior, spread_px) for k, start in enumerate(starts)}
    first = {k: spread for k, spread in spreads.items() if spread is not None}
    generators = [streams(f"climb {spread_px:g}", k) for k in first]
    ends = maximize_abreast(
        posterior.log_posterior, list(first.values()), generations, jacobian.population, generators, prune_gap
    )
    distinct: list[Mode] = []
    for mode in modes_at(ends, posterior):
        if not any(_is_same(mode.gaussian.mean, other.gaussian.mean) for other in distinct):
            distinct.append(mode)
    return distinct


def _is_same(one: Floats, other: Floats) -> bool:
    gap = one - other
    turned = np.abs(wrap_deg(gap[3:]))
    return bool(np.linalg.norm(gap[:3]) <= _SAME_M and turned.max() <= _SAME_DEG)


def rescore(modes: list[Mode], posterior: PosePosterior) -> list[Mode]:
    """Returns the same modes by another posterior, best first."""
    return modes_at([mode.gaussian for mode in modes], posterior)


def modes_at(gaussians: list[Gaussian], posterior: PosePosterior) -> list[Mode]:
    """Returns modes at the means of some Gaussians, best first."""
    if not gaussians:
        return []
    logs = posterior.log_posterior(np.array([gaussian.mean for gaussian in gaussians]))
    modes = [Mode(gaussian, float(log)) for gaussian, log in zip(gaussians, logs, strict=True)]
    return sorted(modes, key=lambda mode: -mode.log_posterior)


class OutlineJacobian:
    """How the outline moves with the state vector, which shapes the first generation of a search."""

    def __init__(self, edges: EdgeArrays, scorer: Scorer, params: RegionParams) -> None:
        self.population = params.population
        self._edges, self._scorer = edges, scorer

    def outline(self, vector: Floats, posterior: PosePosterior) -> OutlinePoints:
        """Returns points of the outline that a pose shows, at the posterior's working size."""
        silhouette = self._scorer.render(posterior.camera, pose_from_vector(vector))
        return sample_outline(self._edges, posterior.camera, vector, silhouette, _SPACING_PX)

    def spread(
        self, vector: Floats, posterior: PosePosterior, spread_px: float, prior: Floats | None = None
    ) -> Gaussian | None:
        """Returns a Gaussian of poses whose outlines lie about ``spread_px`` apart, or as the prior allows.

        Eq. (R8) of docs/methods/region.md.

        None where no outline is in view.

        Args:
            vector: (6,) the pose in the middle; or more of the state vector, as far as (9,): bases of walls.
            posterior: Knows the prior of poses and the working size.
            spread_px: How far apart.
            prior: Information of the prior, of as many.
        """
        points = self.outline(vector[POSE], posterior)
        if not len(points):
            return None
        if prior is None:
            prior = posterior.prior.information()
        slopes = points.slopes(len(vector))
        weights = points.lengths / points.lengths.sum()
        information = (slopes * weights[:, None]).T @ slopes / spread_px**2 + prior
        covariance = np.linalg.inv(information)
        return Gaussian(vector, np.asarray(0.5 * (covariance + covariance.T)))


class Problem(NamedTuple):
    """A query, and what is made of photo and map once.

    Attributes:
        query: The query.
        photo: Its photo, in some sizes.
        city_map: The map.
        roofs: The part of it in reach.
        jacobian: How its outline moves.
    """

    query: Query
    photo: Photo
    city_map: CityMap
    roofs: RaisedRoofs
    jacobian: OutlineJacobian

    def weighed_by_range(self, modes: list[Mode]) -> list[Mode]:
        """Returns modes with what a laser's range says of each, best first."""
        poses = np.array([mode.gaussian.mean for mode in modes])
        logs = range_log_densities(self.query, self.city_map, poses)
        weighed = [
            m._replace(log_posterior=m.log_posterior + log) for m, log in zip(modes, logs, strict=True)
        ]
        return sorted(weighed, key=lambda mode: -mode.log_posterior)

    def posterior(self, params: RegionParams, width: int, is_coarse: bool) -> PosePosterior:
        """Returns the posterior of poses by silhouettes of a width, pixels."""
        return PosePosterior(self.query, self.city_map, self.photo.fit(width, is_coarse), params)
