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

from lodbench import kernels
from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene, floors_and_rises
from lodbench.datasets.query import Query
from lodbench.estimation.optimization import Quadratic
from lodbench.estimation.state_vector import Prior, shortened
from lodbench.geometry import Camera, Pose
from lodbench.geometry.pose import pose_from_vector, rotation_derivatives, vector_from_pose
from lodbench.kernels.arguments import EdgeArrays
from lodbench.rendering.edges import edge_table
from lodbench.rendering.masks import signed_distance
from lodbench.rendering.projection import bounding_spheres, view_planes
from lodbench.segmentation import binary_mask
from lodbench.segmentation.masks import mapped_overlap

Floats = NDArray[np.float64]

# Columns of an outline's derivatives after the pose and the focal length: roof and base of a point's own
# building. State vectors have the offsets of all buildings there.
OWN_ROOF, OWN_BASE = 7, 8
# Number of points that fit at first; a view with more is sampled again with room for all.
_ROOM = 1 << 14


@dataclass(frozen=True, slots=True, eq=False)
class OutlinePoints:
    """N points spread evenly along the outline of a silhouette."""

    pixels: Floats  # (N, 2) their pixels
    normals: Floats  # (N, 2) unit normals, pointing out of the silhouette
    lengths: Floats  # (N,) length of outline that each stands for, pixels
    # (N, 9, 2) derivatives of the pixels: per metre of x, y, z, per degree of pitch, roll, yaw, per percent
    # of focal length, and per metre that roof and base of the point's own building are higher
    moves: Floats
    buildings: NDArray[np.int64]  # (N,) indices of their buildings in the edge arrays
    east_north: Floats  # (N, 2) their horizontal position, scene metres

    def __len__(self) -> int:
        return len(self.lengths)

    def slopes(self, count: int = 9) -> Floats:
        """Returns (N, count) derivatives of each point along its normal, by the first numbers."""
        return np.asarray((self.moves[:, :count] * self.normals[:, None, :]).sum(axis=2))


def edges_in_reach(scene: Scene, camera: Camera, prior: Pose, reach_m: float, turn_deg: float) -> EdgeArrays:
    """Returns the edges of the buildings that may be visible from near a prior.

    The camera's centre may differ from it by ``reach_m``, its rotation by ``turn_deg``.
    """
    rows = _in_reach(scene, camera, prior, reach_m, turn_deg)
    return edges_of(_part(scene, rows))._replace(buildings=rows)


def scene_in_reach(scene: Scene, camera: Camera, prior: Pose, reach_m: float, turn_deg: float) -> Scene:
    """Returns the scene of the buildings that may be visible from near a prior; see ``edges_in_reach``."""
    return _part(scene, _in_reach(scene, camera, prior, reach_m, turn_deg))


def _in_reach(
    scene: Scene, camera: Camera, prior: Pose, reach_m: float, turn_deg: float
) -> NDArray[np.int64]:
    """Returns the indices of the buildings that may be visible from near a prior."""
    wider = bounding_spheres(scene)
    away = np.linalg.norm(wider[:, :3] - prior.center, axis=1)
    chord = 2.0 * np.sin(np.radians(min(turn_deg, 180.0)) / 2.0)
    wider[:, 3] += reach_m + chord * (np.where(np.isfinite(away), away, 0.0) + reach_m)
    planes = view_planes(camera, 0, camera.width)
    rotation, center = np.ascontiguousarray(prior.rotation), np.ascontiguousarray(prior.center)
    return np.asarray(kernels.visible_buildings(wider, rotation, center, planes))


def sample_outline(
    edges: EdgeArrays,
    camera: Camera,
    vector: Floats,
    silhouette: NDArray[np.bool_],
    spacing_px: float,
) -> OutlinePoints:
    """Returns points along the occluding edges: those with a silhouette on one side and none on the other.

    Eq. (M3) of docs/methods/index.md.

    Args:
        edges: edges of the buildings in reach.
        camera: pinhole of the silhouette's size.
        vector: (6,) the pose that the silhouette is drawn from; numbers after it are not used.
        silhouette: (H, W) the silhouette.
        spacing_px: distance between points, pixels.
    """
    pose, derivatives = pose_from_vector(vector), rotation_derivatives(vector)
    rotation, center = np.ascontiguousarray(pose.rotation), np.ascontiguousarray(pose.center)
    visible = kernels.visible_buildings(edges.spheres, rotation, center, view_planes(camera, 0, camera.width))
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    room = _ROOM
    while True:
        buffers = np.empty((room, 25)), np.empty(room, dtype=np.int64)
        view = rotation, center, derivatives, intrinsics
        count = kernels.sample_edges(edges, visible, *view, silhouette, spacing_px, *buffers)
        if count <= room:
            break
        room = count
    rows, buildings = buffers[0][:count], buffers[1][:count]
    moves = np.ascontiguousarray(rows[:, 5:23].reshape(count, 9, 2))
    return OutlinePoints(rows[:, 0:2], rows[:, 2:4], rows[:, 4], moves, buildings, rows[:, 23:])


def _part(scene: Scene, chosen: NDArray[np.int64]) -> Scene:
    """Returns a scene of some of the buildings, in their order."""
    vertex_counts = np.diff(scene.vertex_starts)[chosen]
    triangle_counts = np.diff(scene.triangle_starts)[chosen]
    vertex_starts = np.concatenate([[0], np.cumsum(vertex_counts)])
    triangle_starts = np.concatenate([[0], np.cumsum(triangle_counts)])
    vertices = _rows(scene.vertex_starts[chosen], vertex_counts)
    triangles = _rows(scene.triangle_starts[chosen], triangle_counts)
    shift = np.repeat(vertex_starts[:-1] - scene.vertex_starts[chosen], triangle_counts)
    return Scene(
        vertices=scene.vertices[vertices],
        triangles=(scene.triangles[triangles] + shift[:, None]).astype(np.int32),
        vertex_starts=vertex_starts,
        triangle_starts=triangle_starts,
        building_ids=tuple(scene.building_ids[b] for b in chosen),
        lod=scene.lod,
        crs=scene.crs,
        origin=scene.origin,
        pitched=None if scene.pitched is None else scene.pitched[chosen],
    )


def _rows(starts: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Returns the indices of runs of rows, one run after the other."""
    before = np.concatenate([[0], np.cumsum(counts)[:-1]]) if len(counts) else counts
    return np.asarray(np.arange(counts.sum()) + np.repeat(starts - before, counts), dtype=np.int64)


def edges_of(scene: Scene) -> EdgeArrays:
    """Returns the edges of all buildings of a scene."""
    table = edge_table(scene)
    vertices = scene.vertices.astype(np.float64)
    a, b, c = (vertices[scene.triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    offsets = -(normals * a).sum(axis=1)
    base_heights, heights = floors_and_rises(scene)
    return EdgeArrays(
        vertices=vertices,
        corners=table.corners,
        sides=table.sides,
        second_weight=table.second_weight,
        starts=table.starts,
        planes=np.concatenate([normals, offsets[:, None]], axis=1),
        spheres=bounding_spheres(scene),
        base_heights=base_heights,
        heights=heights,
        buildings=np.arange(scene.num_buildings),
    )


# The largest distance of points that the noise is estimated from, and the least and largest noise, pixels.
FAR_PX = 20.0
NOISE_PX = (0.5, 6.0)
# The least agreement with the mask's direction of points that its noise is estimated from.
_AGREES = 0.3
# The fraction of the outline's variance that is independent at each point.
_OWN_FRACTION = 0.3
# The least weight of a point: of less, its variance is too large for a factorisation.
LEAST_WEIGHT = 1e-8


def near_distances(distances: Floats, agreement: Floats) -> Floats:
    """Returns the distances, of (N,), that the noise of an outline is estimated from; agreement is (N,)."""
    return np.asarray(distances[(agreement > _AGREES) & (np.abs(distances) < FAR_PX)])


def outline_noise(near: Floats) -> float:
    """Returns the standard deviation of a mask's outline in pixels, from the median distance.

    Eq. (C8) of docs/methods/contour_alignment.md; (N,) ``near_distances``, less errors known to be common.
    """
    low, high = NOISE_PX
    return float(np.clip(1.4826 * np.median(np.abs(near)), low, high)) if len(near) else high


def outline_covariance(
    pixels: Floats,
    by_roof: Floats,
    by_base: Floats,
    buildings: NDArray[np.int64],
    noise_px: float,
    lengths_px: tuple[float, float],
    errors_m2: tuple[float, float, float],
) -> Floats:
    """Returns the lower half of the covariance of N distances, (N, N) square pixels.

    Eqs. (C6), (C7) of docs/methods/contour_alignment.md.

    Args:
        pixels: (N, 2) the points.
        by_roof: (N,) derivatives of distances per metre that the building's roof is higher.
        by_base: (N,) the same for its base.
        buildings: (N,) their buildings.
        noise_px: standard deviation of the outline, pixels.
        lengths_px: distances over which errors of the outline, and of a roof, are correlated, pixels.
        errors_m2: variances of a roof as a whole, of its parts, and of a base, square metres.
    """
    noise = (1.0 - _OWN_FRACTION) * noise_px**2, _OWN_FRACTION * noise_px**2
    slopes = np.ascontiguousarray(by_roof), np.ascontiguousarray(by_base)
    return np.asarray(kernels.error_covariance(pixels, *slopes, buildings, noise, lengths_px, errors_m2))


def add_outliers(covariance: Floats, noise_px: float, weights: Floats) -> None:
    """Adds the independent errors of outliers to the diagonal of a covariance, for weights (N,) in (0, 1]."""
    covariance[np.diag_indices(len(covariance))] += noise_px**2 * (1.0 / weights - 1.0)


Mask = NDArray[np.bool_]

# Fewer points than this say nothing about six numbers.
_FEWEST_POINTS = 12
# By how much the stairs of a mask's outline are smoothed.
_STAIR_PX = 1.0


@dataclass(frozen=True, slots=True)
class OutlineModel:
    """How outlines of map and mask are compared, and how far a camera may be from its prior."""

    size: tuple[int, int]  # width and height of masks where all other pixels are counted, ``fine_size``
    sigmas: tuple[float, ...]  # (7,) standard deviations of the prior: metres, degrees, percent of the lens
    reach_m: float  # how far from the prior edges of the map are looked at
    turn_deg: float  # and how far turned
    spacing_px: float  # distance between outline points
    noise_px: float  # standard deviation of a mask's outline
    correlation_px: float  # length of outline that counts as one observation
    roof_m: float  # standard deviation of each building's height in the map; 0 trusts the map
    outline_px: float  # distance over which the errors of a mask's outline go together
    roof_part_px: float  # distance over which a roof's error goes together


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """The query at one working size."""

    camera: Camera  # pinhole of that size
    mask: Mask  # (H, W) the query mask
    distance: NDArray[np.float32]  # (H, W) float32 signed distance to its outline, pixels, positive inside
    scale: float  # pixels of this size per pixel of the fine size


# The query at the sizes used so far.
Levels = dict[tuple[int, int], Level]


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """How far N points of a pose's outline lie inside the mask's, in pixels of the fine size."""

    points: OutlinePoints  # the outline, in pixels of the working size
    distances: Floats  # (N,) positive inside the mask
    slopes: Floats  # (N, 9) their change per unit of ``OutlinePoints.moves``
    agreement: Floats  # (N,) 1 where the mask's outline runs as the silhouette's does, 0 across or against it
    scale: float  # pixels of the working size per pixel of the fine size
    iou: float  # of silhouette and mask


class Linearization(NamedTuple):
    """The posterior of a camera's seven numbers by outlines, to second order."""

    posterior: Quadratic  # in metres, degrees and percent of the lens; the prior included
    iou: float  # of silhouette and mask

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
        shown = kernels.visible_buildings(
            self.edges.spheres, rotation, center, view_planes(camera, 0, camera.width)
        )
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
        products, gradients = kernels.normal_equations(
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
        kernels.measure_distances(points.pixels, points.normals, points.moves, level.distance, *measured)
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
