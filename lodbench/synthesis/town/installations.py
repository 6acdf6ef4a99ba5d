"""Chimneys and balconies: bodies of their own that level of detail 3 adds to a building."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.model import SurfaceKind
from lodbench.synthesis.town.extrusion import Strip, wing_direction
from lodbench.synthesis.town.fittings import chance
from lodbench.synthesis.town.roofs import Roof
from lodbench.synthesis.town.shapes import left_of
from lodbench.synthesis.town.solid import Solid, prism

Points = NDArray[np.float64]

_SUNK_M = 0.6  # how deep a chimney reaches into the roof


def chimneys(strip: Strip, roof: Roof, base_m: float, generator: np.random.Generator) -> list[Solid]:
    """Returns chimneys near the ridge of the first wing, if the roof is of a shape that has them."""
    if not roof.shape.has_chimneys:
        return []
    along, across, length = wing_direction(strip, 0)
    depth = float(abs((strip.inner[0] - strip.outer[0]) @ across))
    stacks = []
    for _ in range(1 + chance(generator, 0.35)):
        share = float(np.clip(0.5 + generator.choice([-1.0, 1.0]) * generator.uniform(0.04, 0.16), 0.2, 0.8))
        room = max(roof.hips_m) + 1.0
        at = float(generator.uniform(room, max(length - room, room + 0.1)))
        width, breadth = generator.uniform((0.5, 0.5), (0.9, 1.3)).tolist()
        top = roof.ridge_m + float(generator.uniform(0.5, 1.1))
        if at + 0.5 * breadth > length - 0.3:
            continue
        middle = strip.outer[0] + along * at + across * share * depth
        ring = _rectangle(middle, along, breadth, width)
        low = base_m + roof.height_at(share) - _SUNK_M
        stacks.append(prism([ring], low, base_m + top, SurfaceKind.INSTALLATION))
    return stacks


def balconies(windows: list[Points], generator: np.random.Generator) -> list[Solid]:
    """Returns balconies before every other column of windows above the ground floor.

    Args:
        windows: (4, 3) corners of each window, lower left first.
        generator: Source of chance.
    """
    if not windows:
        return []
    lows = np.array([window[0, 2] for window in windows])
    phase, depth = int(generator.integers(2)), float(generator.uniform(1.1, 1.6))
    columns: dict[tuple[float, float], int] = {}
    slabs = []
    for window, low in zip(windows, lows, strict=True):
        column = columns.setdefault((round(window[0, 0], 2), round(window[0, 1], 2)), len(columns))
        if column % 2 != phase or low < lows.min() + 1.0:
            continue
        left, right = window[0, :2], window[1, :2]
        along = (right - left) / np.linalg.norm(right - left)
        middle = 0.5 * (left + right) - left_of(along) * (0.5 * depth - 0.04)
        ring = _rectangle(middle, along, float(np.linalg.norm(right - left)) + 1.0, depth)
        floor = float(low) - 0.9
        slabs.append(prism([ring], floor - 0.15, floor + 0.95, SurfaceKind.INSTALLATION))
    return slabs


def _rectangle(middle: Points, along: Points, length: float, width: float) -> Points:
    """Returns a plan rectangle, (4, 2), counter-clockwise."""
    u, v = along * length / 2, left_of(along) * width / 2
    return np.stack([middle - u - v, middle + u - v, middle + u + v, middle - u + v])
