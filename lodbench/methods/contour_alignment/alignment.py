"""Outlines aligned by least squares: Gauss-Newton on seven numbers under a prior, with a robust kernel.

A pose is judged by how far the outline of the model's silhouette lies from that of the mask. Points
far off count less and less (Geman and McClure's kernel), so buildings that one of the two misses
pull nowhere. Every building's height may differ from the map's by a common unknown, which is
eliminated point sums by point sums (Schur complement): a map of a lower level of detail has its
roofs at other heights than a photo shows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.geometry import Camera
from lodbench.geometry.pose_vector import (
    pose_from_vector,
    rotation_derivatives,
    vector_from_pose,
)
from lodbench.kernels.arguments import EdgeArrays
from lodbench.kernels.edges import building_sums, measure_distances
from lodbench.kernels.projection import visible_buildings
from lodbench.methods.contour_alignment.outline import OutlinePoints, edges_in_reach, sample_outline
from lodbench.methods.contour_alignment.params import Params
from lodbench.rendering.projection import view_planes
from lodbench.segmentation import binary_mask
from lodbench.segmentation.mapped_overlap import mapped_overlap

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

# The longest step: a linearisation says little beyond it (metres, degrees and
# percent; x, y, z, pitch, roll, yaw, lens).
_LONGEST_STEP = np.array([6.0, 6.0, 10.0, 2.0, 2.0, 4.0, 2.0])
# Fewer points than this say nothing about six numbers.
_FEWEST_POINTS = 12
# By how much the stairs of a mask's outline are smoothed.
_STAIR_PX = 1.0


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


# The query at the sizes asked for so far.
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


@dataclass(frozen=True, slots=True, eq=False)
class Linearization:
    """What the outlines say about a pose, to second order; the prior included.

    Attributes:
        information: (7, 7) of metres, degrees and percent of the lens.
        gradient: (7,) of the cost.
        iou: Of silhouette and mask.
    """

    information: Floats
    gradient: Floats
    iou: float

    def step(self) -> Floats:
        """Returns (7,) the Gauss-Newton step, no longer than a linearisation is good for.

        Eq. (C4) of docs/methods/contour_alignment.md.
        """
        return shortened(np.asarray(-np.linalg.solve(self.information, self.gradient)))


def shortened(step: Floats) -> Floats:
    """Returns a step of the camera's numbers, (7,), no longer than a linearisation is good for."""
    return np.asarray(step * (1.0 / max(1.0, float(np.max(np.abs(step) / _LONGEST_STEP)))))


class Aligner:
    """Aligns poses of one query.

    Attributes:
        city_map: What is drawn.
        edges: Edges of the city that poses near the prior may show.
    """

    def __init__(self, query: Query, city_map: CityMap, params: Params, levels: Levels | None = None) -> None:
        self.city_map, self._query, self._params = city_map, query, params
        self._prior = np.append(vector_from_pose(query.prior), 0.0)
        self._precision = np.array(params.start_sigmas()) ** -2.0
        # Full widths, where half would do: steps may lead out of the range, though the prior calls back.
        reach_m = math.hypot(params.range_x_m, params.range_y_m, params.range_z_m)
        turn_deg = params.range_yaw_deg + 2.0 * params.range_tilt_deg
        self.edges: EdgeArrays = edges_in_reach(city_map.scene, query.camera, query.prior, reach_m, turn_deg)
        self._levels: Levels = {} if levels is None else levels

    def over(self, city_map: CityMap) -> Aligner:
        """Returns an aligner of the same mask over another map."""
        return Aligner(self._query, city_map, self._params, self._levels)

    def align(self, vector: Floats, reaches_px: tuple[float, ...], size: tuple[int, int]) -> Floats:
        """Returns (7,) numbers after one Gauss-Newton step per entry of ``reaches_px``."""
        for reach_px in reaches_px:
            here = self.linearize(vector, reach_px, size)
            if here is None:
                return vector
            vector = vector + here.step()
        return vector

    def pixels_per_m(self) -> float:
        """Returns the scale of the nearest quarter of the buildings in view, fine pixels per metre.

        It is that of a camera as much nearer than the prior as its height may be off.
        """
        camera, prior = self._query.camera.scaled(*self._params.fine_size), self._query.prior
        rotation, center = np.ascontiguousarray(prior.rotation), np.ascontiguousarray(prior.center)
        shown = visible_buildings(self.edges.spheres, rotation, center, view_planes(camera, 0, camera.width))
        away = np.linalg.norm(self.edges.spheres[shown, :3] - center, axis=1)
        if len(away) == 0:
            return 0.0
        return float(camera.fx / max(1.0, np.quantile(away, 0.25) - 0.5 * self._params.range_z_m))

    def linearize(self, vector: Floats, reach_px: float, size: tuple[int, int]) -> Linearization | None:
        """Returns what the outlines say at a pose; None if too little outline is seen.

        Eq. (C2) of docs/methods/contour_alignment.md.

        Args:
            vector: (7,) centre in metres, angles in degrees, and by how many percent the lens is longer.
            reach_px: Scale of the robust kernel, pixels of the fine size.
            size: Width and height of the silhouette, pixels.
        """
        here = self.measure(vector, size)
        if here is None:
            return None
        lengths = here.points.lengths * here.agreement / here.scale
        kernel = 1.0 / (1.0 + (here.distances / reach_px) ** 2)
        weights = lengths * kernel**2 / (self._params.correlation_px * self._params.noise_px**2)
        products, gradients = building_sums(
            here.distances, here.slopes[:, :8], weights, here.points.buildings, len(self.edges.rises)
        )
        information, gradient = _without_roofs(products, gradients, self._params.roof_m)
        prior_information, prior_gradient = self.prior_terms(vector)
        return Linearization(information + prior_information, gradient + prior_gradient, here.iou)

    def overlap(self, vector: Floats) -> float:
        """Returns how well the mask shows the map's buildings at (7,) numbers; see ``mapped_overlap``."""
        level = self.level(self._params.fine_size)
        return mapped_overlap(self._silhouette(vector, level)[0], level.mask)

    def _silhouette(self, vector: Floats, level: Level) -> tuple[Mask, Camera]:
        """Returns the silhouette at (7,) numbers, and the pinhole it is seen through."""
        stretch = 1.0 + 0.01 * vector[6]
        camera = replace(level.camera, fx=level.camera.fx * stretch, fy=level.camera.fy * stretch)
        return self.city_map.render(camera, pose_from_vector(vector)), camera

    def outline(self, vector: Floats, size: tuple[int, int]) -> tuple[OutlinePoints, float]:
        """Returns the outline of the silhouette at (7,) numbers, and the IoU of silhouette and mask."""
        level, pose = self.level(size), pose_from_vector(vector)
        silhouette, camera = self._silhouette(vector, level)
        union = int(np.count_nonzero(silhouette | level.mask))
        iou = int(np.count_nonzero(silhouette & level.mask)) / union if union else 0.0
        derivatives, spacing = rotation_derivatives(vector), self._params.spacing_px
        return sample_outline(self.edges, camera, pose, derivatives, silhouette, spacing), iou

    def measure(self, vector: Floats, size: tuple[int, int]) -> Residuals | None:
        """Returns how far a pose's outline lies from the mask's; None if too little outline is seen.

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

    def prior_terms(self, vector: Floats) -> tuple[Floats, Floats]:
        """Returns the prior's information (7, 7) and gradient (7,)."""
        return np.diag(self._precision), self._precision * self.offset(vector)

    def offset(self, vector: Floats) -> Floats:
        """Returns (7,) how far from the prior."""
        offset = np.asarray(vector - self._prior)
        offset[5] = (offset[5] + 180.0) % 360.0 - 180.0
        return offset

    def level(self, size: tuple[int, int]) -> Level:
        """Returns the query at a size, width and height in pixels."""
        if size not in self._levels:
            mask = binary_mask(self._query.mask, *size)
            scale = size[0] / self._params.fine_size[0]
            self._levels[size] = Level(self._query.camera.scaled(*size), mask, signed_distance(mask), scale)
        return self._levels[size]


def signed_distance(mask: Mask) -> NDArray[np.float32]:
    """Returns the distance of pixel centres to a mask's outline, (H, W) float32 pixels, positive inside.

    The outline runs halfway between two pixel centres, and is smoothed by a pixel: along a slanted edge the
    distance to the nearest stair leans to one side for tens of pixels, which moves a pose by decimetres.
    A mask with one value everywhere has no outline: all its distances are as far as the image is wide and
    high.
    """
    if mask.all() or not mask.any():
        return np.full(mask.shape, (1.0 if mask.any() else -1.0) * sum(mask.shape), dtype=np.float32)
    stairs = np.asarray(_distance(mask) - _distance(~mask) + np.where(mask, -0.5, 0.5), dtype=np.float32)
    return np.asarray(cv2.GaussianBlur(stairs, (0, 0), _STAIR_PX), dtype=np.float32)


def _distance(mask: Mask) -> NDArray[np.float32]:
    """Returns the distance of a mask's pixel centres to the nearest one outside, (H, W) pixels."""
    found = cv2.distanceTransform(mask.view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # OpenCV's last digit depends on how many threads it has. Squares of distances are whole numbers.
    return np.asarray(np.sqrt(np.rint(found.astype(np.float64) ** 2)), dtype=np.float32)


def _without_roofs(products: Floats, gradients: Floats, roof_m: float) -> tuple[Floats, Floats]:
    """Returns information (7, 7) and gradient (7,) with each building's height eliminated.

    Eq. (C3) of docs/methods/contour_alignment.md.

    Args:
        products: (B, 8, 8) weighted products of slopes by building; the height comes last.
        gradients: (B, 8) of slopes and residuals.
        roof_m: Standard deviation of a building's height, metres; 0 where the map is exact.
    """
    information, gradient = products[:, :7, :7].sum(axis=0), gradients[:, :7].sum(axis=0)
    if roof_m > 0:
        gain = products[:, :7, 7] / (products[:, 7, 7] + roof_m**-2.0)[:, None]
        information = information - (gain[:, :, None] * products[:, None, :7, 7]).sum(axis=0)
        gradient = gradient - (gain * gradients[:, 7:]).sum(axis=0)
    return information, gradient
