"""Frames of a video one after the other: each starts from the last pose and motion (docs/adr/0014, point 14).

Outlines are aligned from where the last motion leads; a lost camera is searched for. Of a frame in which it
is lost the answer is where the motion leads, with probability 0 and the note ``LOST``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault, require_numbers
from lodbench.estimation.outline_alignment import Aligner
from lodbench.estimation.state_vector import probability_within
from lodbench.geometry import Pose
from lodbench.geometry.pose import pose_from_vector, vector_from_pose
from lodbench.methods.contour_alignment import ContourAlignment, ContourAlignmentParams
from lodbench.methods.fits import set_sizes
from lodbench.methods.protocol import Estimate, FlightEstimate, Streams

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
    """The settings of tracking.

    Attributes:
        name: Of the method.
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

    name: str = "tracking"
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
        set_sizes(self, ("fine_size",), least_px=8)
        require_numbers(self, "method", self.__slots__[2:], 0, ends="(]")  # all but name and size

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
class _TrackedPose:
    """Where a frame may have been taken: (6,) its pose, the IoU there, the covariance, and how likely."""

    vector: Floats
    iou: float
    covariance: Floats | None = None
    probability: float = 0.0


class Tracking:
    """The method: a sequence is followed from its first photo's prior, which may be off as a drone's sensors.

    Of the photos that follow, priors are not used. Where nobody says when each of them was taken, they are a
    second apart.
    """

    name = "tracking"
    params_type = TrackingParams
    requires = frozenset({"mask"})

    def __init__(self, params: TrackingParams | None = None) -> None:
        self.params = params or TrackingParams()

    def begin(self, first: Query, city_map: CityMap) -> Tracker:
        """Returns what answers a sequence."""
        return Tracker(city_map, first.prior, self.params)

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the pose of a sequence of one photo.

        Raises:
            QueryFault: Its mask holds no building.
        """
        if not (query.mask >= 0.5).any():
            raise QueryFault("the mask holds no building")
        return self.begin(query, city_map).next(query, streams)

    def localize_flight(
        self, queries: Sequence[Query], city_map: CityMap, streams: Sequence[Streams]
    ) -> FlightEstimate:
        """Returns the poses of a sequence whose photos are all there."""
        tracker = self.begin(queries[0], city_map)
        if any(query.time_s is None for query in queries):
            queries = [replace(query, time_s=float(k)) for k, query in enumerate(queries)]
        return FlightEstimate([tracker.next(*each) for each in zip(queries, streams, strict=True)])


class Tracker:
    """Poses of frames in the order they were taken.

    Args:
        city_map: The map.
        start: Rough pose of the first frame, scene frame.
        params: How.
    """

    def __init__(self, city_map: CityMap, start: Pose, params: TrackingParams) -> None:
        self._map, self.params = city_map, params
        self._vector: Floats = vector_from_pose(start)
        self._motion: Floats = np.zeros(6)
        self._time_s: float | None = None
        self._ious: deque[float] = deque(maxlen=_REMEMBERED)
        self._lost = 0
        self._count = 0

    def next(self, query: Query, streams: Streams) -> Estimate:
        """Returns where the camera was; it is lost where nothing near fits as well as the last frames did."""
        if query.time_s is None:
            query = replace(query, time_s=float(self._count))
        self._count += 1
        if not (query.mask >= 0.5).any():
            return self._keep(query, _TrackedPose(self._predicted(query), 0.0), LOST)
        if self._time_s is None:
            candidate = self._searched(query, self._vector, ContourAlignmentParams(), streams)
            return self._keep(query, candidate, TRACKED if candidate.iou >= self.params.least_iou else LOST)
        predicted = self._predicted(query)
        if not self._lost:
            candidate = self._aligned(query, predicted)
            if candidate.iou >= self._least():
                return self._keep(query, candidate, TRACKED)
        candidate = self._searched(query, predicted, self.params.search(self._lost + 1), streams)
        if candidate.iou >= self._least():
            return self._keep(query, candidate, FOUND)
        return self._keep(query, _TrackedPose(predicted, candidate.iou), LOST)

    def _predicted(self, query: Query) -> Floats:
        seconds = 0.0 if self._time_s is None else _time_of(query) - self._time_s
        return np.asarray(self._vector + self._motion * min(max(seconds, 0.0), _LONGEST_S))

    def _least(self) -> float:
        """Returns the least overlap of a frame that is not lost."""
        usual = float(np.median(self._ious)) if self._ious else 0.0
        return max(self.params.least_iou, self.params.fit * usual)

    def _aligned(self, query: Query, predicted: Floats) -> _TrackedPose:
        """Returns the place that outlines lead to from where the motion leads.

        Should they lead nowhere, they start again from the last pose: the motion may have ended.
        """
        seconds = max(_time_of(query) - (self._time_s or 0.0), 0.0)
        model = self.params.photo(seconds).outline_model()
        aligner = Aligner(_from(query, predicted), self._map, model)
        best = self._steps(aligner, predicted)
        if best.iou < self._least() and np.abs(self._motion).max() > 0:
            again = self._steps(aligner, self._vector)
            if again.iou > best.iou:
                return again
        return best

    def _steps(self, aligner: Aligner, start: Floats) -> _TrackedPose:
        size, params = self.params.fine_size, self.params
        reaches = np.geomspace(params.reach_px, _NEAR_PX, params.steps)
        half = max(8, size[0] // 2), max(8, size[1] // 2)
        vector = aligner.align(np.append(start, 0.0), tuple(map(float, reaches)), half)
        vector = aligner.align(vector, (_NEAR_PX,) * params.final_steps, size)
        here = aligner.linearize(vector, _NEAR_PX, size)
        if here is None:
            return _TrackedPose(vector[:6], 0.0)
        covariance = np.asarray(np.linalg.inv(here.posterior.information))[:6, :6]
        return _TrackedPose(vector[:6], here.iou, covariance, probability_within(covariance, vector[:6]))

    def _searched(
        self, query: Query, start: Floats, params: ContourAlignmentParams, streams: Streams
    ) -> _TrackedPose:
        """Returns the best place within a search; its IoU is 0 where none fits."""
        try:
            estimate = ContourAlignment(params).localize(_from(query, start), self._map, streams)
        except QueryFault:
            return _TrackedPose(start, 0.0)
        vector, probability = vector_from_pose(estimate.pose), estimate.probability or 0.0
        return _TrackedPose(vector, float(estimate.score), estimate.covariance, probability)

    def _keep(self, query: Query, tracked: _TrackedPose, state: str) -> Estimate:
        """Remembers what became of a frame, and returns it."""
        if state == LOST:
            self._lost += 1
        else:
            self._motion = self._motion_to(query, tracked.vector) if state == TRACKED else np.zeros(6)
            self._lost = 0
            self._ious.append(tracked.iou)
            self._vector = tracked.vector
            self._time_s = _time_of(query)
        # One frame says how sure it is by itself: nothing of it is calibrated.
        known = (None, 0.0) if state == LOST else (tracked.covariance, tracked.probability)
        return Estimate(
            pose_from_vector(tracked.vector),
            tracked.iou,
            covariance=known[0],
            probability=known[1],
            notes=() if state == TRACKED else (state,),
            is_assessed=True,
        )

    def _motion_to(self, query: Query, vector: Floats) -> Floats:
        """Returns the motion per second, (6,), after a frame was tracked."""
        if self._time_s is None or _time_of(query) <= self._time_s:
            return np.zeros(6)
        step = vector - self._vector
        step[3:] = (step[3:] + 180.0) % 360.0 - 180.0
        new = step / (_time_of(query) - self._time_s)
        return np.asarray(_NEWS * new + (1.0 - _NEWS) * self._motion if self._motion.any() else new)


def state_of(estimate: Estimate) -> str:
    """Returns what became of a frame: ``TRACKED``, ``FOUND`` or ``LOST``."""
    return estimate.notes[0] if estimate.notes else TRACKED


def _from(query: Query, vector: Floats) -> Query:
    """Returns a query whose search starts elsewhere; frames that follow another have the lens as declared."""
    return replace(query, prior=pose_from_vector(vector))


def _time_of(query: Query) -> float:
    return query.time_s or 0.0
