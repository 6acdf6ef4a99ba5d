"""A fit without a mask: how much better two histograms describe a photo than one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.errors import RenderingError
from lodbench.kernels.masks import code_lengths_saved, outline_sides
from lodbench.rendering.bits import Words, words_per_row

Floats = NDArray[np.float64]


class RegionFit:
    """Code length saved by describing the pixels inside and outside a silhouette apart, nats per pixel.

    With ``L(n) = -log of the marginal likelihood of counts n`` under a Dirichlet prior of one half per bin
    (Krichevsky and Trofimov 1981), the fit is ``(L(in + out) - L(in) - L(out)) / pixels``, and 0 where two
    histograms describe the photo no better than one: an empty silhouette, or one that has nothing to do
    with what the photo shows. It is at most the entropy of inside against outside, log 2.

    Args:
        bins: (H, W) what each pixel looks like, as of ``appearance_bins``: 0 .. num_bins - 1.
        num_bins: How many bins there are, up to 65536.

    Raises:
        RenderingError: A bin is out of range, or there are no pixels.
    """

    def __init__(self, bins: NDArray[np.integer], num_bins: int) -> None:
        if bins.ndim != 2 or bins.size == 0:
            raise RenderingError(f"A query to fit has shape {bins.shape}, not (height, width).")
        if not 0 < num_bins <= 1 << 16 or bins.min() < 0 or bins.max() >= num_bins:
            raise RenderingError(f"The bins of a photo lie in 0 .. {num_bins - 1}, and are at most 65536.")
        # Half a second of a command's start, and most never fit regions.
        from scipy.special import gammaln

        height, width = bins.shape
        self.size = width, height
        padded = np.zeros((height, 64 * words_per_row(width)), dtype=np.uint16)
        padded[:, :width] = bins
        self._bins = padded.ravel()
        self._totals = np.bincount(bins.ravel(), minlength=num_bins).astype(np.int64)
        counts = np.arange(bins.size + 1, dtype=np.float64)
        half, sides = 0.5, 0.5 * num_bins
        self._log_gamma = np.stack(
            [gammaln(counts + half) - gammaln(half), gammaln(counts + sides) - gammaln(sides)]
        )

    def __call__(self, words: Words) -> Floats:
        """Returns the (N,) fit of N silhouettes. Eqs. (R2), (R3) of docs/methods/region.md."""
        saved, flat = np.empty(len(words)), words.reshape(len(words), -1)
        blank = np.zeros_like(self._totals), np.zeros(flat.shape[1], dtype=np.uint64)
        code_lengths_saved(flat, self._bins, self._totals, self._log_gamma, *blank, saved)
        return np.asarray(np.maximum(saved, 0.0) / (self.size[0] * self.size[1]))


class ContourFit:
    """Code length saved by describing the photo's edges along a silhouette's outline apart, nats per pixel.

    Where the outline is upright, changes of the photo from left to right are looked at, else those from top
    to bottom: two ``RegionFit`` of outlines, added.

    Args:
        beside: (H, W) how strongly the photo changes from left to right, in ``num_bins`` levels.
        upright: (H, W) the same from top to bottom.
        num_bins: How many levels there are.

    Raises:
        RenderingError: As for ``RegionFit``.
    """

    def __init__(self, beside: NDArray[np.integer], upright: NDArray[np.integer], num_bins: int) -> None:
        self._beside, self._upright = RegionFit(beside, num_bins), RegionFit(upright, num_bins)
        self.size = self._beside.size

    def __call__(self, words: Words) -> Floats:
        """Returns the (N,) fit of N silhouettes. Eq. (R4) of docs/methods/region.md."""
        beside, upright = np.empty_like(words), np.empty_like(words)
        outline_sides(words, self.size[0], beside, upright)
        return np.asarray(self._beside(beside) + self._upright(upright))
