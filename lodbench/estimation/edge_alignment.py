"""A pose refined by a photo's own edges: Gauss-Newton on roof lines that may each lie on any parallel edge.

Each point of a model's line shows an edge of the photo nearby, or none. Which of the edges across it is the
line's is a mixture with a uniform background, whose density is measured on the photo itself (expectation and
maximisation over a narrowing deviation; docs/adr/0011, point 11).
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
    CAMERA,
    LensErrors,
    ModelLines,
    Projected,
    lines_in_view,
    project_lines,
)
from lodbench.estimation.optimization import Quadratic
from lodbench.estimation.state_vector import POSES, differences
from lodbench.geometry import Camera
from lodbench.geometry.pose import pose_from_vector
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


# Points of lines are so far apart; none is taken so near the border, pixels.
_SPACING_PX, _BORDER_PX = 6.0, 3.0
# Standard deviations of an edge about its line, pixels: from an answer's error to that of map and edges.
_SIGMAS_PX = (8.0, 6.0, 4.0, 3.0, 2.0, 1.5, 1.5, 1.5)
_STEPS, _REACH, _FEWEST_POINTS = 2, 3.0, 12
# How many points of lines show an edge; over which length their errors, the map's among them, go together.
_SHOWN, _TOGETHER_PX = 0.7, 120.0
# Maps and edges err together over more than that: squared errors of 29 answers are 1.8 times what is left.
_SPREAD = 1.7
# In a dense city not all points are compared: towards the horizon lines have tens of thousands.
_MOST_POINTS = 3000
# How far beside lines the background is measured, pixels.
_BESIDE_PX = 30.0
# Bases of walls are no evidence (docs/adr/0012, point 6).
_LOWEST_RISE = 0.2


class EdgeAlignment(NamedTuple):
    """A pose refined by edges.

    Attributes:
        vector: (6,) metres and degrees.
        covariance: (6, 6) of its error, what the lens leaves open included.
        evidence: Nats by which edges and prior are likelier than the photo's background.
        gain: Nats by which they are likelier than where it began.
    """

    vector: Floats
    covariance: Floats
    evidence: float
    gain: float


class EdgeLikelihood:
    """The likelihood of the edges of one photo, beside priors of pose and lens.

    Blocks of pitched roofs are left out: their drawn edges are not where roofs end.

    Args:
        edges: The photo's.
        camera: Pinhole, of any size.
        city_map: Whose roof lines are compared.
        prior: (6,) metres and degrees.
        sigmas: (10,) standard deviations of the prior, none 0, and of ``LensErrors``, held where 0.
    """

    def __init__(
        self, edges: PhotoEdges, camera: Camera, city_map: CityMap, prior: Floats, sigmas: Floats
    ) -> None:
        self._camera, self._size, self._edges = camera.scaled(*edges.size), np.array(edges.size), edges
        self._map, self._is_flat = city_map, ~pitched_blocks(city_map.scene)
        self._prior, self._free = np.append(prior, np.zeros(CAMERA - POSES)), np.flatnonzero(sigmas > 0)
        self._sigmas = sigmas[self._free]
        self._background = self._measured_background()

    def refined(self, vector: Floats) -> EdgeAlignment | None:
        """Returns the pose that edges and priors make most probable near (6,); None where few lines show."""
        start = np.append(vector, np.zeros(CAMERA - POSES))
        refined, information = start, np.diag(self._sigmas**-2.0)
        for sigma_px in _SIGMAS_PX:
            lines = self._lines(refined)
            if len(lines) < _FEWEST_POINTS:
                return None
            for _ in range(_STEPS):
                refined, information = self._step(lines, refined, sigma_px)
        covariance = np.asarray(_SPREAD * np.linalg.inv(information)[:POSES, :POSES])
        evidence = self.log_posterior(refined)
        return EdgeAlignment(refined[:POSES], covariance, evidence, evidence - self.log_posterior(start))

    def log_posterior(self, vector: Floats) -> float:
        """Returns how much likelier the lines of a pose and lens, (10,), are than background; with priors.

        Eq. (R22) of docs/methods/region.md.
        """
        lines = self._lines(vector)
        prior = -0.5 * float(((self._away(vector) / self._sigmas) ** 2).sum())
        ratios = self._ratios(self._laid(lines, vector), _SIGMAS_PX[-1])[0]
        return prior + float((lines.lengths_px * np.log(1.0 - _SHOWN + ratios)).sum()) / _TOGETHER_PX

    def _step(self, lines: ModelLines, vector: Floats, sigma_px: float) -> tuple[Floats, Floats]:
        """Returns the next (10,), and the information on what is free of it.

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
        """Returns (N,) how much likelier an edge of the line is than background, and its (N,) distance.

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
        """Returns how many edges a pixel across lines shows, and their mean strength, about the prior."""
        lines = self._lines(self._prior)
        laid = self._laid(lines, self._prior)
        edges = self._edges.across(laid.pixels, laid.normals, _BESIDE_PX)
        if not len(edges.points):
            return 1.0 / _BESIDE_PX, 1.0
        return len(edges.points) / (2.0 * _BESIDE_PX * len(lines)), float(edges.strengths.mean())

    def _lines(self, vector: Floats) -> ModelLines:
        """Returns points on roof lines that (10,) shows inside the photo."""
        lines = lines_in_view(self._map, self._camera, pose_from_vector(vector[:POSES]), _SPACING_PX)
        lines = lines.of((lines.rises > _LOWEST_RISE) & self._is_flat[lines.buildings])
        pixels = self._laid(lines, vector).pixels
        is_inside = (pixels > _BORDER_PX) & (pixels < self._size - _BORDER_PX)
        lines = lines.of(np.asarray(is_inside.all(axis=1)))
        every = -(-len(lines) // _MOST_POINTS)
        if every < 2:
            return lines
        lines = lines.of(np.arange(len(lines)) % every == 0)
        return replace(lines, lengths_px=every * lines.lengths_px)

    def _laid(self, lines: ModelLines, vector: Floats) -> Projected:
        lens = LensErrors(*(float(v) for v in vector[POSES:]))
        return project_lines(lines.points, lines.along, self._camera, vector[:POSES], lens)

    def _away(self, vector: Floats) -> Floats:
        """Returns how far the free ones of (10,) are from the priors."""
        return np.asarray(differences(vector, self._prior)[self._free])
