"""How flights go over a place: one function and one line in ``PATHS`` per kind.

Each yields poses in the order they are flown, more than are wanted: those that show too few buildings, or
stand among them, are passed over.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from lodbench.geometry import EulerAngles, Pose
from lodbench.geometry.angles import rotation_from_euler
from lodbench.synthesis.view_sampling import view_of

Floats = NDArray[np.float64]
Path = Callable[[Floats, np.random.Generator, int], Iterator[Pose]]

# How far a pilot or a gust moves the drone off its path (m), and turns it (deg), standard deviations.
_DRIFT_M, _DRIFT_YAW_DEG, _DRIFT_TILT_DEG = 1.0, 1.5, 0.3


def grid(target: Floats, generator: np.random.Generator, count: int) -> Iterator[Pose]:
    """Yields poses of parallel lines there and back, the camera looking ahead and down."""
    height_m, pitch_deg = generator.uniform(100.0, 160.0), generator.uniform(20.0, 45.0)
    heading_deg = generator.uniform(-180.0, 180.0)
    lines = max(2, round(math.sqrt(count)))
    steps = 2 * math.ceil(count / lines)
    for line in range(2 * lines):
        turned = 180.0 if line % 2 else 0.0
        order = range(steps) if line % 2 == 0 else reversed(range(steps))
        for step in order:
            ahead = (step - 0.5 * (steps - 1)) * 0.2 * height_m
            aside = (line - (lines - 0.5)) * 0.3 * height_m
            spot = target + _turned(ahead, aside, heading_deg)
            yield _drifting(spot, height_m, pitch_deg, heading_deg + turned, generator)


def orbit(target: Floats, generator: np.random.Generator, count: int) -> Iterator[Pose]:
    """Yields poses of two circles around a place, which all look at it."""
    height_m, pitch_deg = generator.uniform(100.0, 160.0), generator.uniform(30.0, 60.0)
    first_deg = generator.uniform(-180.0, 180.0)
    for k in range(2 * count):
        yield _drifting(target, height_m, pitch_deg, first_deg + 360.0 * k / count, generator)
        if k == count - 1:
            height_m *= 1.2


def facade(target: Floats, generator: np.random.Generator, count: int) -> Iterator[Pose]:
    """Yields poses of a strip past a row of buildings, which look at them from the side."""
    height_m, pitch_deg = generator.uniform(45.0, 80.0), generator.uniform(55.0, 70.0)
    heading_deg = generator.uniform(-180.0, 180.0)
    for k in range(2 * count):
        aside = (k - 0.5 * (2 * count - 1)) * 0.1 * height_m
        yield _drifting(
            target + _turned(0.0, aside, heading_deg), height_m, pitch_deg, heading_deg, generator
        )


def corridor(target: Floats, generator: np.random.Generator, count: int) -> Iterator[Pose]:
    """Yields poses along a straight line, the camera looking ahead and down."""
    height_m, pitch_deg = generator.uniform(70.0, 120.0), generator.uniform(40.0, 60.0)
    heading_deg = generator.uniform(-180.0, 180.0)
    for k in range(2 * count):
        ahead = (k - 0.5 * (2 * count - 1)) * 0.15 * height_m
        yield _drifting(
            target + _turned(ahead, 0.0, heading_deg), height_m, pitch_deg, heading_deg, generator
        )


PATHS: dict[str, Path] = {"grid": grid, "orbit": orbit, "facade": facade, "corridor": corridor}


def _turned(ahead_m: float, aside_m: float, heading_deg: float) -> Floats:
    """Returns (3,) metres east, north and up of a place ahead and to the right of a heading."""
    # The heading counts from north, counter-clockwise, as yaw does.
    turn = math.radians(heading_deg)
    ahead = np.array([-math.sin(turn), math.cos(turn), 0.0])
    return np.asarray(ahead_m * ahead + aside_m * np.array([ahead[1], -ahead[0], 0.0]))


def _drifting(
    target: Floats, height_m: float, pitch_deg: float, yaw_deg: float, generator: np.random.Generator
) -> Pose:
    """Returns the pose that looks at a place from a height above it, but for what a pilot or a gust does."""
    aimed = view_of(target, height_m, EulerAngles(pitch_deg, 0.0, yaw_deg))
    angles = np.array([pitch_deg, 0.0, yaw_deg])
    angles += generator.normal(0.0, [_DRIFT_TILT_DEG, _DRIFT_TILT_DEG, _DRIFT_YAW_DEG])
    center = aimed.center + generator.normal(0.0, _DRIFT_M, size=3)
    return Pose.from_center(rotation_from_euler(EulerAngles(*map(float, angles))), center)
