"""The tracker: outlines aligned from where the last motion leads; a lost camera is searched for."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.geometry import Camera, Pose
from lodbench.methods.contour_alignment import ContourAlignment
from lodbench.methods.contour_alignment.alignment import Aligner
from lodbench.methods.contour_alignment.params import Params as PhotoParams
from lodbench.methods.contour_alignment.pose_vector import pose_from_vector, vector_from_pose
from lodbench.methods.tracking.params import Params, half_size
from lodbench.storage import random_stream

Floats = NDArray[np.float64]

# Frames by which a frame's overlap is judged, and the share of the last motion in what is thought of it.
_REMEMBERED, _NEWS = 10, 0.6
# The kernel's last scale, pixels of the fine size.
_NEAR_PX = 4.0
# Motion is not carried on over more seconds than this: a drone turns at the end of its line.
_LONGEST_S = 2.0

TRACKED, FOUND, LOST = "tracked", "found again", "lost"


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A frame to track.

    Attributes:
        name: Of the frame.
        time_s: When it was taken, seconds.
        mask: (H, W) probability of building.
    """

    name: str
    time_s: float
    mask: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """What became of a frame.

    Attributes:
        pose: Scene frame; where the camera is thought to be, should it be lost.
        state: ``tracked``, ``found again`` or ``lost``.
        score: IoU of silhouette and mask.
    """

    pose: Pose
    state: str
    score: float


class Tracker:
    """Poses of frames in the order they were taken.

    Args:
        city_map: The map.
        camera: Pinhole of all frames.
        start: Rough pose of the first frame, scene frame, as wrong as a drone's sensors.
        params: How.
        first: How the first frame is found from there; by default as any single photo.
    """

    def __init__(
        self,
        city_map: CityMap,
        camera: Camera,
        start: Pose,
        params: Params | None = None,
        first: PhotoParams | None = None,
    ) -> None:
        self._map, self._camera, self.params = city_map, camera, params or Params()
        self._first = first or PhotoParams()
        self._vector: Floats = vector_from_pose(start)
        self._motion: Floats = np.zeros(6)
        self._time_s: float | None = None
        self._ious: deque[float] = deque(maxlen=_REMEMBERED)
        self._lost = 0

    def track(self, frame: Frame) -> Tracked:
        """Returns where the camera was; it is lost where nothing near fits as well as the last frames did."""
        if not (frame.mask >= 0.5).any():
            return self._keep(frame, self._predicted(frame), LOST, 0.0)
        if self._time_s is None:
            found = self._searched(frame, self._vector, self._first)
            return self._keep(frame, *found, is_first=True)
        predicted = self._predicted(frame)
        if not self._lost:
            vector, iou = self._aligned(frame, predicted)
            if iou >= self._least():
                return self._keep(frame, vector, TRACKED, iou)
        vector, _, iou = self._searched(frame, predicted, self.params.search(self._lost + 1))
        is_found = iou >= self._least()
        return self._keep(frame, vector if is_found else predicted, FOUND if is_found else LOST, iou)

    def _predicted(self, frame: Frame) -> Floats:
        seconds = 0.0 if self._time_s is None else frame.time_s - self._time_s
        return np.asarray(self._vector + self._motion * min(max(seconds, 0.0), _LONGEST_S))

    def _least(self) -> float:
        """Returns the least overlap of a frame that is not lost."""
        usual = float(np.median(self._ious)) if self._ious else 0.0
        return max(self.params.least_iou, self.params.fit * usual)

    def _aligned(self, frame: Frame, predicted: Floats) -> tuple[Floats, float]:
        """Returns the pose, (6,), that outlines lead to from where the motion leads, and its IoU.

        Should they lead nowhere, they start again from the last pose: the motion may have ended.
        """
        seconds = max(frame.time_s - (self._time_s or 0.0), 0.0)
        aligner = Aligner(self._query(frame, predicted), self._map, self.params.photo(seconds))
        best, iou = self._steps(aligner, predicted)
        if iou < self._least() and np.abs(self._motion).max() > 0:
            again, other = self._steps(aligner, self._vector)
            if other > iou:
                return again, other
        return best, iou

    def _steps(self, aligner: Aligner, start: Floats) -> tuple[Floats, float]:
        size, params = self.params.fine_size, self.params
        reaches = np.geomspace(params.reach_px, _NEAR_PX, params.steps)
        vector = aligner.align(np.append(start, 0.0), tuple(map(float, reaches)), half_size(size))
        vector = aligner.align(vector, (_NEAR_PX,) * params.final_steps, size)
        here = aligner.measure(vector, size)
        return vector[:6], 0.0 if here is None else here.iou

    def _searched(self, frame: Frame, around: Floats, params: PhotoParams) -> tuple[Floats, str, float]:
        """Returns the best pose, (6,), within a search, that it was found, and its IoU; 0 where none fits."""
        streams = partial(random_stream, 0, "track", frame.name)
        try:
            found = ContourAlignment(params).localize(self._query(frame, around), self._map, streams)
        except QueryFault:
            return around, LOST, 0.0
        return vector_from_pose(found.pose), FOUND, float(found.score)

    def _query(self, frame: Frame, around: Floats) -> Query:
        return Query(frame.name, "", self._camera, pose_from_vector(around), frame.mask)

    def _keep(
        self, frame: Frame, vector: Floats, state: str, iou: float, *, is_first: bool = False
    ) -> Tracked:
        """Remembers what became of a frame, and returns it."""
        if is_first:
            state = TRACKED if iou >= self.params.least_iou else LOST
        if state == LOST:
            self._lost += 1
        else:
            self._motion = self._motion_to(frame, vector) if state == TRACKED else np.zeros(6)
            self._lost = 0
            self._ious.append(iou)
            self._vector = vector
            self._time_s = frame.time_s
        return Tracked(pose_from_vector(vector), state, iou)

    def _motion_to(self, frame: Frame, vector: Floats) -> Floats:
        """Returns the motion per second, (6,), after a frame was tracked."""
        if self._time_s is None or frame.time_s <= self._time_s:
            return np.zeros(6)
        step = vector - self._vector
        step[3:] = (step[3:] + 180.0) % 360.0 - 180.0
        new = step / (frame.time_s - self._time_s)
        return np.asarray(_NEWS * new + (1.0 - _NEWS) * self._motion if self._motion.any() else new)
