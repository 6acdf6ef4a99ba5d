"""What a photo says of poses: code lengths of its regions and edges, under the prior."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Query
from lodbench.geometry import Camera, wrap_deg
from lodbench.geometry.angles import rotations_from_euler
from lodbench.geometry.pose_vector import vector_from_pose
from lodbench.methods.region.params import CAMERAS, LENS, Params, working_size
from lodbench.rendering import ContourFit, Fit, RegionFit, Scorer, appearance_bins, edge_bins
from lodbench.rendering.bits import Words
from lodbench.rendering.photo_bins import Levels, directed_edge_levels

Floats = NDArray[np.float64]


# How softly a prior's range ends, as a share of its half width: x, y, z, pitch, roll and yaw. Softly in what
# is often told narrower than it is.
_EDGE_SHARES = np.array([1.0, 1.0, 0.1, 0.1, 0.1, 0.5])
# And where it ends for good, in half widths, and how softly there: evidence of pixels that are not
# independent outweighs any softer end, and from far below nearly every photo is parted well by some roof.
_WALLS, _WALL_SHARE = np.array([np.inf, np.inf, 1.3, 5.0, 5.0, 2.5]), 0.02


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

    def __init__(self, photo: NDArray[Any], size: tuple[int, int], params: Params, is_coarse: bool) -> None:
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
    return PhotoFit(photo, size, Params(), is_coarse=True)


# A fit is made of a probability where nothing is said.
region.input = Input.IMAGE  # type: ignore[attr-defined]


class Evidence:
    """The logarithm of what a photo and a prior say together of poses, up to a constant.

    The code lengths count neighbouring pixels as if each were seen for itself; ``effective_pixels`` says how
    many independent ones a photo is worth.

    Attributes:
        camera: Pinhole of the working size.
        fit: Of the photo.
    """

    def __init__(self, query: Query, scorer: Scorer, fit: PhotoFit, params: Params) -> None:
        self.camera = query.camera.scaled(*fit.size)
        self._scorer, self.fit = scorer, fit
        self._prior = vector_from_pose(query.prior)
        self._sigmas = np.array(params.prior_sigmas())
        self._range = np.array(params.half_widths())
        self._samples = params.effective_pixels

    def with_edges(self, weight: float) -> Evidence:
        """Returns the same evidence with another weight of the photo's edges."""
        other = copy(self)
        other.fit = self.fit.with_edges(weight)
        return other

    def fits(self, vectors: Floats) -> Floats:
        """Returns the (N,) fit of poses (N, 6) or cameras (N, 7), see ``views_of``; nats per pixel."""
        return self._scorer.fit(self.camera, *views_of(vectors), self.fit)

    def log_posterior(self, vectors: Floats) -> Floats:
        """Returns the (N,) logarithm of the posterior of poses (N, 6)."""
        return self.log_likelihood(vectors) + self.log_prior(vectors)

    def log_likelihood(self, vectors: Floats) -> Floats:
        """Returns the (N,) logarithm of the likelihood of poses or cameras, up to a constant.

        Eq. (R6) of docs/methods/region.md.
        """
        return np.asarray(self._samples * self.fits(vectors))

    def log_prior(self, vectors: Floats) -> Floats:
        """Returns the (N,) logarithm of the prior of poses (N, 6), up to a constant.

        Eq. (R7) of docs/methods/region.md.
        """
        offsets = self.offsets(vectors)
        beyond = np.maximum(np.abs(offsets) - self._range, 0.0) / (_EDGE_SHARES * self._range)
        through = np.maximum(np.abs(offsets) - _WALLS * self._range, 0.0) / (_WALL_SHARE * self._range)
        return np.asarray(-0.5 * ((offsets / self._sigmas) ** 2 + beyond**2 + through**2).sum(axis=1))

    def offsets(self, vectors: Floats) -> Floats:
        """Returns (N, 6) how far poses (N, 6) are from the prior, metres and degrees."""
        offsets = vectors - self._prior
        offsets[:, 5] = wrap_deg(offsets[:, 5])
        return np.asarray(offsets)

    def prior_information(self) -> Floats:
        """Returns (6, 6) the inverse of the prior's covariance."""
        return np.diag(self._sigmas**-2.0)


def views_of(vectors: Floats) -> tuple[Floats, Floats]:
    """Returns the rotations (N, 3, 3) and centres (N, 3), metres, that show what some cameras see.

    A longer lens stretches what a camera sees across and down, and so do the first two rows of a rotation
    that are stretched: cameras of many lenses are drawn as if they had the one that is told.

    Args:
        vectors: (N, 6) poses, centre in metres and angles in degrees; or (N, 7 or more), then by how many
            percent the lens is longer than told.
    """
    rotations = rotations_from_euler(vectors[:, 3:6])
    # Of poses the slice is empty, and its sum 0.
    rotations[:, :2] *= 1.0 + 0.01 * vectors[:, LENS:CAMERAS].sum(axis=1)[:, None, None]
    return rotations, np.ascontiguousarray(vectors[:, :3])


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
        params: Params,
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
        return PhotoFit(self._pixels, working_size(self._camera, width), self._params, is_coarse)

    def _make_levels(self, width: int, blur_px: float) -> Levels:
        return directed_edge_levels(self._pixels, working_size(self._camera, width), blur_px)
