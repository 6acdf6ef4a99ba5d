"""Posteriors of poses and state vectors by a photo's regions and edges, and the search for their modes.

The photo is looked at in several sizes. A wide prior becomes a few distinct modes by a grid of poses, and
local searches from its best ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymap.laser import range_log_densities
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Query
from lodbench.estimation.optimization import maximize_abreast
from lodbench.estimation.outline_alignment import OutlinePoints, sample_outline
from lodbench.estimation.state_vector import (
    ALL_BASES,
    ALL_OVERHANGS,
    ALL_ROOFS,
    FOCAL,
    NUM_POSE_AND_FOCAL,
    NUM_WITH_BASES,
    POSE,
    Gaussian,
    Prior,
    views_of,
)
from lodbench.geometry import Camera, Pose, PoseGrid, wrap_deg
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.kernels.arguments import EdgeArrays
from lodbench.methods.fits import nothing_fits
from lodbench.methods.protocol import Streams
from lodbench.methods.region.params import RegionParams
from lodbench.methods.region.roofs import RaisedRoofs, roof_level_of
from lodbench.rendering import ContourFit, Fit, RegionFit, Scorer, appearance_bins, edge_bins
from lodbench.rendering.masks import Words
from lodbench.rendering.photo_bins import Levels, directed_edge_levels

Floats = NDArray[np.float64]


class PhotoFit:
    """The region fit plus a weighted contour fit; a ``Fit``.

    Args:
        photo: the photo, as returned by ``read_picture``.
        size: width and height of the silhouettes, pixels.
        params: the method's parameters.
        is_coarse: whether texture is used as well, and edges weigh less: for poses that are metres off.

    Attributes:
        size: the size.
        edge_weight: weight of the contour fit.
    """

    def __init__(
        self, photo: NDArray[Any], size: tuple[int, int], params: RegionParams, is_coarse: bool
    ) -> None:
        self.size = size
        self._region = RegionFit(*appearance_bins(photo, size, has_texture=is_coarse))
        self.edge_weight = params.coarse_edge_weight if is_coarse else params.edge_weight
        self._contour = ContourFit(*edge_bins(photo, size, params.edge_blur_px))

    def __call__(self, words: Words) -> Floats:
        """Returns the (N,) fit of N silhouettes, nats per pixel. Eq. (R5) of docs/methods/region.md."""
        regions = self._region(words)
        return regions + self.edge_weight * self._contour(words) if self.edge_weight > 0 else regions

    def with_edges(self, weight: float) -> PhotoFit:
        """Returns the same fit with another weight of the contour fit."""
        other = copy(self)
        other.edge_weight = weight
        return other


def region(photo: NDArray[Any], size: tuple[int, int]) -> Fit:
    """Returns the fit whose value is the code length that a silhouette saves, nats per pixel.

    Args:
        photo: the photo, as returned by ``read_picture``.
        size: width and height of the silhouettes to compare, pixels.
    """
    return PhotoFit(photo, size, RegionParams(), is_coarse=True)


# A fit takes the building probability unless it declares another input.
region.input = Input.IMAGE  # type: ignore[attr-defined]


class PosePosterior:
    """The posterior of poses by the silhouettes of a map.

    Code lengths count neighbouring pixels as if they were independent; ``effective_pixels`` is the number of
    independent ones that a photo is worth.

    Attributes:
        camera: pinhole of the working size.
        fit: the fit of silhouettes to the photo.
        prior: the prior of poses.
    """

    def __init__(self, query: Query, scorer: Scorer, fit: PhotoFit, params: RegionParams) -> None:
        self.camera = query.camera.scaled(*fit.size)
        self._scorer, self.fit = scorer, fit
        half_widths = np.array(params.half_widths())
        sigmas = np.array(params.prior_sigmas())
        if query.measured is not None:
            sigmas = query.measured.over(sigmas)
        self.prior = Prior(vector_from_pose(query.prior), sigmas, half_widths)
        self._effective_pixels = params.effective_pixels

    def with_edges(self, weight: float) -> PosePosterior:
        """Returns the same posterior with another weight of the contour fit."""
        other = copy(self)
        other.fit = self.fit.with_edges(weight)
        return other

    def fits(self, vectors: Floats) -> Floats:
        """Returns the (N,) fit, nats per pixel, of poses (N, 6), or (N, 7) with the focal length."""
        return self._scorer.fit(self.camera, *views_of(vectors), self.fit)

    def log_posterior(self, vectors: Floats) -> Floats:
        """Returns the (N,) logarithm of the posterior of poses (N, 6)."""
        return self.log_likelihood(vectors) + self.prior.log_density(vectors)

    def log_likelihood(self, vectors: Floats) -> Floats:
        """Returns the (N,) log-likelihood of poses (N, 6), or (N, 7) with the focal length, up to a constant.

        Eq. (R6) of docs/methods/region.md.
        """
        return np.asarray(self._effective_pixels * self.fits(vectors))


# The least standard deviation of roofs, bases and overhangs, metres: a covariance is inverted, also where a
# setting of 0 declares the map exact.
_LEAST_SIGMA_M = 1e-3
# Standard deviation of the overhang of maps that are exact there, metres: half of the prior's weight.
_EXACT_OVERHANG_M = 0.03


class StatePosterior:
    """The posterior of state vectors, (N, 10), by regions, up to a constant.

    Silhouettes are drawn with the bases, the overhangs and the heights of single roofs that ``roofs`` has:
    within a round of the alignment these are fixed, whatever the last two numbers of a vector are.
    """

    def __init__(self, query: Query, roofs: RaisedRoofs, fit: PhotoFit, params: RegionParams) -> None:
        self._at_level = lru_cache(None)(lambda level: PosePosterior(query, roofs.at(level), fit, params))
        self._sigmas_m = np.maximum([params.roofs_m, params.feet_m, params.eaves_m], _LEAST_SIGMA_M)
        self._lens_percent = params.lens_percent

    def of_poses(self, roof_offset_m: float) -> PosePosterior:
        """Returns the posterior of poses alone, (N, 6), given the offset of all roofs, metres."""
        return self._at_level(int(roof_level_of(np.array(roof_offset_m))))

    def log_likelihood(self, vectors: Floats) -> Floats:
        """Returns the (N,) log-likelihood of state vectors, up to a constant; Eq. (R6), at roof levels."""
        roof_levels, log_likelihood = roof_level_of(vectors[:, ALL_ROOFS]), np.zeros(len(vectors))
        for level in np.unique(roof_levels):
            chosen = roof_levels == level
            cameras = vectors[chosen, :NUM_POSE_AND_FOCAL]
            log_likelihood[chosen] = self._at_level(int(level)).log_likelihood(cameras)
        return log_likelihood

    def log_prior(self, vectors: Floats) -> Floats:
        """Returns the (N,) log-prior, up to a constant. Eq. (R12) of docs/methods/region.md."""
        poses, overhangs = self._at_level(0).prior.log_density(vectors[:, POSE]), vectors[:, ALL_OVERHANGS]
        roof_sigma_m, base_sigma_m, overhang_sigma_m = self._sigmas_m
        exact_m = np.minimum(_EXACT_OVERHANG_M, overhang_sigma_m)
        of_overhangs = np.logaddexp(
            *(-0.5 * (overhangs / sigma) ** 2 - np.log(sigma) for sigma in (exact_m, overhang_sigma_m))
        )
        others = vectors[:, [FOCAL, ALL_ROOFS, ALL_BASES]] / (self._lens_percent, roof_sigma_m, base_sigma_m)
        return np.asarray(poses - 0.5 * (others**2).sum(axis=1) + of_overhangs)

    def with_prior_of_rest(self, covariance: Floats, most_m: float = math.inf) -> Floats:
        """Returns a covariance (10, 10): the given one of the first numbers, the prior's of the others.

        Standard deviations of roofs, bases and overhangs are ``most_m`` at most.
        """
        count = len(covariance)
        variances = np.minimum(self._sigmas_m, most_m) ** 2
        whole = np.diag(np.concatenate([np.zeros(NUM_POSE_AND_FOCAL), variances]))
        whole[:count, :count] = covariance
        return whole

    def prior_information(self, most_m: float = math.inf) -> Floats:
        """Returns (9, 9) the inverse of the prior's covariance of all numbers but the overhang.

        Standard deviations of roofs and bases are ``most_m`` at most.
        """
        sigmas = [self._lens_percent, *np.minimum(self._sigmas_m[:-1], most_m)]
        information = np.zeros((NUM_WITH_BASES, NUM_WITH_BASES))
        information[POSE, POSE] = self._at_level(0).prior.information()
        information[FOCAL:, FOCAL:] = np.diag(np.array(sigmas) ** -2.0)
        return information


Prepared = TypeVar("Prepared")


class Photo:
    """A photo at several sizes: fits of silhouettes to it, and levels of its edges after several blurs.

    With several threads, what is usually needed is computed concurrently with the search.

    Args:
        pixels: the photo, as returned by ``read_picture``.
        camera: its camera.
        params: the method's parameters.
        threads: number of threads.
        blurs_px: standard deviations of the blurs that will be needed, pixels of ``lines_width``.
    """

    def __init__(
        self,
        pixels: NDArray[np.uint8],
        camera: Camera,
        params: RegionParams,
        threads: int = 1,
        blurs_px: tuple[float, ...] = (),
    ) -> None:
        self._pixels, self._camera, self._params = pixels, camera, params
        self._pool, self._begun = ThreadPoolExecutor(threads), dict[tuple[Any, ...], Future[Any]]()
        if threads > 1:
            self._begin(self._make_fit, params.coarse_width, True)
            self._begin(self._make_fit, params.fine_width, False)
            for blur_px in blurs_px if params.lines_weight > 0 else ():
                self._begin(self._make_levels, params.lines_width, blur_px)

    def fit(self, width: int, is_coarse: bool) -> PhotoFit:
        """Returns the fit of silhouettes of a width, pixels; see ``PhotoFit``."""
        return self._begin(self._make_fit, width, is_coarse).result()

    def levels(self, blur_px: float, width: int | None = None) -> Levels:
        """Returns the (H, W, 12) edge levels of the photo, as returned by ``directed_edge_levels``.

        Args:
            blur_px: standard deviation of the blur, pixels of the width.
            width: width of the photo, pixels; None for ``lines_width``.
        """
        return self._begin(self._make_levels, width or self._params.lines_width, blur_px).result()

    def _begin(self, make: Callable[..., Prepared], *what: Any) -> Future[Prepared]:
        # Called by the query's own thread only. A bound method as key would keep the photo alive.
        key = (make.__name__, *what)
        if key not in self._begun:
            self._begun[key] = self._pool.submit(make, *what)
        return self._begun[key]

    def _make_fit(self, width: int, is_coarse: bool) -> PhotoFit:
        return PhotoFit(self._pixels, self._size(width), self._params, is_coarse)

    def _make_levels(self, width: int, blur_px: float) -> Levels:
        return directed_edge_levels(self._pixels, self._size(width), blur_px)

    def _size(self, width: int) -> tuple[int, int]:
        """Returns a width and the height that keeps the photo's aspect; never more than the photo has."""
        small = self._camera.scaled_to_width(min(width, self._camera.width))
        return small.width, small.height


# Modes whose positions and angles differ by no more count as one: metres, degrees.
_SAME_M, _SAME_DEG = 3.0, 3.0
# Distance between the points of an outline at which its derivative by the pose is taken, pixels.
_SPACING_PX = 4.0


class Mode(NamedTuple):
    """A mode of the posterior."""

    gaussian: Gaussian  # its pose, and the shape of the posterior around it
    log_posterior: float  # the log-posterior at the pose, up to a constant


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
        pad_width = [(1, 1) if axis == k else (0, 0) for k in range(values.ndim)]
        padded = np.pad(highest, pad_width, mode="wrap" if turns_around and axis == 0 else "edge")
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
    """A query, and what is computed once from its photo and its map."""

    query: Query  # the query
    photo: Photo  # its photo, at several sizes
    city_map: CityMap  # the map
    roofs: RaisedRoofs  # the buildings of the map in reach, whose roofs can be raised
    outlines: OutlineSampler  # samples their outline

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
