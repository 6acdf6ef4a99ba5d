"""Roofs as cross-sections: a line of heights from one eave to the other.

A new shape is a function that returns a ``Roof``, a line in ``ROOF_SHAPES`` for what all of them have in
common, and a place that builds it: ``fittings`` or ``landmarks``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np


class RoofShape(NamedTuple):
    """What all roofs of a shape have in common."""

    code: str  # of bldg:roofType in the LoD2 profile of the German surveying authorities
    has_chimneys: bool  # whether chimneys stand on it
    has_dormers: bool  # whether its slopes are steep and wide enough for dormers


ROOF_SHAPES = {
    "flat": RoofShape("1000", False, False),
    "shed": RoofShape("2100", False, False),
    "gabled": RoofShape("3100", True, True),
    "hipped": RoofShape("3200", True, True),
    "half-hipped": RoofShape("3300", True, False),
    "mansard": RoofShape("3400", True, True),
    "pavilion": RoofShape("3500", False, False),
    "serrated": RoofShape("3800", False, False),
}
_HALF_HIP_FROM = 0.55  # share of the rise below half hips


class Roof(NamedTuple):
    """The cross-section of a roof, and how its ends are closed."""

    name: str  # of its shape, one of ``ROOF_SHAPES``
    # (share of the way across, height above the base in metres) from eave to eave.
    profile: tuple[tuple[float, float], ...]
    # How far the ridge stops short of the first and last end; 0 is a gable.
    hips_m: tuple[float, float] = (0.0, 0.0)
    # At which share of the rise hips begin: 0 at the eaves, above that below them is a gable.
    hip_from: float = 0.0

    @property
    def shape(self) -> RoofShape:
        """What it has in common with its like."""
        return ROOF_SHAPES[self.name]

    @property
    def eave_m(self) -> float:
        """Lowest height of the roof above the base."""
        return min(height for _, height in self.profile)

    def height_at(self, share: float) -> float:
        """Returns the height above the base at a share of the way across, hips left aside."""
        shares, heights = zip(*self.profile, strict=True)
        return float(np.interp(share, shares, heights))

    def lowered(self, by_m: float) -> Roof:
        """Returns the same roof over lower walls."""
        return self._replace(profile=tuple((share, height - by_m) for share, height in self.profile))

    @property
    def ridge_m(self) -> float:
        """Greatest height of the roof above the base."""
        return max(height for _, height in self.profile)


def flat(height_m: float) -> Roof:
    """Returns a flat roof."""
    return Roof("flat", ((0.0, height_m), (1.0, height_m)))


def gabled(eave_m: float, pitch_deg: float, depth_m: float, ridge_at: float = 0.5) -> Roof:
    """Returns a roof whose steeper side has a pitch, over a body of a depth."""
    rise = min(ridge_at, 1 - ridge_at) * depth_m * math.tan(math.radians(pitch_deg))
    return Roof("gabled", ((0.0, eave_m), (ridge_at, eave_m + rise), (1.0, eave_m)))


def hipped(
    eave_m: float, pitch_deg: float, depth_m: float, length_m: float, ends: tuple[bool, bool] = (True, True)
) -> Roof:
    """Returns a roof with equal pitch all round; a pavilion (tent) roof where the ridge is a point."""
    ridge = gabled(eave_m, pitch_deg, depth_m)
    hip = min(depth_m / 2, length_m / 2)
    name = "pavilion" if all(ends) and length_m - 2 * hip < 0.05 else "hipped"
    return Roof(name, ridge.profile, (hip if ends[0] else 0.0, hip if ends[1] else 0.0))


def half_hipped(roof: Roof, depth_m: float) -> Roof:
    """Returns a gabled roof, its ridge in the middle, with both gables cut off near the top."""
    hip = 0.45 * (1 - _HALF_HIP_FROM) * depth_m
    return Roof("half-hipped", roof.profile, (hip, hip), _HALF_HIP_FROM)


def shed(eave_m: float, pitch_deg: float, depth_m: float) -> Roof:
    """Returns a roof of one slope that rises from the outer side."""
    return Roof("shed", ((0.0, eave_m), (1.0, eave_m + depth_m * math.tan(math.radians(pitch_deg)))))


def mansard(eave_m: float, depth_m: float) -> Roof:
    """Returns a roof with a steep lower and a shallow upper part."""
    lower, upper = 1.4, depth_m / 2 - 1.4
    knee, ridge = eave_m + 2.6, eave_m + 2.6 + upper * math.tan(math.radians(22))
    share = lower / depth_m
    return Roof("mansard", ((0.0, eave_m), (share, knee), (0.5, ridge), (1 - share, knee), (1.0, eave_m)))


def serrated(eave_m: float, rise_m: float, count: int) -> Roof:
    """Returns a row of low gables side by side, as over factory halls."""
    profile = [(k / (2 * count), eave_m + (rise_m if k % 2 else 0.0)) for k in range(2 * count + 1)]
    return Roof("serrated", tuple(profile))
