"""What a photo says of poses: code lengths of its regions and edges, under the prior."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Query
from lodbench.geometry import EulerAngles, wrap_deg
from lodbench.geometry.angles import rotation_from_euler
from lodbench.methods.contour_alignment.pose_vector import vector_from_pose
from lodbench.methods.region.params import Params
from lodbench.rendering import ContourFit, Fit, RegionFit, Scorer, appearance_bins, edge_bins
from lodbench.rendering.bits import Words

Floats = NDArray[np.float64]


# How softly a prior's range ends, as a share of its half width.
_EDGE_SHARE = 0.1


class PhotoFit:
    """The region fit, and a weighted contour fit added; a ``Fit``.

    Args:
        photo: As of ``read_picture``.
        size: Width and height of the silhouettes, pixels.
        params: The method's.
        is_coarse: Texture instead of edges: for poses that are metres off.
    """

    def __init__(self, photo: NDArray[Any], size: tuple[int, int], params: Params, is_coarse: bool) -> None:
        self.size = size
        self._region = RegionFit(*appearance_bins(photo, size, has_texture=is_coarse))
        self._contour: Fit | None = None
        self._weight = 0.0 if is_coarse else params.edge_weight
        if self._weight > 0:
            self._contour = ContourFit(*edge_bins(photo, size, params.edge_blur_px))

    def __call__(self, words: Words) -> Floats:
        """Returns the (N,) fit of N silhouettes, nats per pixel."""
        regions = self._region(words)
        return regions if self._contour is None else regions + self._weight * self._contour(words)


class Evidence:
    """The logarithm of what a photo and a prior say together of poses, up to a constant.

    The code lengths count neighbouring pixels as if each were seen for itself; ``effective_pixels`` says how
    many independent ones a photo is worth.

    Attributes:
        camera: Pinhole of the working size.
    """

    def __init__(self, query: Query, scorer: Scorer, fit: Fit, params: Params) -> None:
        self.camera = query.camera.scaled(*fit.size)
        self._scorer, self._fit = scorer, fit
        self._prior = vector_from_pose(query.prior)
        self._sigmas = np.array(params.prior_sigmas())
        self._range = np.array(params.half_widths())
        self._samples = params.effective_pixels

    def fits(self, vectors: Floats) -> Floats:
        """Returns the (N,) fit of poses (N, 6), centre in metres and angles in degrees; nats per pixel."""
        rotations = np.stack([rotation_from_euler(EulerAngles(*(float(a) for a in v[3:]))) for v in vectors])
        return self._scorer.fit(self.camera, rotations, np.ascontiguousarray(vectors[:, :3]), self._fit)

    def log_posterior(self, vectors: Floats) -> Floats:
        """Returns the (N,) logarithm of the posterior of poses (N, 6)."""
        return self.nats(vectors) + self.log_prior(vectors)

    def nats(self, vectors: Floats) -> Floats:
        """Returns the (N,) logarithm of the photo's likelihood, up to a constant."""
        return np.asarray(self._samples * self.fits(vectors))

    def log_prior(self, vectors: Floats) -> Floats:
        """Returns the (N,) logarithm of the prior, up to a constant."""
        offsets = self.offsets(vectors)
        # What lies outside the prior's range by a fifth of it is as unlikely as one standard deviation.
        beyond = np.maximum(np.abs(offsets) - self._range, 0.0) / (_EDGE_SHARE * self._range)
        return np.asarray(-0.5 * ((offsets / self._sigmas) ** 2 + beyond**2).sum(axis=1))

    def offsets(self, vectors: Floats) -> Floats:
        """Returns (N, 6) how far poses (N, 6) are from the prior, metres and degrees."""
        offsets = vectors - self._prior
        offsets[:, 5] = [wrap_deg(float(turn)) for turn in offsets[:, 5]]
        return np.asarray(offsets)

    def prior_information(self) -> Floats:
        """Returns (6, 6) the inverse of the prior's covariance."""
        return np.diag(self._sigmas**-2.0)
