"""Points of the outline of a city's silhouette, with derivatives by pose, focal length, roof and base."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.scene import Scene, floors_and_rises
from lodbench.geometry import Camera, Pose
from lodbench.geometry.pose import pose_from_vector, rotation_derivatives
from lodbench.kernels import error_covariance, sample_edges, visible_buildings
from lodbench.kernels.arguments import EdgeArrays
from lodbench.rendering.edges import edge_table
from lodbench.rendering.projection import bounding_spheres, view_planes

Floats = NDArray[np.float64]

# Columns of an outline's derivatives after the pose and the focal length: roof and base of a point's own
# building. State vectors have the offsets of all buildings there.
OWN_ROOF, OWN_BASE = 7, 8
# Number of points that fit at first; a view with more is sampled again with room for all.
_ROOM = 1 << 14


@dataclass(frozen=True, slots=True, eq=False)
class OutlinePoints:
    """N points spread evenly along the outline of a silhouette.

    Attributes:
        pixels: (N, 2) their pixels.
        normals: (N, 2) unit normals, pointing out of the silhouette.
        lengths: (N,) length of outline that each stands for, pixels.
        moves: (N, 9, 2) derivatives of the pixels: per metre of x, y, z, per degree of pitch, roll, yaw, per
            percent of focal length, and per metre that roof and base of the point's own building are higher.
        buildings: (N,) indices of their buildings in the edge arrays.
        east_north: (N, 2) their horizontal position, scene metres.
    """

    pixels: Floats
    normals: Floats
    lengths: Floats
    moves: Floats
    buildings: NDArray[np.int64]
    east_north: Floats

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
    return np.asarray(visible_buildings(wider, rotation, center, planes))


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
    visible = visible_buildings(edges.spheres, rotation, center, view_planes(camera, 0, camera.width))
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    room = _ROOM
    while True:
        found = np.empty((room, 25)), np.empty(room, dtype=np.int64)
        view = rotation, center, derivatives, intrinsics
        count = sample_edges(edges, visible, *view, silhouette, spacing_px, *found)
        if count <= room:
            break
        room = count
    rows, buildings = found[0][:count], found[1][:count]
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
    return np.asarray(error_covariance(pixels, *slopes, buildings, noise, lengths_px, errors_m2))


def add_outliers(covariance: Floats, noise_px: float, weights: Floats) -> None:
    """Adds the independent errors of outliers to the diagonal of a covariance, for weights (N,) in (0, 1]."""
    covariance[np.diag_indices(len(covariance))] += noise_px**2 * (1.0 / weights - 1.0)
