"""Where the cameras of training pictures are put: one function and one line in ``CAMERA_PATHS`` per path."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import pairwise, product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.pose_text import read_poses
from lodbench.datasets.priors import UniformPrior
from lodbench.errors import DatasetError
from lodbench.geometry import EulerAngles, Pose
from lodbench.storage import random_stream
from lodbench.synthesis.surroundings.ground import Ground
from lodbench.synthesis.view_sampling import target_near, view_of

if TYPE_CHECKING:
    from lodbench.synthesis.training_data.params import GenerateParams

Floats = NDArray[np.float64]

_YAWS_DEG = tuple(range(0, 360, 45))


class Place(NamedTuple):
    """What a path is laid out over, in the frame of a scene."""

    bases: Floats  # (B, 3) middle of each building's base, local metres
    ground: Ground  # ground heights
    origin: Floats  # (3,) of the frame, coordinates of the city's CRS


def _on_grid(params: GenerateParams, place: Place) -> Iterator[Pose]:
    """Yields the poses of a grid over the buildings, its spacing half the height, as UAVD4L has it."""
    low, high = place.bases[:, :2].min(axis=0), place.bases[:, :2].max(axis=0)
    yaws = params.yaw if params.yaw is not None else _YAWS_DEG
    for height in params.height:
        spacing = params.spacing_m or max(1.0, height // 2)
        axes = [_steps(low[k], high[k], spacing) for k in (0, 1)]
        spots = np.stack([axis.ravel() for axis in np.meshgrid(*axes)], axis=1)
        centers = np.column_stack([spots, place.ground.at(spots) + height])
        for pitch, center, yaw in product(params.pitches_from_nadir(), centers, yaws):
            yield Pose.from_euler(EulerAngles(pitch, 0.0, float(yaw)), center)


def _steps(low: float, high: float, spacing: float) -> Floats:
    """Returns places from end to end, about a spacing apart; the middle if there is room for one."""
    number = max(1, round((high - low) / spacing))
    return np.linspace(low, high, number) if number > 1 else np.array([0.5 * (low + high)])


def _at_random(params: GenerateParams, place: Place) -> Iterator[Pose]:
    """Yields poses that look at places near buildings, from any side."""
    for index in range(params.count):
        generator = random_stream(params.seed, "training", "camera", index)
        yield _looking_at(target_near(place.bases, generator), params, generator)


def _looking_at(target: Floats, params: GenerateParams, generator: np.random.Generator) -> Pose:
    """Returns a pose from any side whose axis meets a target, (3,), at one of the pitches and heights."""
    pitches = params.pitches_from_nadir()
    # A camera that looks at the horizon sees its target from no height: keep the axis finite.
    pitch = min(85.0, pitches[int(generator.integers(len(pitches)))])
    height = params.height[int(generator.integers(len(params.height)))]
    return view_of(target, height, EulerAngles(pitch, 0.0, float(generator.uniform(-180.0, 180.0))))


def _anywhere(params: GenerateParams, place: Place) -> Iterator[Pose]:
    """Yields poses that look at any place of the land, buildings or none: negatives with min_buildings=0."""
    rows, columns = place.ground.heights_m.shape
    size = np.array([columns - 1, rows - 1]) * place.ground.cell_m
    for index in range(params.count):
        generator = random_stream(params.seed, "training", "anywhere", index)
        spot = np.array([place.ground.west, place.ground.south]) + generator.uniform(0.0, size)
        target = np.append(spot, place.ground.at(spot[None])[0])
        yield _looking_at(target, params, generator)


def _around_priors(params: GenerateParams, place: Place) -> Iterator[Pose]:
    """Yields draws around each given pose."""
    errors = UniformPrior(*params.prior_m, *params.prior_deg)
    for number, pose in enumerate(_given(params, place)):
        for draw in range(params.count):
            yield errors.draw(pose, random_stream(params.seed, "training", "prior", number, draw))


def _along_trajectory(params: GenerateParams, place: Place) -> Iterator[Pose]:
    """Yields poses along the straight lines between given centres, at these heights, looking ahead."""
    yaws = params.yaw if params.yaw is not None else (0.0,)
    for start, end in pairwise(pose.center for pose in _given(params, place)):
        way = end - start
        length = float(np.hypot(way[0], way[1]))
        if length == 0.0:
            continue
        ahead = math.degrees(math.atan2(-way[0], way[1]))
        spacing = params.spacing_m or max(1.0, min(params.height) // 2)
        shares = np.arange(0.0, 1.0, min(1.0, spacing / length))
        for share, pitch, yaw in product(shares, params.pitches_from_nadir(), yaws):
            yield Pose.from_euler(EulerAngles(pitch, 0.0, ahead + yaw), start + share * way)


def _given(params: GenerateParams, place: Place) -> list[Pose]:
    """Returns the poses of ``params.poses``, in the scene's frame.

    Raises:
        DatasetError: The file cannot be read or is empty.
    """
    given = [pose.shifted(-place.origin) for pose in read_poses(params.poses or "").values()]
    if not given:
        raise DatasetError(f"{params.poses} has no poses.", "Each line reads: name qw qx qy qz tx ty tz")
    return given


# Each yields poses in the scene's frame, before any is judged.
CAMERA_PATHS: dict[str, Callable[[GenerateParams, Place], Iterator[Pose]]] = {
    "grid": _on_grid,
    "random": _at_random,
    "anywhere": _anywhere,
    "trajectory": _along_trajectory,
    "priors": _around_priors,
}
