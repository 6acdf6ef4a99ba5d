"""How far a photo's edges lie from a map's roof edges at a pose: whether the photo itself confirms an answer.

The measure knows no method and no truth, so it ranks answers and true poses alike.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.scene import Scene, building_boxes
from lodbench.geometry import Camera, Pose

Floats = NDArray[np.float64]

# Photos are looked at no wider than this; distances are pixels of that size.
WIDTH = 1600
# How far an image edge may be from a place of a roof edge, and the angle between the two.
REACH_PX, PARALLEL_DEG = 6.0, 15.0
# Shorter image edges are texture; between places of a roof edge; how far a segment is continued at its ends.
_LEAST_PX, _STEP_PX, _BEYOND_PX = 10.0, 4.0, 2.0
# Steeper edges are those of walls; lower than this share of a building's height its walls end.
_STEEPEST, _FEET = 0.7, 0.2


class PhotoEdges:
    """The straight edges of one photo, to be compared with a map from any number of poses.

    Args:
        photo: (H, W) or (H, W, 3) uint8.
        camera: The photo's, of any size; scaled so that the photo is at most ``WIDTH`` wide.
    """

    def __init__(self, photo: NDArray[np.uint8], camera: Camera) -> None:
        width = min(camera.width, WIDTH)
        self.camera = camera.scaled(width, max(1, round(camera.height * width / camera.width)))
        size = self.camera.width, self.camera.height
        grey = photo if photo.ndim == 2 else cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        found = cv2.createLineSegmentDetector().detect(small)[0]
        # OpenCV counts from the middle of the first pixel, cameras from its corner.
        ends = np.empty((0, 2, 2)) if found is None else found.reshape(-1, 2, 2).astype(np.float64) + 0.5
        lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        self._ends, self._lengths = ends[lengths >= _LEAST_PX], lengths[lengths >= _LEAST_PX]
        self._along = (self._ends[:, 1] - self._ends[:, 0]) / self._lengths[:, None]

    def distances(self, pose: Pose, city_map: CityMap) -> Floats:
        """Returns (N,) pixels from places on visible roof edges to the nearest parallel image edge.

        Places are every 4 px; infinite where no image edge within 15 degrees lies within 6 px. Empty where no
        roof is in view of the pose, scene frame.
        """
        pieces = roof_edges(self.camera, pose, city_map)
        return np.concatenate([np.empty(0), *(self._from(first, last) for first, last in pieces)])

    def _from(self, first: Floats, last: Floats) -> Floats:
        """Returns the distances from places on one edge, between two pixels, (2,) each."""
        length = float(np.linalg.norm(last - first))
        along = (last - first) / max(length, 1e-9)
        off = (self._ends - first) @ np.array([-along[1], along[0]])
        near = (np.abs(off).min(axis=1) < REACH_PX + _BEYOND_PX) | (off[:, 0] * off[:, 1] < 0.0)
        kept = near & (np.abs(self._along @ along) > np.cos(np.radians(PARALLEL_DEG)))
        count = max(1, round(length / _STEP_PX))
        places = first + (np.arange(count) + 0.5)[:, None] / count * (last - first)
        offsets = places[:, None] - self._ends[kept, 0]
        beside = (offsets * self._along[kept]).sum(axis=2)
        across = np.abs(offsets[..., 0] * self._along[kept, 1] - offsets[..., 1] * self._along[kept, 0])
        ends_before = (beside < -_BEYOND_PX) | (beside > self._lengths[kept] + _BEYOND_PX)
        nearest = np.where(ends_before, np.inf, across).min(axis=1, initial=np.inf)
        return np.where(nearest <= REACH_PX, nearest, np.inf)


def roof_edges(camera: Camera, pose: Pose, city_map: CityMap) -> Floats:
    """Returns (S, 2, 2) pixels between which visible edges of roofs run; edges of walls are left out."""
    (edges,) = city_map.edges(camera, pose.rotation[None], pose.center[None])
    rise = np.abs(edges.points[:, 1, 2] - edges.points[:, 0, 2])
    length = np.linalg.norm(edges.points[:, 1] - edges.points[:, 0], axis=1)
    is_high = edges.points[:, :, 2].min(axis=1) > _feet(city_map.scene)[edges.building]
    return np.asarray(edges.pixels[edges.is_visible & is_high & (rise < _STEEPEST * length)])


def _feet(scene: Scene) -> Floats:
    """Returns (B,) heights, scene metres, up to which edges are taken for the feet of a building's walls."""
    boxes, heights = building_boxes(scene), np.zeros(scene.num_buildings)
    heights[boxes.building] = boxes.low[:, 2] + _FEET * (boxes.high[:, 2] - boxes.low[:, 2])
    return heights


def median_and_share(distances: Floats) -> tuple[float, float]:
    """Returns the median of the finite distances, pixels, and their share; NaN where there are none."""
    found = distances[np.isfinite(distances)]
    median = float(np.median(found)) if len(found) else float("nan")
    return median, len(found) / len(distances) if len(distances) else float("nan")
