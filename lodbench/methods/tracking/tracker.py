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
from lodbench.geometry.pose_vector import pose_from_vector, vector_from_pose
from lodbench.methods.contour_alignment import ContourAlignment
from lodbench.methods.contour_alignment.alignment import Aligner
from lodbench.methods.contour_alignment.params import Params as PhotoParams
from lodbench.methods.contour_alignment.uncertainty import probability_within
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
        covariance: (6, 6) of centre (metres) and angles (degrees); None for a camera that is lost.
        probability: Of being within (2 m, 2 deg), as far as one frame tells; 0 for a camera that is lost.
    """

    pose: Pose
    state: str
    score: float
    covariance: Floats | None = None
    probability: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """Where a frame may have been taken: (6,) its pose, the IoU there, the covariance, and how likely."""

    vector: Floats
    iou: float
    covariance: Floats | None = None
    probability: float = 0.0


class Tracker:
    """Poses of frames in the order they were taken.

    Args:
        city_map: The map.
        camera: Pinhole of all frames.
        start: Rough pose of the first frame, scene frame, as wrong as a drone's sensors.
        params: How.
        lens_percent: Standard deviation of the camera's focal length, percent, as of ``Query``;
            for frames that are searched for: those that follow another are aligned with the lens as told.
    """

    def __init__(
        self,
        city_map: CityMap,
        camera: Camera,
        start: Pose,
        params: Params | None = None,
        lens_percent: float | None = None,
    ) -> None:
        self._map, self._camera, self.params = city_map, camera, params or Params()
        self._lens_percent = lens_percent
        self._vector: Floats = vector_from_pose(start)
        self._motion: Floats = np.zeros(6)
        self._time_s: float | None = None
        self._ious: deque[float] = deque(maxlen=_REMEMBERED)
        self._lost = 0

    def track(self, frame: Frame) -> Tracked:
        """Returns where the camera was; it is lost where nothing near fits as well as the last frames did."""
        if not (frame.mask >= 0.5).any():
            return self._keep(frame, _Place(self._predicted(frame), 0.0), LOST)
        if self._time_s is None:
            found = self._searched(frame, self._vector, PhotoParams())
            return self._keep(frame, found, TRACKED if found.iou >= self.params.least_iou else LOST)
        predicted = self._predicted(frame)
        if not self._lost:
            found = self._aligned(frame, predicted)
            if found.iou >= self._least():
                return self._keep(frame, found, TRACKED)
        found = self._searched(frame, predicted, self.params.search(self._lost + 1))
        if found.iou >= self._least():
            return self._keep(frame, found, FOUND)
        return self._keep(frame, _Place(predicted, found.iou), LOST)

    def _predicted(self, frame: Frame) -> Floats:
        seconds = 0.0 if self._time_s is None else frame.time_s - self._time_s
        return np.asarray(self._vector + self._motion * min(max(seconds, 0.0), _LONGEST_S))

    def _least(self) -> float:
        """Returns the least overlap of a frame that is not lost."""
        usual = float(np.median(self._ious)) if self._ious else 0.0
        return max(self.params.least_iou, self.params.fit * usual)

    def _aligned(self, frame: Frame, predicted: Floats) -> _Place:
        """Returns the place that outlines lead to from where the motion leads.

        Should they lead nowhere, they start again from the last pose: the motion may have ended.
        """
        seconds = max(frame.time_s - (self._time_s or 0.0), 0.0)
        aligner = Aligner(self._query(frame, predicted), self._map, self.params.photo(seconds))
        best = self._steps(aligner, predicted)
        if best.iou < self._least() and np.abs(self._motion).max() > 0:
            again = self._steps(aligner, self._vector)
            if again.iou > best.iou:
                return again
        return best

    def _steps(self, aligner: Aligner, start: Floats) -> _Place:
        size, params = self.params.fine_size, self.params
        reaches = np.geomspace(params.reach_px, _NEAR_PX, params.steps)
        vector = aligner.align(np.append(start, 0.0), tuple(map(float, reaches)), half_size(size))
        vector = aligner.align(vector, (_NEAR_PX,) * params.final_steps, size)
        here = aligner.linearize(vector, _NEAR_PX, size)
        if here is None:
            return _Place(vector[:6], 0.0)
        covariance = np.asarray(np.linalg.inv(here.information))[:6, :6]
        return _Place(vector[:6], here.iou, covariance, probability_within(covariance, vector[:6]))

    def _searched(self, frame: Frame, around: Floats, params: PhotoParams) -> _Place:
        """Returns the best place within a search; its IoU is 0 where none fits."""
        streams = partial(random_stream, 0, "track", frame.name)
        try:
            found = ContourAlignment(params).localize(self._query(frame, around), self._map, streams)
        except QueryFault:
            return _Place(around, 0.0)
        vector, probability = vector_from_pose(found.pose), found.probability or 0.0
        return _Place(vector, float(found.score), found.covariance, probability)

    def _query(self, frame: Frame, around: Floats) -> Query:
        prior = pose_from_vector(around)
        return Query(frame.name, "", self._camera, prior, frame.mask, lens_percent=self._lens_percent)

    def _keep(self, frame: Frame, found: _Place, state: str) -> Tracked:
        """Remembers what became of a frame, and returns it."""
        if state == LOST:
            self._lost += 1
        else:
            self._motion = self._motion_to(frame, found.vector) if state == TRACKED else np.zeros(6)
            self._lost = 0
            self._ious.append(found.iou)
            self._vector = found.vector
            self._time_s = frame.time_s
        pose = pose_from_vector(found.vector)
        if state == LOST:
            return Tracked(pose, state, found.iou)
        return Tracked(pose, state, found.iou, found.covariance, found.probability)

    def _motion_to(self, frame: Frame, vector: Floats) -> Floats:
        """Returns the motion per second, (6,), after a frame was tracked."""
        if self._time_s is None or frame.time_s <= self._time_s:
            return np.zeros(6)
        step = vector - self._vector
        step[3:] = (step[3:] + 180.0) % 360.0 - 180.0
        new = step / (frame.time_s - self._time_s)
        return np.asarray(_NEWS * new + (1.0 - _NEWS) * self._motion if self._motion.any() else new)
