"""What is known of a state vector before the photo: a Gaussian, with ends where a range was declared."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.estimation.state_vector import differences

Floats = NDArray[np.float64]

# How softly a declared range ends, as a share of its half width: x, y, z, pitch, roll and yaw. Softly in what
# is often declared narrower than it is.
_EDGE_SHARES = np.array([1.0, 1.0, 0.1, 0.1, 0.1, 0.5])
# And where it ends for good, in half widths, and how softly there: evidence of pixels that are not
# independent outweighs any softer end, and from far below nearly every photo is parted well by some roof.
_WALLS, _WALL_SHARE = np.array([np.inf, np.inf, 1.3, 5.0, 5.0, 2.5]), 0.02


class Prior:
    """A Gaussian about a state vector of N numbers, with independent errors.

    Args:
        mean: (N,) metres, degrees and what else is estimated.
        sigmas: (N,) standard deviations, none 0.
        half_widths: (6,) of the range of poses that was declared, where its ends count; N is 6 then.
    """

    def __init__(self, mean: Floats, sigmas: Floats, half_widths: Floats | None = None) -> None:
        self.mean, self.sigmas, self._range = mean, sigmas, half_widths

    def offsets(self, vectors: Floats) -> Floats:
        """Returns (..., N) how far vectors are from its mean; yaw within half a turn."""
        return differences(vectors, self.mean)

    @property
    def precision(self) -> Floats:
        """Returns (N,) the inverse of its variances."""
        return np.asarray(self.sigmas**-2.0)

    def information(self) -> Floats:
        """Returns (N, N) the inverse of its covariance."""
        return np.diag(self.precision)

    def log_density(self, vectors: Floats) -> Floats:
        """Returns the (M,) logarithm of its density at vectors (M, N), up to a constant.

        Eq. (R7) of docs/methods/region.md.
        """
        away = self.offsets(vectors)
        squares = (away / self.sigmas) ** 2
        if self._range is not None:
            beyond = np.maximum(np.abs(away) - self._range, 0.0) / (_EDGE_SHARES * self._range)
            through = np.maximum(np.abs(away) - _WALLS * self._range, 0.0) / (_WALL_SHARE * self._range)
            squares = squares + beyond**2 + through**2
        return np.asarray(-0.5 * squares.sum(axis=-1))
