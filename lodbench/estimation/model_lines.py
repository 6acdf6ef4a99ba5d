"""Points on the visible lines of a model, and how each moves in the picture with camera, lens and map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene, floors_and_rises
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.geometry.angles import rotation_from_euler
from lodbench.geometry.pose import rotation_derivatives

Floats = NDArray[np.float64]

# Points are taken for no nearer than this, metres.
_NEAREST_M = 1e-6


@dataclass(frozen=True, slots=True)
class LensErrors:
    """Errors of a camera's declared intrinsics.

    Attributes:
        focal: By which share the focal length is longer than declared.
        k1: Radial distortion, normalised coordinates.
        right: How far right of the declared principal point the true one is, share of the width.
        down: How far below, share of the width.
    """

    focal: float = 0.0
    k1: float = 0.0
    right: float = 0.0
    down: float = 0.0

    def pinhole(self, camera: Camera) -> Camera:
        """Returns a pinhole as near to a camera with these errors as one can be, to draw with."""
        return replace(
            camera,
            fx=camera.fx * (1.0 + self.focal),
            fy=camera.fy * (1.0 + self.focal),
            cx=camera.cx + self.right * camera.width,
            cy=camera.cy + self.down * camera.width,
        )


EXACT = LensErrors()


def project(local: Floats, camera: Camera, lens: LensErrors = EXACT) -> Floats:
    """Returns pixels (..., 2) of points in camera axes (..., 3), metres; pixel centres at +0.5."""
    away = local[..., :2] / np.maximum(local[..., 2:], _NEAREST_M)
    stretch = 1.0 + lens.k1 * (away**2).sum(axis=-1, keepdims=True)
    focal = np.array([camera.fx, camera.fy]) * (1.0 + lens.focal)
    centre = np.array([camera.cx, camera.cy]) + camera.width * np.array([lens.right, lens.down])
    return np.asarray(away * stretch * focal + centre)


def projection_slopes(local: Floats, camera: Camera, lens: LensErrors = EXACT) -> Floats:
    """Returns (N, 2, 7) how pixels of points (N, 3) change with these, then with ``LensErrors``."""
    depth = np.maximum(local[:, 2], _NEAREST_M)
    away = local[:, :2] / depth[:, None]
    square = (away**2).sum(axis=1)
    stretch = 1.0 + lens.k1 * square
    declared = np.array([camera.fx, camera.fy])
    focal = declared * (1.0 + lens.focal)
    by_away = stretch[:, None, None] * np.eye(2) + 2.0 * lens.k1 * away[:, :, None] * away[:, None, :]
    slopes = np.zeros((len(local), 2, 7))
    slopes[:, :, :2] = by_away / depth[:, None, None]
    slopes[:, :, 2] = -(by_away @ away[..., None])[..., 0] / depth[:, None]
    slopes[:, :, :3] *= focal[:, None]
    slopes[:, :, 3] = away * stretch[:, None] * declared
    slopes[:, :, 4] = away * square[:, None] * focal
    slopes[:, 0, 5] = slopes[:, 1, 6] = camera.width
    return slopes


# Least angle between two faces to be a line, degrees; the shortest line, pixels.
_CREASE_DEG, _SHORTEST_PX = 25.0, 6.0
# What is lower than this has no height that could err, metres.
_FLAT_M = 0.1
# The distance along a line to the point that gives its direction in the picture, fraction of its length.
_FURTHER = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class ModelLines:
    """N points spread evenly along the lines of a model that a view shows.

    Attributes:
        points: (N, 3) scene metres.
        along: (N, 3) from where its line begins to where it ends, metres.
        relative_heights: (N,) heights as fractions of the building's height: 0 base, 1 ridge. Also how much
            a point moves up if roofs are 1 m higher; if bases are, it moves by the rest.
        buildings: (N,) rows of the scene.
        lines: (N,) numbers of the lines.
        lengths_px: (N,) length of line that each stands for, pixels.
        is_contour: (N,) whether the building ends there as the view shows it.
    """

    points: Floats
    along: Floats
    relative_heights: Floats
    buildings: NDArray[np.int64]
    lines: NDArray[np.int64]
    lengths_px: Floats
    is_contour: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.points)

    def of(self, chosen: NDArray[np.bool_]) -> ModelLines:
        """Returns some of the points."""
        parts = (getattr(self, name)[chosen] for name in self.__slots__)
        return ModelLines(*parts)


def lines_in_view(city_map: CityMap, camera: Camera, pose: Pose, spacing_px: float) -> ModelLines:
    """Returns points on the lines of a map that are visible from a pose, ``spacing_px`` pixels apart."""
    (view,) = city_map.edges(camera, pose.rotation[None], pose.center[None], _CREASE_DEG)
    lengths = np.linalg.norm(view.pixels[:, 1] - view.pixels[:, 0], axis=1)
    rows = np.flatnonzero(view.is_visible & (lengths > _SHORTEST_PX))
    counts = np.maximum((lengths[rows] / spacing_px).astype(np.int64), 1)
    which = np.repeat(np.arange(len(rows)), counts)
    place = (np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[which]
    rows = rows[which]
    start, along = view.points[rows, 0], view.points[rows, 1] - view.points[rows, 0]
    points, buildings = start + place[:, None] * along, view.building[rows]
    return ModelLines(
        points=points,
        along=along,
        relative_heights=relative_heights(city_map.scene, points[:, 2], buildings),
        buildings=buildings,
        lines=which,
        lengths_px=lengths[rows] / counts[which],
        is_contour=view.kind[rows] == 1,
    )


def relative_heights(scene: Scene, heights_m: Floats, buildings: NDArray[np.int64]) -> Floats:
    """Returns (N,) at which share of its building's height each height lies; 1 for what is flat."""
    floors, rises = (each[buildings] for each in floors_and_rises(scene))
    tall = rises > _FLAT_M
    relative = (heights_m - floors) / np.where(tall, rises, 1.0)
    return np.asarray(np.where(tall, np.clip(relative, 0.0, 1.0), 1.0))


# Columns of slopes: x, y, z (metres), pitch, roll, yaw (degrees), then ``LensErrors`` in its order.
NUM_POSE_AND_LENS = 10


@dataclass(frozen=True, slots=True, eq=False)
class Projected:
    """Points of lines in a picture.

    Attributes:
        pixels: (N, 2) pixels; pixel centres at +0.5.
        normals: (N, 2) unit, across their lines.
        by_camera: (N, 10) how far each moves along its normal per unit of the pose and ``LensErrors``.
        by_place: (N, 3) the same per metre that the point itself moves, scene axes.
    """

    pixels: Floats
    normals: Floats
    by_camera: Floats
    by_place: Floats


def project_lines(
    points: Floats, along: Floats, camera: Camera, vector: Floats, lens: LensErrors
) -> Projected:
    """Returns points of lines as a lens shows them, with their slopes.

    Args:
        points: (N, 3) scene metres.
        along: (N, 3) their lines' directions, metres.
        camera: Pinhole as declared.
        vector: (6,) centre in metres, pitch, roll and yaw in degrees.
        lens: How the camera differs from that.
    """
    rotation = rotation_from_euler(EulerAngles(*(float(v) for v in vector[3:6])))
    away = points - vector[:3]
    local = away @ rotation.T
    pixels, per_local = project(local, camera, lens), projection_slopes(local, camera, lens)
    line = project((away + _FURTHER * along) @ rotation.T, camera, lens) - pixels
    line /= np.maximum(np.linalg.norm(line, axis=1), 1e-12)[:, None]
    normals = np.stack([-line[:, 1], line[:, 0]], axis=1)
    across = np.einsum("ni,nij->nj", normals, per_local[:, :, :3])
    by_place = across @ rotation
    turns = np.einsum("kij,nj->nki", rotation_derivatives(vector), away)
    by_angles = np.einsum("ni,nki->nk", across, turns)
    by_lens = np.einsum("ni,nij->nj", normals, per_local[:, :, 3:])
    return Projected(pixels, normals, np.concatenate([-by_place, by_angles, by_lens], axis=1), by_place)
