"""A pose refined by a photo's own edges: Gauss-Newton on distances of roof lines to parallel edges.

A point of a model's line shows one of the photo's edges nearby, or none. Its edge is unknown: the likelihood
is a mixture over all edges across the line and a uniform background, whose density is measured on the photo
(expectation and maximisation over a narrowing deviation; docs/adr/0011, point 11).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.extrude import pitched_blocks
from lodbench.estimation.model_lines import (
    NUM_POSE_AND_LENS,
    LensErrors,
    ModelLines,
    Projected,
    lines_in_view,
    project_lines,
)
from lodbench.estimation.optimization import Quadratic
from lodbench.estimation.state_vector import NUM_POSE, differences
from lodbench.geometry import Camera
from lodbench.geometry.pose import pose_from_vector
from lodbench.rendering.photo_bins import gradient_forms

Floats = NDArray[np.float64]

# The least mean strength of a photo's gradient, CIE Lab units (0 to 100) per pixel.
_LEAST_MEAN = 0.05
# Distance of samples across a line, pixels: at whole pixels interpolation flattens all samples alike and does
# not move a maximum (at half pixels it moves it by up to a quarter of a pixel).
_STEP_PX = 1.0
# The least strength of an edge, and the largest that counts, in mean strengths around it.
_WEAKEST, _STRONGEST = 0.8, 4.0
# The least fraction of its squared gradient across the line: within 26 degrees of the line's normal.
_PARALLEL = 0.8
# Rows of a picture that OpenCV interpolates in one call.
_MOST_ROWS = 30_000
# The weight of "no edge" of a point: that of an edge of mean strength, two standard deviations off.
_NO_EDGE = float(np.exp(-2.0))


class Candidates(NamedTuple):
    """Edges of the photo that points of lines may show.

    Attributes:
        points: (M,) indices of the points.
        distances: (M,) distances from the point along its normal, pixels.
        strengths: (M,) strengths, in mean strengths of the photo around, at most 4.
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

        Eq. (F5) of docs/methods/flight.md; ``sigma_px`` is the deviation of the photo's edge from the line.
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

        Points of lines, (N, 2), are pixels of the size with centres at +0.5, normals (N, 2) unit.
        """
        steps = int(np.ceil(reach_px / _STEP_PX)) + 1
        offsets = _STEP_PX * np.arange(-steps, steps + 1)
        positions = (pixels[:, None] + offsets[:, None] * normals[:, None] - 0.5).astype(np.float32)
        forms = self._forms_at(positions)
        x, y = normals[:, None, 0], normals[:, None, 1]
        squares = forms[..., 0] * x**2 + 2.0 * forms[..., 1] * x * y + forms[..., 2] * y**2
        is_parallel = squares > _PARALLEL * (forms[..., 0] + forms[..., 2])
        strengths = np.sqrt(np.maximum(squares, 0.0))
        before, here, after = strengths[:, :-2], strengths[:, 1:-1], strengths[:, 2:]
        is_peak = (here >= before) & (here > after) & (here > _WEAKEST) & is_parallel[:, 1:-1]
        points, peaks = np.nonzero(is_peak)
        one, middle, other = (part[points, peaks] for part in (before, here, after))
        # The maximum of the parabola through three samples.
        shift = 0.5 * (one - other) / np.minimum(one - 2.0 * middle + other, -1e-12)
        distances = offsets[peaks + 1] + _STEP_PX * np.clip(shift, -0.5, 0.5)
        return Candidates(points, distances, np.minimum(middle, _STRONGEST))

    def _forms_at(self, positions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns (N, S, 3) the forms at (N, S, 2), pixel centres whole; OpenCV takes no N of 0 or 2^15."""
        forms = np.empty((*positions.shape[:2], 3), dtype=np.float32)
        for first in range(0, len(positions), _MOST_ROWS):
            columns, rows = (
                np.ascontiguousarray(positions[first : first + _MOST_ROWS, :, k]) for k in (0, 1)
            )
            forms[first : first + _MOST_ROWS] = cv2.remap(
                self._forms, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
            )
        return forms


# The distance between points along lines, and the least distance of points from the border, pixels.
_SPACING_PX, _BORDER_PX = 6.0, 3.0
# Standard deviations of an edge about its line, pixels: from an answer's error to that of map and edges.
_SIGMAS_PX = (8.0, 6.0, 4.0, 3.0, 2.0, 1.5, 1.5, 1.5)
# Gauss-Newton steps at each; how far edges are looked for, standard deviations; the least number of points.
_STEPS, _REACH, _FEWEST_POINTS = 2, 3.0, 12
# The probability that a point shows an edge.
_SHOWN = 0.7
# The length of line over which errors of edges and map are correlated, pixels.
_TOGETHER_PX = 120.0
# Some are correlated over more: squared errors of 29 answers are 1.8 times the variance without this factor.
_VARIANCE_INFLATION = 1.7
# The largest number of points: towards the horizon of a dense city lines have tens of thousands.
_MOST_POINTS = 3000
# The distance from lines within which the background is measured, pixels.
_BACKGROUND_PX = 30.0
# Lines below this relative height are left out: bases of walls are hidden (docs/adr/0012, point 6).
_LOWEST_RELATIVE_HEIGHT = 0.2


class EdgeAlignment(NamedTuple):
    """A pose refined by edges.

    Attributes:
        vector: (6,) the pose, metres and degrees.
        covariance: (6, 6) covariance of its error, that by the lens included.
        log_ratio_to_background: log-ratio of its edges to the photo's background, prior included, nats.
        gain: difference of that from the value at the start, nats.
    """

    vector: Floats
    covariance: Floats
    log_ratio_to_background: float
    gain: float


class EdgeLikelihood:
    """The likelihood of the edges of one photo, times a Gaussian prior of pose and lens.

    Blocks whose source states a pitched roof are left out: edges of the block are not those of the roof.

    Args:
        edges: the photo's edges.
        camera: pinhole, of any size.
        city_map: the map whose roof lines are compared.
        prior: (6,) the prior pose, metres and degrees.
        sigmas: (10,) standard deviations of the pose, none 0, and of ``LensErrors``, fixed where 0.
    """

    def __init__(
        self, edges: PhotoEdges, camera: Camera, city_map: CityMap, prior: Floats, sigmas: Floats
    ) -> None:
        self._camera, self._size, self._edges = camera.scaled(*edges.size), np.array(edges.size), edges
        self._map, self._is_flat = city_map, ~pitched_blocks(city_map.scene)
        self._prior = np.append(prior, np.zeros(NUM_POSE_AND_LENS - NUM_POSE))
        self._free = np.flatnonzero(sigmas > 0)
        self._sigmas = sigmas[self._free]
        self._background = self._measured_background()

    def refined(self, vector: Floats) -> EdgeAlignment | None:
        """Returns the pose that edges and priors make most probable near (6,); None where few lines show."""
        start = np.append(vector, np.zeros(NUM_POSE_AND_LENS - NUM_POSE))
        refined, posterior_information = start, np.diag(self._sigmas**-2.0)
        for sigma_px in _SIGMAS_PX:
            lines = self._lines(refined)
            if len(lines) < _FEWEST_POINTS:
                return None
            for _ in range(_STEPS):
                refined, posterior_information = self._step(lines, refined, sigma_px)
        covariance = _VARIANCE_INFLATION * np.linalg.inv(posterior_information)[:NUM_POSE, :NUM_POSE]
        log_ratio = self.log_ratio_to_background(refined)
        gain = log_ratio - self.log_ratio_to_background(start)
        return EdgeAlignment(refined[:NUM_POSE], np.asarray(covariance), log_ratio, gain)

    def log_ratio_to_background(self, vector: Floats) -> float:
        """Returns the log-ratio of edges at a pose and lens, (10,), to background, prior included, nats.

        Eq. (R22) of docs/methods/region.md.
        """
        lines = self._lines(vector)
        prior = -0.5 * float(((self._away(vector) / self._sigmas) ** 2).sum())
        ratios = self._ratios(self._laid(lines, vector), _SIGMAS_PX[-1])[0]
        return prior + float((lines.lengths_px * np.log(1.0 - _SHOWN + ratios)).sum()) / _TOGETHER_PX

    def _step(self, lines: ModelLines, vector: Floats, sigma_px: float) -> tuple[Floats, Floats]:
        """Returns the next (10,), and the posterior's information on those of its numbers that are free.

        Eq. (R23) of docs/methods/region.md.
        """
        laid = self._laid(lines, vector)
        ratios, distances = self._ratios(laid, sigma_px)
        shown = ratios / (ratios + 1.0 - _SHOWN)
        weighed = laid.by_camera * (shown * lines.lengths_px / (_TOGETHER_PX * sigma_px**2))[:, None]
        information = (weighed.T @ laid.by_camera)[np.ix_(self._free, self._free)]
        information += np.diag(self._sigmas**-2.0)
        gradient = self._away(vector) / self._sigmas**2 - (weighed.T @ distances)[self._free]
        posterior = Quadratic(information, gradient)
        stepped = vector.copy()
        stepped[self._free] += posterior.step()
        return stepped, posterior.information

    def _ratios(self, laid: Projected, sigma_px: float) -> tuple[Floats, Floats]:
        """Returns the (N,) ratio of a point's edges to background, r - 0.3, and their (N,) expected distance.

        Eq. (R21) of docs/methods/region.md.
        """
        count, (density, strength) = len(laid.pixels), self._background
        edges = self._edges.across(laid.pixels, laid.normals, _REACH * sigma_px)
        normal = np.exp(-0.5 * (edges.distances / sigma_px) ** 2) / (sigma_px * np.sqrt(2.0 * np.pi))
        likely = _SHOWN / density * normal * edges.strengths / strength
        ratios = np.bincount(edges.points, likely, count)
        means = np.bincount(edges.points, likely * edges.distances, count) / np.maximum(ratios, 1e-12)
        return np.asarray(ratios, dtype=np.float64), means

    def _measured_background(self) -> tuple[float, float]:
        """Returns the number of edges per pixel across lines, and their mean strength, near the prior."""
        lines = self._lines(self._prior)
        laid = self._laid(lines, self._prior)
        edges = self._edges.across(laid.pixels, laid.normals, _BACKGROUND_PX)
        if not len(edges.points):
            return 1.0 / _BACKGROUND_PX, 1.0
        return len(edges.points) / (2.0 * _BACKGROUND_PX * len(lines)), float(edges.strengths.mean())

    def _lines(self, vector: Floats) -> ModelLines:
        """Returns points on roof lines that (10,) shows inside the photo."""
        lines = lines_in_view(self._map, self._camera, pose_from_vector(vector[:NUM_POSE]), _SPACING_PX)
        lines = lines.of((lines.relative_heights > _LOWEST_RELATIVE_HEIGHT) & self._is_flat[lines.buildings])
        pixels = self._laid(lines, vector).pixels
        is_inside = (pixels > _BORDER_PX) & (pixels < self._size - _BORDER_PX)
        lines = lines.of(np.asarray(is_inside.all(axis=1)))
        every = -(-len(lines) // _MOST_POINTS)
        if every < 2:
            return lines
        lines = lines.of(np.arange(len(lines)) % every == 0)
        return replace(lines, lengths_px=every * lines.lengths_px)

    def _laid(self, lines: ModelLines, vector: Floats) -> Projected:
        lens = LensErrors(*(float(v) for v in vector[NUM_POSE:]))
        return project_lines(lines.points, lines.along, self._camera, vector[:NUM_POSE], lens)

    def _away(self, vector: Floats) -> Floats:
        """Returns the differences of the free numbers of (10,) from the prior."""
        return np.asarray(differences(vector, self._prior)[self._free])
