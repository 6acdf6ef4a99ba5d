"""Posteriors of poses and state vectors by a photo's regions and edges; the photo at several sizes."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Query
from lodbench.estimation.state_vector import (
    ALL_BASES,
    ALL_OVERHANGS,
    ALL_ROOFS,
    FOCAL,
    NUM_POSE_AND_FOCAL,
    NUM_WITH_BASES,
    POSE,
    Prior,
    views_of,
)
from lodbench.geometry import Camera
from lodbench.geometry.pose import vector_from_pose
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
