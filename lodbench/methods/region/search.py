"""From a wide prior to a few distinct modes: a grid of poses, and local searches from its best ones."""

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
from lodbench.methods.fits import nothing_fits
from lodbench.methods.protocol import Streams
from lodbench.methods.region.params import RegionParams
from lodbench.methods.region.posteriors import Photo, PosePosterior
from lodbench.methods.region.roofs import RaisedRoofs
from lodbench.rendering import Scorer

Floats = NDArray[np.float64]

# Modes whose positions and angles differ by no more count as one: metres, degrees.
_SAME_M, _SAME_DEG = 3.0, 3.0
# Distance between the points of an outline at which its derivative by the pose is taken, pixels.
_SPACING_PX = 4.0


class Mode(NamedTuple):
    """A mode of the posterior.

    Attributes:
        gaussian: its pose, and the shape of the posterior around it.
        log_posterior: the log-posterior at the pose, up to a constant.
    """

    gaussian: Gaussian
    log_posterior: float


def grid_starts(query: Query, posterior: PosePosterior, params: RegionParams) -> tuple[Floats, float]:
    """Returns the (N, 6) local maxima of the fit on the grid, best first, and the best fit, nats per pixel.

    Raises:
        QueryFault: The photo fits no pose of the grid.
    """
    grid = params.grid()
    vectors = grid_poses(grid, query.prior)
    fits = posterior.fits(vectors)
    best = float(fits.max())
    if best <= 0:
        raise nothing_fits("the photo fits no view of the map")
    return vectors[local_maxima(fits, grid, params.turns_around(), params.num_starts())], best


def grid_poses(grid: PoseGrid, prior: Pose) -> Floats:
    """Returns the (N, 6) poses of a grid around a prior, in the grid's order; metres and degrees."""
    centers, yaws = grid.around(prior)
    pitch, roll, _ = prior.euler
    return np.column_stack([centers, np.broadcast_to([pitch, roll], (len(yaws), 2)), yaws])


def local_maxima(fits: Floats, grid: PoseGrid, turns_around: bool, most: int) -> list[int]:
    """Returns the indices of the poses of a grid to start from, best first, none another's neighbour.

    Local maxima come first, so that a broad wrong mode does not take every start; then the best of the rest.

    Args:
        fits: (N,) fit of each pose of the grid.
        grid: the grid.
        turns_around: whether the first yaw is a neighbour of the last.
        most: largest number of indices.
    """
    values = fits.reshape([axis.count for axis in (grid.yaw, grid.x, grid.y, grid.z)])
    highest = values
    for axis in range(values.ndim):
        around = [(1, 1) if axis == k else (0, 0) for k in range(values.ndim)]
        padded = np.pad(highest, around, mode="wrap" if turns_around and axis == 0 else "edge")
        highest = np.lib.stride_tricks.sliding_window_view(padded, 3, axis).max(axis=-1)
    is_maximum = (values >= highest).ravel()
    grid_indices = np.stack(np.unravel_index(np.arange(len(fits)), values.shape), axis=1)
    chosen: list[int] = []
    for i in np.lexsort([-fits, ~is_maximum]):
        gaps = np.abs(grid_indices[chosen] - grid_indices[i])
        if turns_around:
            gaps[:, 0] = np.minimum(gaps[:, 0], grid.yaw.count - gaps[:, 0])
        if (gaps.max(axis=1, initial=0) > 1).all():
            chosen.append(int(i))
        if len(chosen) == most:
            break
    return chosen


def local_searches(
    starts: Floats,
    posterior: PosePosterior,
    outlines: OutlineSampler,
    generations: int,
    spacing_px: float,
    streams: Streams,
    prune_gap: float = math.inf,
) -> list[Mode]:
    """Returns the distinct modes that local searches from some poses end at, best first.

    Args:
        starts: (N, 6) the poses.
        posterior: the posterior that is maximised.
        outlines: gives the shape of each first generation.
        generations: number of generations of each search.
        spacing_px: how far apart the outlines of a first generation lie, pixels.
        streams: random streams.
        prune_gap: searches whose log-posterior is lower than the best by more after four generations end.
    """
    initial = [outlines.initial_gaussian(start, posterior, spacing_px) for start in starts]
    first = {k: gaussian for k, gaussian in enumerate(initial) if gaussian is not None}
    generators = [streams(f"climb {spacing_px:g}", k) for k in first]
    ends = maximize_abreast(
        posterior.log_posterior, list(first.values()), generations, outlines.population, generators, prune_gap
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
    """Returns the same modes with their log-posteriors by another posterior, best first."""
    return modes_at([mode.gaussian for mode in modes], posterior)


def modes_at(gaussians: list[Gaussian], posterior: PosePosterior) -> list[Mode]:
    """Returns the modes at the means of some Gaussians, best first."""
    if not gaussians:
        return []
    logs = posterior.log_posterior(np.array([gaussian.mean for gaussian in gaussians]))
    modes = [Mode(gaussian, float(log)) for gaussian, log in zip(gaussians, logs, strict=True)]
    return sorted(modes, key=lambda mode: -mode.log_posterior)


class OutlineSampler:
    """Points of the outline that a pose shows, and the Gaussian of poses whose outlines lie near it."""

    def __init__(self, edges: EdgeArrays, scorer: Scorer, params: RegionParams) -> None:
        self.population = params.population
        self._edges, self._scorer = edges, scorer

    def outline(self, vector: Floats, posterior: PosePosterior) -> OutlinePoints:
        """Returns points of the outline that a pose, (6,), shows, at the posterior's working size."""
        silhouette = self._scorer.render(posterior.camera, pose_from_vector(vector))
        return sample_outline(self._edges, posterior.camera, vector, silhouette, _SPACING_PX)

    def initial_gaussian(
        self, vector: Floats, posterior: PosePosterior, spacing_px: float, prior: Floats | None = None
    ) -> Gaussian | None:
        """Returns a Gaussian of vectors whose outlines lie about ``spacing_px`` apart, if the prior allows.

        Eq. (R8) of docs/methods/region.md; None where no outline is in view.

        Args:
            vector: (N,) its mean: a pose, (6,), or the first numbers of a state vector, up to (9,).
            posterior: gives the working size, and the prior of poses.
            spacing_px: distance between outlines, pixels.
            prior: (N, N) information of the prior; for (6,) that of the posterior's by default.
        """
        points = self.outline(vector[POSE], posterior)
        if not len(points):
            return None
        if prior is None:
            prior = posterior.prior.information()
        slopes = points.slopes(len(vector))
        weights = points.lengths / points.lengths.sum()
        information = (slopes * weights[:, None]).T @ slopes / spacing_px**2 + prior
        covariance = np.linalg.inv(information)
        return Gaussian(vector, np.asarray(0.5 * (covariance + covariance.T)))


class QueryContext(NamedTuple):
    """A query, and what is computed once from its photo and its map.

    Attributes:
        query: the query.
        photo: its photo, at several sizes.
        city_map: the map.
        roofs: the buildings of the map in reach, whose roofs can be raised.
        outlines: samples their outline.
    """

    query: Query
    photo: Photo
    city_map: CityMap
    roofs: RaisedRoofs
    outlines: OutlineSampler

    def with_laser_range(self, modes: list[Mode]) -> list[Mode]:
        """Returns modes with the log-density of a laser's range added, (M9), best first."""
        poses = np.array([mode.gaussian.mean for mode in modes])
        logs = range_log_densities(self.query, self.city_map, poses)
        with_range = [
            m._replace(log_posterior=m.log_posterior + log) for m, log in zip(modes, logs, strict=True)
        ]
        return sorted(with_range, key=lambda mode: -mode.log_posterior)

    def posterior(self, params: RegionParams, width: int, is_coarse: bool) -> PosePosterior:
        """Returns the posterior of poses by silhouettes of a width, pixels, of the map as it is."""
        return PosePosterior(self.query, self.city_map, self.photo.fit(width, is_coarse), params)
