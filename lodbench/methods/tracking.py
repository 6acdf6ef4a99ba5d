"""Frames of a video one after the other: each starts from the last pose and motion (docs/adr/0014, point 14).

Outlines are aligned from where the last motion leads; a lost camera is searched for.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault, require_numbers
from lodbench.estimation.outline_alignment import Aligner
from lodbench.estimation.probability import probability_within
from lodbench.geometry import Camera, Pose
from lodbench.geometry.pose_vector import pose_from_vector, vector_from_pose
from lodbench.methods.contour_alignment import ContourAlignment, ContourAlignmentParams
from lodbench.storage import random_stream

Floats = NDArray[np.float64]

# Frames that a frame's overlap is compared with, and the share of the last motion in the estimated one.
_REMEMBERED, _NEWS = 10, 0.6
# The kernel's last scale, pixels of the fine size.
_NEAR_PX = 4.0
# Motion is not carried on over more seconds than this: a drone turns at the end of its line.
_LONGEST_S = 2.0

TRACKED, FOUND, LOST = "tracked", "found again", "lost"


@dataclass(frozen=True, slots=True)
class TrackingParams:
    """The settings of ``lodbench track``.

    Attributes:
        fine_size: Width and height of masks whose outlines are aligned last, pixels; half of it before.
        steps: Alignment steps on masks of half the size.
        final_steps: And at full size.
        reach_px: How far outlines may lie apart in the first step, pixels of the fine size.
        speed_m: How far a frame may be from where the motion leads, metres per second of time between.
        turn_deg: The same of its angles, degrees per second.
        still_m: The same however short the time is, metres.
        still_deg: Likewise, degrees.
        fit: A frame is lost whose silhouette and mask overlap by less than this share of what the last
            frames did.
        least_iou: And whose overlap is less than this in any case.
        search_m: Full width of the search for a lost camera, metres; half more with each frame that is.
        search_deg: The same of its heading, degrees.
        most_m: The widest search.
    """

    fine_size: tuple[int, int] = (602, 448)
    steps: int = 5
    final_steps: int = 2
    reach_px: float = 24.0
    speed_m: float = 3.0
    turn_deg: float = 15.0
    still_m: float = 0.5
    still_deg: float = 1.0
    fit: float = 0.75
    least_iou: float = 0.4
    search_m: float = 20.0
    search_deg: float = 20.0
    most_m: float = 120.0

    def __post_init__(self) -> None:
        require_numbers(self, "track", self.__slots__[1:], 0, ends="(]")  # all but the size

    def photo(self, seconds: float) -> ContourAlignmentParams:
        """Returns the parameters by which a frame is aligned, so many seconds after the last."""
        place = 2.0 * (self.still_m + self.speed_m * seconds)
        turn = 2.0 * (self.still_deg + self.turn_deg * seconds)
        return self._photo(place, turn, min(turn, 4.0))

    def search(self, lost: int) -> ContourAlignmentParams:
        """Returns the parameters by which a camera is searched that was lost for so many frames."""
        # Beyond some 1750 frames the power is no number any more.
        place = min(self.search_m * 1.5 ** min(max(0, lost - 1), 100), self.most_m)
        return self._photo(place, self.search_deg, 4.0)

    def _photo(self, place_m: float, turn_deg: float, tilt_deg: float) -> ContourAlignmentParams:
        return replace(
            ContourAlignmentParams(),
            pitched_lower_m=0.0,
            fine_size=self.fine_size,
            range_x_m=place_m,
            range_y_m=place_m,
            range_z_m=place_m,
            range_yaw_deg=turn_deg,
            range_tilt_deg=tilt_deg,
            reach_px=self.reach_px,
            steps=self.steps,
        )


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
        probability: Of being within (2 m, 2 deg), by one frame alone; 0 for a camera that is lost.
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
            for frames that are searched for: those that follow another are aligned with the lens as declared.
    """

    def __init__(
        self,
        city_map: CityMap,
        camera: Camera,
        start: Pose,
        params: TrackingParams | None = None,
        lens_percent: float | None = None,
    ) -> None:
        self._map, self._camera, self.params = city_map, camera, params or TrackingParams()
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
            found = self._searched(frame, self._vector, ContourAlignmentParams())
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
        model = self.params.photo(seconds).outline_model()
        aligner = Aligner(self._query(frame, predicted), self._map, model)
        best = self._steps(aligner, predicted)
        if best.iou < self._least() and np.abs(self._motion).max() > 0:
            again = self._steps(aligner, self._vector)
            if again.iou > best.iou:
                return again
        return best

    def _steps(self, aligner: Aligner, start: Floats) -> _Place:
        size, params = self.params.fine_size, self.params
        reaches = np.geomspace(params.reach_px, _NEAR_PX, params.steps)
        half = max(8, size[0] // 2), max(8, size[1] // 2)
        vector = aligner.align(np.append(start, 0.0), tuple(map(float, reaches)), half)
        vector = aligner.align(vector, (_NEAR_PX,) * params.final_steps, size)
        here = aligner.linearize(vector, _NEAR_PX, size)
        if here is None:
            return _Place(vector[:6], 0.0)
        covariance = np.asarray(np.linalg.inv(here.posterior.information))[:6, :6]
        return _Place(vector[:6], here.iou, covariance, probability_within(covariance, vector[:6]))

    def _searched(self, frame: Frame, around: Floats, params: ContourAlignmentParams) -> _Place:
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
