"""Edges of a photo along lines of a model: where across each point of a line the photo changes most.

Nothing here depends on where a search began: the photo is looked at across the line to either side, and all
edges that run parallel to it are candidates (as in the moving-edges tracker of Bouthemy, 1989, with several
hypotheses for each point: Vacchetti, Lepetit and Fua, 2004).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.rendering.photo_bins import gradient_forms

Floats = NDArray[np.float64]

# The least mean strength of a photo's changes, of CIE Lab's 0 to 100.
_LEAST_MEAN = 0.05
# Distance of samples across a line, pixels: between pixels interpolation flattens an edge by as much at each,
# which moves no top (half of that moves it by up to a quarter of a pixel).
_STEP_PX = 1.0
# An edge is stronger than this, mean strengths around it, and no stronger one counts for more; most of its
# change goes across the line: within 26 degrees of it.
_WEAKEST, _STRONGEST, _PARALLEL = 0.8, 4.0, 0.8
# Rows of a picture that OpenCV interpolates in one call.
_MOST_ROWS = 30_000
# What a point of a line weighs that shows no edge: an edge of middling strength two deviations off.
_NO_EDGE = float(np.exp(-2.0))


class Candidates(NamedTuple):
    """Edges of the photo that points of lines may show.

    Attributes:
        points: (M,) numbers of the points.
        distances: (M,) from the point along its normal, pixels.
        strengths: (M,) mean strengths of the photo around, at most 4.
    """

    points: NDArray[np.int64]
    distances: Floats
    strengths: Floats

    def nearest(self, count: int) -> Floats:
        """Returns (count,) the distance of the nearest candidate of each point, pixels; inf without one."""
        found = np.full(count, np.inf)
        np.minimum.at(found, self.points, np.abs(self.distances))
        return found

    def expected(self, count: int, sigma_px: float) -> tuple[Floats, Floats]:
        """Returns (count,) expected distances, and (count,) probabilities that there is an edge.

        Eq. (F5) of docs/methods/flight.md.

        Args:
            count: Of points.
            sigma_px: Standard deviation of how far the photo's edge is from the line.
        """
        likely = self.strengths * np.exp(-0.5 * (self.distances / sigma_px) ** 2)
        sums = np.bincount(self.points, likely, count)
        means = np.bincount(self.points, likely * self.distances, count) / np.maximum(sums, 1e-12)
        return means, sums / (sums + _NO_EDGE)


class PhotoEdges:
    """How strongly a photo changes along any direction at any place of it.

    Args:
        photo: (H, W) or (H, W, 3) BGR, 8 bits.
        size: Width and height to work at, pixels.
        blur_px: Standard deviation of the blur before, pixels of that size.

    Attributes:
        size: As given.
    """

    def __init__(self, photo: NDArray[Any], size: tuple[int, int], blur_px: float = 1.0) -> None:
        self.size = size
        self._forms = gradient_forms(photo, size, blur_px, _LEAST_MEAN)

    def across(self, pixels: Floats, normals: Floats, reach_px: float) -> Candidates:
        """Returns the edges across lines, to a fraction of a pixel.

        Args:
            pixels: (N, 2) points of lines, pixels of the size; pixel centres at +0.5.
            normals: (N, 2) unit, across the lines.
            reach_px: How far to look to either side.
        """
        steps = int(np.ceil(reach_px / _STEP_PX)) + 1
        offsets = _STEP_PX * np.arange(-steps, steps + 1)
        places = (pixels[:, None] + offsets[:, None] * normals[:, None] - 0.5).astype(np.float32)
        forms = self._forms_at(places)
        x, y = normals[:, None, 0], normals[:, None, 1]
        squares = forms[..., 0] * x**2 + 2.0 * forms[..., 1] * x * y + forms[..., 2] * y**2
        is_parallel = squares > _PARALLEL * (forms[..., 0] + forms[..., 2])
        strengths = np.sqrt(np.maximum(squares, 0.0))
        before, here, after = strengths[:, :-2], strengths[:, 1:-1], strengths[:, 2:]
        is_peak = (here >= before) & (here > after) & (here > _WEAKEST) & is_parallel[:, 1:-1]
        points, peaks = np.nonzero(is_peak)
        one, middle, other = (part[points, peaks] for part in (before, here, after))
        # The top of the parabola through three samples.
        shift = 0.5 * (one - other) / np.minimum(one - 2.0 * middle + other, -1e-12)
        distances = offsets[peaks + 1] + _STEP_PX * np.clip(shift, -0.5, 0.5)
        return Candidates(points, distances, np.minimum(middle, _STRONGEST))

    def _forms_at(self, places: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns (N, S, 3) the forms at (N, S, 2), pixel centres whole; OpenCV takes no N of 0 or 2^15."""
        forms = np.empty((*places.shape[:2], 3), dtype=np.float32)
        for first in range(0, len(places), _MOST_ROWS):
            columns, rows = (np.ascontiguousarray(places[first : first + _MOST_ROWS, :, k]) for k in (0, 1))
            forms[first : first + _MOST_ROWS] = cv2.remap(
                self._forms, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
            )
        return forms
