"""Outlines aligned by least squares: Gauss-Newton on seven numbers under a prior, with a robust kernel.

The cost of a pose is how far the outline of the model's silhouette lies from that of the mask. Points
far off count less and less (Geman and McClure's kernel), so buildings that one of the two misses
pull nowhere. Every building's height may differ from the map's by a common unknown, which is
eliminated point sums by point sums (Schur complement): a map of a lower level of detail has its
roofs at other heights than a photo shows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.estimation.optimization import Quadratic
from lodbench.estimation.outline import OutlinePoints, edges_in_reach, sample_outline
from lodbench.estimation.state_vector import Prior, shortened
from lodbench.geometry import Camera
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.kernels import measure_distances, normal_equations, visible_buildings
from lodbench.kernels.arguments import EdgeArrays
from lodbench.rendering.masks import signed_distance
from lodbench.rendering.projection import view_planes
from lodbench.segmentation import binary_mask
from lodbench.segmentation.masks import mapped_overlap

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Fewer points than this say nothing about six numbers.
_FEWEST_POINTS = 12
# By how much the stairs of a mask's outline are smoothed.
_STAIR_PX = 1.0


@dataclass(frozen=True, slots=True)
class OutlineModel:
    """How outlines of map and mask are compared, and how far a camera may be from its prior.

    Attributes:
        size: Width and height of masks where all other pixels are counted, ``fine_size``.
        sigmas: (7,) standard deviations of the prior: metres, degrees, percent of the lens.
        reach_m: How far from the prior edges of the map are looked at.
        turn_deg: And how far turned.
        spacing_px: Distance between outline points.
        noise_px: Standard deviation of a mask's outline.
        correlation_px: Length of outline that counts as one observation.
        roof_m: Standard deviation of each building's height in the map; 0 trusts the map.
        outline_px: Distance over which the errors of a mask's outline go together.
        roof_part_px: Distance over which a roof's error goes together.
    """

    size: tuple[int, int]
    sigmas: tuple[float, ...]
    reach_m: float
    turn_deg: float
    spacing_px: float
    noise_px: float
    correlation_px: float
    roof_m: float
    outline_px: float
    roof_part_px: float


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """The query at one working size.

    Attributes:
        camera: Pinhole of that size.
        mask: (H, W) the query mask.
        distance: (H, W) float32 signed distance to its outline, pixels, positive inside.
        scale: Pixels of this size per pixel of the fine size.
    """

    camera: Camera
    mask: Mask
    distance: NDArray[np.float32]
    scale: float


# The query at the sizes used so far.
Levels = dict[tuple[int, int], Level]


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """How far N points of a pose's outline lie inside the mask's, in pixels of the fine size.

    Attributes:
        points: The outline, in pixels of the working size.
        distances: (N,) positive inside the mask.
        slopes: (N, 9) their change per unit of ``OutlinePoints.moves``.
        agreement: (N,) 1 where the mask's outline runs as the silhouette's does, 0 across or against it.
        scale: Pixels of the working size per pixel of the fine size.
        iou: Of silhouette and mask.
    """

    points: OutlinePoints
    distances: Floats
    slopes: Floats
    agreement: Floats
    scale: float
    iou: float


class Linearization(NamedTuple):
    """The posterior of a camera's seven numbers by outlines, to second order.

    Attributes:
        posterior: In metres, degrees and percent of the lens; the prior included.
        iou: Of silhouette and mask.
    """

    posterior: Quadratic
    iou: float

    def step(self) -> Floats:
        """Returns (7,) the Gauss-Newton step, no longer than a linearisation is good for.

        Eq. (C4) of docs/methods/contour_alignment.md.
        """
        return shortened(self.posterior.step())


class Aligner:
    """Aligns poses of one query.

    Attributes:
        city_map: What is drawn.
        model: How outlines are compared.
        prior: Of the camera, seven numbers.
        edges: Edges of the city that poses near the prior may show.
    """

    def __init__(
        self, query: Query, city_map: CityMap, model: OutlineModel, levels: Levels | None = None
    ) -> None:
        self.city_map, self._query, self.model = city_map, query, model
        self.prior = Prior(np.append(vector_from_pose(query.prior), 0.0), np.array(model.sigmas))
        self.edges: EdgeArrays = edges_in_reach(
            city_map.scene, query.camera, query.prior, model.reach_m, model.turn_deg
        )
        self._levels: Levels = {} if levels is None else levels

    def over(self, city_map: CityMap) -> Aligner:
        """Returns an aligner of the same mask over another map."""
        return Aligner(self._query, city_map, self.model, self._levels)

    def align(self, vector: Floats, reaches_px: tuple[float, ...], size: tuple[int, int]) -> Floats:
        """Returns (7,) numbers after one Gauss-Newton step per entry of ``reaches_px``."""
        for reach_px in reaches_px:
            here = self.linearize(vector, reach_px, size)
            if here is None:
                return vector
            vector = vector + here.step()
        return vector

    def pixels_per_m(self, nearer_m: float) -> float:
        """Returns fine pixels per metre of the nearest quarter of buildings in view, from so much nearer."""
        camera, prior = self._query.camera.scaled(*self.model.size), self._query.prior
        rotation, center = np.ascontiguousarray(prior.rotation), np.ascontiguousarray(prior.center)
        shown = visible_buildings(self.edges.spheres, rotation, center, view_planes(camera, 0, camera.width))
        away = np.linalg.norm(self.edges.spheres[shown, :3] - center, axis=1)
        if len(away) == 0:
            return 0.0
        return float(camera.fx / max(1.0, np.quantile(away, 0.25) - nearer_m))

    def linearize(self, vector: Floats, reach_px: float, size: tuple[int, int]) -> Linearization | None:
        """Returns what the outlines say at a pose, (7,); None where too little outline is in view.

        Eq. (C2) of docs/methods/contour_alignment.md; the robust kernel's scale is in pixels of the fine
        size.
        """
        here = self.measure(vector, size)
        if here is None:
            return None
        lengths = here.points.lengths * here.agreement / here.scale
        kernel = 1.0 / (1.0 + (here.distances / reach_px) ** 2)
        weights = lengths * kernel**2 / (self.model.correlation_px * self.model.noise_px**2)
        products, gradients = normal_equations(
            here.distances, here.slopes[:, :8], weights, here.points.buildings, len(self.edges.heights)
        )
        likelihood = _without_roofs(products, gradients, self.model.roof_m)
        posterior = likelihood.times_prior(self.prior.precision, self.prior.offsets(vector))
        return Linearization(posterior, here.iou)

    def overlap(self, vector: Floats) -> float:
        """Returns how well the mask shows the map's buildings at (7,) numbers; see ``mapped_overlap``."""
        level = self.level(self.model.size)
        return mapped_overlap(self._silhouette(vector, level)[0], level.mask)

    def _silhouette(self, vector: Floats, level: Level) -> tuple[Mask, Camera]:
        """Returns the silhouette at (7,) numbers, and the pinhole it is drawn with."""
        stretch = 1.0 + 0.01 * vector[6]
        camera = replace(level.camera, fx=level.camera.fx * stretch, fy=level.camera.fy * stretch)
        return self.city_map.render(camera, pose_from_vector(vector)), camera

    def outline(self, vector: Floats, size: tuple[int, int]) -> tuple[OutlinePoints, float]:
        """Returns the outline of the silhouette at (7,) numbers, and the IoU of silhouette and mask."""
        level = self.level(size)
        silhouette, camera = self._silhouette(vector, level)
        union = int(np.count_nonzero(silhouette | level.mask))
        iou = int(np.count_nonzero(silhouette & level.mask)) / union if union else 0.0
        return sample_outline(self.edges, camera, vector, silhouette, self.model.spacing_px), iou

    def measure(self, vector: Floats, size: tuple[int, int]) -> Residuals | None:
        """Returns how far a pose's outline lies from the mask's; None where too little outline is in view.

        Eq. (C1) of docs/methods/contour_alignment.md.
        """
        level = self.level(size)
        points, iou = self.outline(vector, size)
        count = len(points)
        if count < _FEWEST_POINTS:
            return None
        distances, slopes, agreement = np.empty(count), np.empty((count, 9)), np.empty(count)
        measured = distances, slopes, agreement
        measure_distances(points.pixels, points.normals, points.moves, level.distance, *measured)
        distances, slopes = distances / level.scale, slopes / level.scale
        return Residuals(points, distances, slopes, agreement, level.scale, iou)

    def level(self, size: tuple[int, int]) -> Level:
        """Returns the query at a size, width and height in pixels."""
        if size not in self._levels:
            mask = binary_mask(self._query.mask, *size)
            scale = size[0] / self.model.size[0]
            self._levels[size] = Level(self._query.camera.scaled(*size), mask, smooth_distance(mask), scale)
        return self._levels[size]


def smooth_distance(mask: Mask) -> NDArray[np.float32]:
    """Returns the signed distance to a mask's outline, smoothed by a pixel, (H, W) float32 pixels.

    Along a slanted edge the distance to the nearest stair leans to one side for tens of pixels, which moves a
    pose by decimetres.
    """
    stairs = signed_distance(mask, is_exact=True)
    return np.asarray(cv2.GaussianBlur(stairs, (0, 0), _STAIR_PX), dtype=np.float32)


def _without_roofs(products: Floats, gradients: Floats, roof_m: float) -> Quadratic:
    """Returns the likelihood of seven numbers with each building's height eliminated.

    Eq. (C3) of docs/methods/contour_alignment.md; (B, 8, 8) products of slopes, the height last.
    """
    information, gradient = products[:, :7, :7].sum(axis=0), gradients[:, :7].sum(axis=0)
    if roof_m > 0:
        gain = products[:, :7, 7] / (products[:, 7, 7] + roof_m**-2.0)[:, None]
        information = information - (gain[:, :, None] * products[:, None, :7, 7]).sum(axis=0)
        gradient = gradient - (gain * gradients[:, 7:]).sum(axis=0)
    return Quadratic(information, gradient)
