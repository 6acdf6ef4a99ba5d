"""Fits: similarities of silhouettes to a query, the numbers that hypotheses are ranked by.

To add one, write a class with a ``size`` and a ``__call__`` as in ``Fit``: made once from what the query
shows, called with many silhouettes as bit-packed words. Count in integers, so that ties are ties and no
result depends on the order of a sum; keep the work in numba, ``nogil``, because renderers call it from
several threads. Any ``Scorer.fit`` then takes it. For ``method.fit=NAME`` make it an entry point under
``lodbench.fits`` (docs/plugins.md), and test it against plain numpy as in ``tests/rendering/test_fit.py``.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lodbench import kernels
from lodbench.citymodel.scene import ROOF, WALL
from lodbench.errors import RenderingError
from lodbench.rendering.masks import Words, pack_mask, words_per_row

Floats = NDArray[np.float64]

# Probabilities and weights are counted in steps of 2**-16: finer than any network's output means, and
# the sum over 8192 x 8192 pixels stays far below 2**53.
_ONE = 1 << 16
_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)


class Fit(Protocol):
    """The similarity of silhouettes to one query: in [0, 1], higher is better, 0 for nothing in common.

    Attributes:
        size: Width and height of the silhouettes it compares, pixels.
    """

    size: tuple[int, int]

    def __call__(self, words: Words) -> Floats:
        """Returns the (N,) float64 similarity of N silhouettes, (N, H, ceil(W / 64)) words of ``pack_mask``.

        The words are only read, and only during the call.
        """
        ...


def fit_values(fit: Fit, words: Words) -> Floats:
    """Returns what a fit, of another package perhaps, says of N silhouettes.

    Raises:
        TypeError: It is not a number for each.
    """
    values = np.asarray(fit(words))
    if values.shape != (len(words),) or values.dtype.kind not in "biuf":
        name = type(fit).__name__
        raise TypeError(f"{name} gave {values.dtype} {values.shape} for {len(words)} silhouettes")
    return values


class IouFit:
    """Intersection over union with a mask (LoD-Loc v2, equation 2); an empty union scores 0.

    Args:
        mask: (H, W) query silhouette.
    """

    def __init__(self, mask: NDArray[np.bool_]) -> None:
        self.mask = mask
        self.size = _size_of(mask)
        self._words = pack_mask(mask)

    def __call__(self, words: Words) -> Floats:
        """Returns the (N,) IoU of N silhouettes. Eq. (L3) of docs/methods/lodlocv2.md."""
        shared, area = kernels.count_overlaps(words, self._words)
        return _ratio(shared, area + kernels.count_bits(self._words) - shared)


class SoftIouFit:
    """Intersection over union with probabilities, pixels weighted: ``sum w min(p, s) / sum w max(p, s)``.

    ``s`` is the silhouette, 1 where a building is drawn. With p of 0 and 1 and no weights it is the IoU;
    in general the weighted Jaccard or Ruzicka similarity. p and w count in steps of 2**-16.

    Args:
        probability: (H, W) probability of building in [0, 1].
        weights: (H, W) how much each pixel matters, finite and >= 0, or None for alike.

    Raises:
        RenderingError: A value is out of its range, or the shapes differ.
    """

    def __init__(
        self, probability: NDArray[np.floating], weights: NDArray[np.floating] | None = None
    ) -> None:
        p = np.asarray(probability, dtype=np.float64)
        w = np.ones_like(p) if weights is None else np.asarray(weights, dtype=np.float64)
        self.size = _size_of(p)
        if not (p >= 0).all() or not (p <= 1).all():
            raise RenderingError("The probabilities of a soft mask lie in [0, 1].")
        if w.shape != p.shape or not np.isfinite(w).all() or not (w >= 0).all() or not w.any():
            raise RenderingError(
                f"The weights of a soft mask of shape {p.shape} have shape {w.shape}; they are finite, >= 0 "
                "and not all 0."
            )
        weight = np.rint(w * (_ONE / w.max())).astype(np.int64)
        inside = np.rint(weight * p).astype(np.int64)
        self._outside_total = int(inside.sum())
        self._inside = _row_sums(inside)
        self._weight = _row_sums(weight)

    def __call__(self, words: Words) -> Floats:
        """Returns the (N,) weighted soft IoU of N silhouettes. Eq. (L8) of docs/methods/lodlocv2.md."""
        shared = kernels.sum_under(words, self._inside)
        return _ratio(shared, kernels.sum_under(words, self._weight) + self._outside_total - shared)


class BoundaryFit:
    """Symmetric chamfer matching of outlines: 1 if they are the same, 0 if all are ``reach_px`` apart.

    The outline is the set pixels with an unset one beside, above or below them; the image's border is
    none. Each outline's mean distance to the other, distances cut off at ``reach_px``, is taken; the fit is
    ``1 - (a + b) / (2 reach_px)``, and 0 without an outline in either. Distances are octagonal (steps to
    4 and to 8 neighbours in turn; Rosenfeld and Pfaltz 1968), within 12 % of Euclidean at length: a
    distance of r is r dilations of bit-packed rows.

    Args:
        mask: (H, W) query silhouette.
        reach_px: Where distances are cut off, whole pixels; cost grows with it.

    Raises:
        RenderingError: ``reach_px`` is less than 1.
    """

    def __init__(self, mask: NDArray[np.bool_], reach_px: int = 16) -> None:
        if reach_px < 1:
            raise RenderingError(f"reach_px={reach_px}: outlines are compared within 1 pixel or more.")
        self.size = _size_of(mask)
        self.reach_px = reach_px
        self._valid = _valid_bits(*self.size)
        self._outline = np.zeros_like(self._valid)
        kernels.outline_of(_pad_words(pack_mask(mask), self._valid), self._valid, self.size[0], self._outline)
        self._grown = _dilations(self._outline, self._valid, self.size[0], reach_px)

    def __call__(self, words: Words) -> Floats:
        """Returns the (N,) fit of N silhouettes' outlines. Eq. (L9) of docs/methods/lodlocv2.md."""
        length = kernels.count_bits(self._outline)
        to_query, from_query, lengths = kernels.distance_sums(
            words, self._outline, self._grown, self._valid, self.size[0]
        )
        has_both = (lengths > 0) & (length > 0)
        mean = to_query / np.maximum(lengths, 1) + from_query / max(length, 1)
        return np.where(has_both, 1.0 - mean / (2.0 * self.reach_px), 0.0)


class SemanticIouFit:
    """Mean over roofs and walls of the IoU of what is visible of each; one that the query lacks is left out.

    It compares class maps, not silhouettes: ``CityMap.fit`` draws them for it.

    Args:
        classes: (H, W) query, of ``ROOF``, ``WALL`` and 0.
    """

    # What ``lodbench.methods.fits`` makes it from.
    input = "classes"

    def __init__(self, classes: NDArray[np.uint8]) -> None:
        self.size = _size_of(classes)
        self._query = {k: classes == k for k in (ROOF, WALL) if (classes == k).any()}

    def __call__(self, classes: NDArray[np.uint8]) -> Floats:
        """Returns the (N,) mean IoU of N (H, W) class maps. Eq. (L10) of docs/methods/lodlocv2.md."""
        ious = np.zeros((len(classes), max(len(self._query), 1)))
        for column, (k, wanted) in enumerate(self._query.items()):
            area = np.count_nonzero(wanted)
            # One by one: counting along axes takes ten times as long.
            for row, drawn in enumerate(classes == k):
                shared = np.count_nonzero(drawn & wanted)
                ious[row, column] = shared / (area + np.count_nonzero(drawn) - shared)
        return np.asarray(ious.mean(axis=1))


def _size_of(picture: NDArray[np.generic]) -> tuple[int, int]:
    if picture.ndim != 2 or picture.size == 0:
        raise RenderingError(f"A query to fit has shape {picture.shape}, not (height, width).")
    return picture.shape[1], picture.shape[0]


def _ratio(shared: NDArray[np.int64], union: NDArray[np.int64]) -> Floats:
    return np.where(union > 0, shared / np.maximum(union, 1), 0.0)


def _row_sums(values: NDArray[np.int64]) -> NDArray[np.int32]:
    """Returns (H, W + 1) sums of each row's first 0 .. W values; at most 8192 * 2**16 = 2**29."""
    sums = np.zeros((values.shape[0], values.shape[1] + 1), dtype=np.int32)
    np.cumsum(values, axis=1, out=sums[:, 1:])
    return sums


def _valid_bits(width: int, height: int) -> Words:
    """Returns the padded words of a picture that is all set."""
    stride = kernels.padded_stride(width)
    rows = np.zeros((height + 2, stride), dtype=np.uint64)
    rows[1:-1, :-1] = _ALL
    if width % 64:
        rows[1:-1, -2] = np.uint64((1 << (width % 64)) - 1)
    return np.concatenate([np.zeros(1, dtype=np.uint64), rows.ravel(), np.zeros(1, dtype=np.uint64)])


def _pad_words(words: Words, valid: Words) -> Words:
    """Returns the padded words of a (H, S) picture."""
    padded = np.zeros_like(valid)
    kernels.fill_padded(words, padded)
    return padded


def _dilations(outline: Words, valid: Words, width: int, reach: int) -> NDArray[np.uint64]:
    """Returns (reach, F) pixels within 0, 1, .. reach - 1 steps of an outline, padded words."""
    dilated = np.zeros((reach, len(valid)), dtype=np.uint64)
    dilated[0] = outline
    scratch = np.zeros_like(valid)
    for r in range(1, reach):
        kernels.dilate(dilated[r - 1], valid, width, r % 2 == 0, scratch, dilated[r])
    return dilated


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
        kernels.code_lengths_saved(flat, self._bins, self._totals, self._log_gamma, *blank, saved)
        return np.asarray(np.maximum(saved, 0.0) / (self.size[0] * self.size[1]))


class ContourFit:
    """Code length saved by describing the photo's edges along a silhouette's outline apart, nats per pixel.

    Two ``RegionFit`` are added: of the horizontal gradient where the outline is vertical, and of the vertical
    gradient where it is level.

    Args:
        horizontal_gradient: (H, W) change of the photo from left to right, in ``num_bins`` levels.
        vertical_gradient: (H, W) its change from top to bottom.
        num_bins: number of levels.

    Raises:
        RenderingError: As for ``RegionFit``.
    """

    def __init__(
        self,
        horizontal_gradient: NDArray[np.integer],
        vertical_gradient: NDArray[np.integer],
        num_bins: int,
    ) -> None:
        self._horizontal = RegionFit(horizontal_gradient, num_bins)
        self._vertical = RegionFit(vertical_gradient, num_bins)
        self.size = self._horizontal.size

    def __call__(self, words: Words) -> Floats:
        """Returns the (N,) fit of N silhouettes. Eq. (R4) of docs/methods/region.md."""
        vertical_outline, level_outline = np.empty_like(words), np.empty_like(words)
        kernels.outline_directions(words, self.size[0], vertical_outline, level_outline)
        return np.asarray(self._horizontal(vertical_outline) + self._vertical(level_outline))
