"""Edges of roofs in photos: at a roof's true height its eaves and ridges lie on edges of all that show them.

Roofs of one colour look alike at every height within them (``roof_sweep``); where they end they do not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Query
from lodbench.estimation.edge_alignment import LensErrors, project
from lodbench.geometry import Camera, Pose
from lodbench.photos.pictures import read_picture
from lodbench.segmentation import binary_mask

Floats = NDArray[np.float64]

# Photos are compared at this width, or at what leaves all of them so many pixels (1 GB), blurred a little,
# for poses are not exact.
_WIDTH, _PIXELS, _PICTURE_BLUR_PX = 1280, 256_000_000, 0.8


@dataclass(frozen=True, slots=True, eq=False)
class SweepPicture:
    """A photo as roofs are compared in it."""

    camera: Camera  # the lens it was found to have, of the picture's size
    distortion: float  # radial, k1
    pose: Pose  # scene frame
    pixels: NDArray[np.uint8]  # (H, W, 4) L, a, b and the mask, 8 bits

    def project(self, points: Floats, distortion: float | None = None) -> tuple[Floats, Floats]:
        """Returns pixels (..., 2) of points (..., 3), the first pixel's centre at 0.5, and depths."""
        local = (points - self.pose.center) @ self.pose.rotation.T
        lens = LensErrors(k1=self.distortion if distortion is None else distortion)
        return project(local, self.camera, lens), local[..., 2]

    def holds(self, pixels: Floats, depths: Floats) -> NDArray[np.bool_]:
        """Returns which pixels it has, a pixel from its edge."""
        size = np.array([self.camera.width, self.camera.height]) - 1.0
        return np.asarray(((pixels > 1.0) & (pixels < size)).all(axis=-1) & (depths > 1.0))

    def shift_colours(self, shift: NDArray[np.float32]) -> None:
        """Adds (3,) to L, a and b, which stay within 8 bits."""
        self.pixels[..., :3] = np.clip(np.rint(self.pixels[..., :3] + shift), 0, 255)


def open_pictures(queries: Sequence[Query], poses: Sequence[Pose], lens: Floats) -> list[SweepPicture]:
    """Returns the photos that can be read, at their poses; many are narrower than few.

    The lens is the focal length's change as a share, and the radial distortion k1.
    """
    if not queries:
        return []
    # Of pictures one pixel wide.
    area = sum(query.camera.height / query.camera.width for query in queries)
    width = min(_WIDTH, int(math.sqrt(_PIXELS / area)))
    taken = (_picture(query, pose, lens, width) for query, pose in zip(queries, poses, strict=True))
    return [picture for picture in taken if picture is not None]


def _picture(query: Query, pose: Pose, lens: Floats, widest: int) -> SweepPicture | None:
    pixels = None if query.image is None else read_picture(query.image)
    if pixels is None:
        return None
    width = min(widest, pixels.shape[1])
    camera = query.camera.scaled_to_width(width)
    size = camera.width, camera.height
    small = cv2.GaussianBlur(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), (0, 0), _PICTURE_BLUR_PX)
    mask = 255 * binary_mask(query.mask, *size).astype(np.uint8)
    camera = LensErrors(float(lens[0])).pinhole(camera)
    return SweepPicture(
        camera, float(lens[1]), pose, np.dstack([cv2.cvtColor(small, cv2.COLOR_BGR2LAB), mask])
    )


# Colours L, a, b count so much; edges within so many pixels are one.
_WEIGHTS, _BLUR_PX = (1.0, 2.0, 2.0), 1.0
# Strengths are shares of the photo's mean; so much is added, for edges that a photo does not have.
_ADDED = 0.5
# So many points are looked at at once: OpenCV takes maps of 32,767 columns.
_AT_ONCE = 16_384
# Points of one roof err together: N say as much as _ALONE * sqrt(N) of them, and no more than so many do.
_ALONE, _MOST_POINTS = 0.7, 2000


class EdgeEvidence(NamedTuple):
    """How strong a roof's edges are in photos, by its height."""

    logs: Floats  # (H,) sums of logarithms over points and photos
    points: int  # how many points of all photos were summed
    photos: int  # how many photos

    def log_likelihoods(self) -> Floats:
        """Returns (H,) how well each height explains the photos. Eq. (F22) of docs/methods/flight.md."""
        return np.asarray(_ALONE * math.sqrt(min(self.points, _MOST_POINTS)) * self.logs / self.points)


def edge_evidence(
    pictures: Sequence[SweepPicture],
    near: Sequence[NDArray[np.int64]],
    edges: Mapping[int, Floats],
    visible_of: Sequence[NDArray[np.bool_]],
    heights_m: Floats,
) -> dict[int, EdgeEvidence]:
    """Returns how strong edges are in the photos that show them, by row of the building.

    Args:
        pictures: The photos.
        near: By photo, rows of the buildings whose edges are looked at in it.
        edges: Their points, see ``edge_points``.
        visible_of: By photo, which of the points of all its buildings it shows, one after the other.
        heights_m: (H,) by how much higher than in the map a building may be.
    """
    evidence: dict[int, EdgeEvidence] = {}
    for picture, rows, is_visible in zip(pictures, near, visible_of, strict=True):
        if not is_visible.any():
            continue
        points = np.concatenate([edges[row] for row in rows.tolist()])[is_visible]
        owner = np.repeat(np.arange(len(rows)), [len(edges[row]) for row in rows.tolist()])[is_visible]
        structure = _structure(picture.pixels)
        parts = np.split(points, range(_AT_ONCE, len(points), _AT_ONCE))
        logs = np.concatenate([_log_strengths(picture, *structure, p, heights_m) for p in parts], axis=1)
        shown, first, counts = np.unique(owner, return_index=True, return_counts=True)
        sums = np.add.reduceat(logs, first, axis=1).T
        for row, summed, count in zip(rows[shown].tolist(), sums, counts.tolist(), strict=True):
            before = evidence.get(row, EdgeEvidence(np.zeros(len(heights_m)), 0, 0))
            evidence[row] = EdgeEvidence(before.logs + summed, before.points + count, before.photos + 1)
    return evidence


def _log_strengths(
    picture: SweepPicture, tensor: NDArray[np.float32], mean: float, points: Floats, heights_m: Floats
) -> Floats:
    """Returns (H, N) logarithms of how strong a photo's edges along (N, 7) points are, shares of its mean."""
    raised = points[:, :3] + heights_m[:, None, None] * points[:, 3:4] * [0.0, 0.0, 1.0]
    x, y = np.moveaxis((picture.project(raised)[0] - 0.5).astype(np.float32), -1, 0)
    at = cv2.remap(tensor, x, y, cv2.INTER_LINEAR)
    run = picture.project(points[:, :3] + 0.05 * points[:, 4:])[0] - picture.project(points[:, :3])[0]
    column, line = (run / np.maximum(np.linalg.norm(run, axis=1, keepdims=True), 1e-12)).T
    # Across the edge.
    square = line**2 * at[..., 0] - 2.0 * line * column * at[..., 1] + column**2 * at[..., 2]
    return np.asarray(np.log(np.sqrt(np.maximum(square, 0.0)) / mean + _ADDED))


def _structure(pixels: NDArray[np.uint8]) -> tuple[NDArray[np.float32], float]:
    """Returns the structure tensor (H, W, 3) xx, xy, yy of the colours, and the mean strength of edges.

    Foerstner and Guelch, "A fast operator for detection and precise location of distinct points, corners and
    centres of circular features", 1987.
    """
    tensor = np.zeros((*pixels.shape[:2], 3), np.float32)
    for channel, weight in enumerate(_WEIGHTS):
        colour = np.ascontiguousarray(pixels[..., channel])
        right, down = (cv2.Scharr(colour, cv2.CV_32F, *axis) * (weight / 32.0) for axis in ((1, 0), (0, 1)))
        tensor += np.stack([right * right, right * down, down * down], axis=-1)
    tensor = np.asarray(cv2.GaussianBlur(tensor, (0, 0), _BLUR_PX), np.float32)
    return tensor, max(float(np.sqrt(tensor[..., 0] + tensor[..., 2]).mean()), 1e-3)
