"""A pose refined by a photo's own edges: Gauss-Newton on roof lines that may each lie on any parallel edge.

Each point of a model's line shows an edge of the photo nearby, or none. Which of the edges across it is the
line's is a mixture with a uniform background, whose density is measured on the photo itself (expectation and
maximisation over a narrowing deviation; docs/adr/0011, point 11).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.extrude import pitched_blocks
from lodbench.estimation.lens import LensErrors
from lodbench.estimation.model_lines import CAMERA, ModelLines, Projected, lines_in_view, project_lines
from lodbench.estimation.normal_equations import Quadratic
from lodbench.estimation.photo_edges import PhotoEdges
from lodbench.estimation.state_vector import POSES, differences
from lodbench.geometry import Camera
from lodbench.geometry.pose import pose_from_vector

Floats = NDArray[np.float64]

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
        """Returns the pose that edges and priors make most probable near one; None where few lines show.

        Args:
            vector: (6,) where to begin, within some pixels of the edges.
        """
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
