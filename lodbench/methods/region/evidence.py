"""The posterior of poses and state vectors by a photo's regions and outlines, and the photo in some sizes."""

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
    BASE_OFFSET,
    CAMERAS,
    EAVE_OFFSET,
    LENS,
    OUTLINES,
    POSE,
    ROOFS,
    Prior,
    views_of,
)
from lodbench.geometry import Camera
from lodbench.geometry.pose import vector_from_pose
from lodbench.methods.region.params import RegionParams
from lodbench.methods.region.roofs import RaisedRoofs, step_of
from lodbench.rendering import ContourFit, Fit, RegionFit, Scorer, appearance_bins, edge_bins
from lodbench.rendering.masks import Words
from lodbench.rendering.photo_bins import Levels, directed_edge_levels

Floats = NDArray[np.float64]


class PhotoFit:
    """The region fit, and a weighted contour fit added; a ``Fit``.

    Args:
        photo: As of ``read_picture``.
        size: Width and height of the silhouettes, pixels.
        params: The method's.
        is_coarse: Texture counts too, and edges less: for poses that are metres off.

    Attributes:
        size: As given.
        edge_weight: Of the contour fit.
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
        """Returns the same fit with another weight of the photo's edges."""
        other = copy(self)
        other.edge_weight = weight
        return other


def region(photo: NDArray[Any], size: tuple[int, int]) -> Fit:
    """Returns the code length that a silhouette saves of the photo's regions and edges, nats per pixel.

    Args:
        photo: As of ``read_picture``.
        size: Width and height of the silhouettes to compare.
    """
    return PhotoFit(photo, size, RegionParams(), is_coarse=True)


# A fit takes the building probability unless it declares another input.
region.input = Input.IMAGE  # type: ignore[attr-defined]


class PosePosterior:
    """The posterior of poses by the silhouettes of a map.

    The code lengths count neighbouring pixels as if they were independent; ``effective_pixels`` says how many
    independent ones a photo is worth.

    Attributes:
        camera: Pinhole of the working size.
        fit: Of the photo.
        prior: Of poses.
    """

    def __init__(self, query: Query, scorer: Scorer, fit: PhotoFit, params: RegionParams) -> None:
        self.camera = query.camera.scaled(*fit.size)
        self._scorer, self.fit = scorer, fit
        half_widths = np.array(params.half_widths())
        sigmas = np.array(params.prior_sigmas())
        if query.measured is not None:
            sigmas = query.measured.over(sigmas)
        self.prior = Prior(vector_from_pose(query.prior), sigmas, half_widths)
        self._samples = params.effective_pixels

    def with_edges(self, weight: float) -> PosePosterior:
        """Returns the same posterior with another weight of the photo's edges."""
        other = copy(self)
        other.fit = self.fit.with_edges(weight)
        return other

    def fits(self, vectors: Floats) -> Floats:
        """Returns the (N,) fit of poses (N, 6) or cameras (N, 7), see ``views_of``; nats per pixel."""
        return self._scorer.fit(self.camera, *views_of(vectors), self.fit)

    def log_posterior(self, vectors: Floats) -> Floats:
        """Returns the (N,) logarithm of the posterior of poses (N, 6)."""
        return self.log_likelihood(vectors) + self.prior.log_density(vectors)

    def log_likelihood(self, vectors: Floats) -> Floats:
        """Returns the (N,) logarithm of the likelihood of poses or cameras, up to a constant.

        Eq. (R6) of docs/methods/region.md.
        """
        return np.asarray(self._samples * self.fits(vectors))


# The deviation of roofs that are declared exact: a matrix without a width has no inverse.
_LEAST_SIGMA_M = 1e-3
# Eaves of every other map are its outlines, to so many metres: a standard deviation.
_EXACT_M = 0.03


class StatePosterior:
    """The posterior of state vectors, (N, 10), up to a constant.

    Silhouettes are drawn with the map's bases and eaves, whatever the last two numbers are.
    """

    def __init__(self, query: Query, roofs: RaisedRoofs, fit: PhotoFit, params: RegionParams) -> None:
        self._at = lru_cache(None)(lambda step: PosePosterior(query, roofs.at(step), fit, params))
        self._sigmas_m = np.maximum([params.roofs_m, params.feet_m, params.eaves_m], _LEAST_SIGMA_M)
        self._lens_percent = params.lens_percent

    def at(self, roofs_m: float) -> PosePosterior:
        """Returns the posterior of poses alone, (N, 6), with roofs so much higher."""
        return self._at(int(step_of(np.array(roofs_m))))

    def log_likelihood(self, vectors: Floats) -> Floats:
        """Returns the (N,) logarithm of the photo's likelihood, up to a constant."""
        steps, log_likelihood = step_of(vectors[:, ROOFS]), np.zeros(len(vectors))
        for step in np.unique(steps):
            chosen = steps == step
            log_likelihood[chosen] = self._at(int(step)).log_likelihood(vectors[chosen, :CAMERAS])
        return log_likelihood

    def log_prior(self, vectors: Floats) -> Floats:
        """Returns the (N,) logarithm of the prior, up to a constant. Eq. (R12) of docs/methods/region.md."""
        poses, eaves = self._at(0).prior.log_density(vectors[:, POSE]), vectors[:, EAVE_OFFSET]
        roofs_sigma_m, bases_sigma_m, wide = self._sigmas_m
        exact = np.minimum(_EXACT_M, wide)
        of_eaves = np.logaddexp(*(-0.5 * (eaves / sigma) ** 2 - np.log(sigma) for sigma in (exact, wide)))
        away = vectors[:, [LENS, ROOFS, BASE_OFFSET]] / (self._lens_percent, roofs_sigma_m, bases_sigma_m)
        return np.asarray(poses - 0.5 * (away**2).sum(axis=1) + of_eaves)

    def widened(self, covariance: Floats, most_m: float = math.inf) -> Floats:
        """Returns the covariance (10, 10) of a vector's first numbers, and the prior's of the others.

        Deviations of the latter are ``most_m`` at most.
        """
        known = len(covariance)
        whole = np.diag(np.concatenate([np.zeros(CAMERAS), np.minimum(self._sigmas_m, most_m) ** 2]))
        whole[:known, :known] = covariance
        return whole

    def prior_information(self, most_m: float = math.inf) -> Floats:
        """Returns (9, 9) the inverse of the prior's covariance of all but eaves.

        Deviations of roofs and bases are ``most_m`` at most.
        """
        sigmas = [self._lens_percent, *np.minimum(self._sigmas_m[:-1], most_m)]
        information = np.zeros((OUTLINES, OUTLINES))
        information[POSE, POSE] = self._at(0).prior.information()
        information[LENS:, LENS:] = np.diag(np.array(sigmas) ** -2.0)
        return information


View = TypeVar("View")


class Photo:
    """A photo in some sizes: what parts its regions, and its edges after some blurs.

    With several threads what is usually asked for is prepared beside the search.

    Args:
        pixels: As of ``read_picture``.
        camera: The photo's.
        params: The method's.
        threads: To work on.
        blurs_px: That will be asked for, pixels of the width at which lines are laid.
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
        """Returns the fit of silhouettes so wide, pixels; see ``PhotoFit``."""
        return self._begin(self._make_fit, width, is_coarse).result()

    def levels(self, blur_px: float, width: int | None = None) -> Levels:
        """Returns how strongly the photo changes, (H, W, 12) as of ``directed_edge_levels``.

        Args:
            blur_px: Of the photo, pixels of the width.
            width: Pixels; None for that at which lines are laid.
        """
        return self._begin(self._make_levels, width or self._params.lines_width, blur_px).result()

    def _begin(self, make: Callable[..., View], *what: Any) -> Future[View]:
        # Only the query's own thread asks. By name: a bound method would keep the photo from being let go.
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
