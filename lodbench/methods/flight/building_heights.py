"""Heights of buildings against the map and all others: what outlines and what pixels say, together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from lodbench.citymodel.building_boxes import building_boxes
from lodbench.citymodel.scene import Scene
from lodbench.methods.flight.aligning import Aligned
from lodbench.methods.flight.joint import covariance_of
from lodbench.methods.flight.params import Params
from lodbench.methods.flight.roof_sweep import HEIGHTS_M, RoofCurve
from lodbench.methods.flight.state import CONSTANTS, ROOFS

Floats = NDArray[np.float64]

# A height is in doubt where it differs from the others' by so many metres and sigmas; of a building that
# would be lower than this, metres, masks show nothing: whether it is gone is looked at elsewhere.
_DOUBT_M, _DOUBT_SIGMAS, _LOWEST_M = 1.0, 1.7, 2.0
# Heights by pixels are no better than this, metres, and say nothing where they are worse than that.
_BEST_M, _WORST_M = 0.2, 1.0
# Roofs are sharp whose best height is so many nats better than most heights; what all are wrong about alike
# is the median of no fewer.
_SHARP, _FEWEST_SHARP = 1.2, 5
# Around the best height a peak is so wide, metres; however low a building is, its roof is looked for so far
# below the map's.
_PEAK_M, _LOWER_M = 1.0, 1.0
# Outlines are wrong altogether (a tree, a neighbour) this often, and then by so many metres.
_ASTRAY, _ASTRAY_M = 0.05, 4.0
# Pixels have a say where outlines lie within the heights looked at by so many standard deviations.
_BEYOND = 1.0


class BuildingHeight(NamedTuple):
    """By how much a building is higher than the map has it, all others' mean error taken away.

    Attributes:
        higher_m: Metres.
        sigma_m: Its standard deviation.
        photos: Photos whose pixels told, 0 for outlines alone.
        is_in_doubt: Whether the map's height is contradicted.
    """

    higher_m: float
    sigma_m: float
    photos: int
    is_in_doubt: bool


def building_heights(
    aligned: Aligned, curves: Mapping[int, RoofCurve], scene: Scene, params: Params
) -> dict[int, BuildingHeight]:
    """Returns the heights of buildings whose outlines or pixels tell them, by row of the scene.

    Args:
        aligned: Where the flight ended.
        curves: What pixels say of heights; see ``sweep_roofs``.
        scene: The map.
        params: How far heights may be wrong.
    """
    by_outlines = {row: (higher, sigma) for row, higher, sigma in _by_outlines(aligned)}
    rises, common = _rises(scene), _common(curves)
    found = {}
    for row in sorted({*by_outlines, *(curves if common is not None else ())}):
        photos, height = 0, by_outlines.get(row)
        if common is not None and row in curves and _is_sharp(curves[row]):
            lowest = min(_LOWEST_M - float(rises[row]), -_LOWER_M)
            both = _fused(HEIGHTS_M - common, curves[row].nats, height, lowest, params.roof_m)
            if both is not None:
                photos, height = curves[row].photos, both
        if height is not None:
            higher, sigma = height
            found[row] = BuildingHeight(higher, sigma, photos, _is_in_doubt(higher, sigma, float(rises[row])))
    return found


def _fused(
    heights: Floats, nats: Floats, by_outlines: tuple[float, float] | None, lowest: float, roof_m: float
) -> tuple[float, float] | None:
    """Returns the best height, metres, and its standard deviation; None if it is not told."""
    if by_outlines is not None:
        # What outlines place beyond the heights that are looked at is theirs alone.
        reach = np.array([-_BEYOND, _BEYOND]) * by_outlines[1] + by_outlines[0]
        if reach[0] < heights[0] or reach[1] > heights[-1]:
            return by_outlines
    if by_outlines is None:
        beforehand = -np.log1p((heights / roof_m) ** 2)
    else:
        right = norm.pdf(heights, *by_outlines)
        beforehand = np.log((1.0 - _ASTRAY) * right + _ASTRAY * norm.pdf(heights, 0.0, _ASTRAY_M))
    told = np.where(heights >= lowest, nats + beforehand, -np.inf)
    if not np.isfinite(told).any():
        return None
    shares = np.exp(told - told.max())
    shares /= shares.sum()
    peak = np.abs(heights - heights[np.argmax(told)]) <= _PEAK_M
    best = float(shares[peak] @ heights[peak] / shares[peak].sum())
    sigma = max(float(np.sqrt(shares @ (heights - best) ** 2)), _BEST_M)
    return (best, sigma) if sigma < _WORST_M or by_outlines is not None else None


def _common(curves: Mapping[int, RoofCurve]) -> float | None:
    """Returns by how much all roofs are higher than the map as poses have it, metres; None if few tell."""
    sharp = [HEIGHTS_M[np.argmax(curve.nats)] for curve in curves.values() if _is_sharp(curve)]
    return float(np.median(sharp)) if len(sharp) >= _FEWEST_SHARP else None


def _is_sharp(curve: RoofCurve) -> bool:
    return bool(curve.nats.max() - np.median(curve.nats) > _SHARP)


def _is_in_doubt(higher_m: float, sigma_m: float, rise_m: float) -> bool:
    return abs(higher_m) > max(_DOUBT_M, _DOUBT_SIGMAS * sigma_m) and rise_m + higher_m > _LOWEST_M


def _rises(scene: Scene) -> Floats:
    """Returns (B,) how high the map's buildings are, metres; 0 for one without geometry."""
    low, high, building = building_boxes(scene)
    rises = np.zeros(scene.num_buildings)
    rises[building] = (high - low)[:, 2]
    return rises


def _by_outlines(aligned: Aligned) -> Iterator[tuple[int, float, float]]:
    """Yields each building's row, and how much higher its parts are than all roofs, with sigma; metres."""
    state, solution = aligned.state, aligned.as_told
    first = CONSTANTS + len(solution.buildings)
    sums = np.zeros((len(solution.buildings), first + len(state.roofs)))
    sums[:, ROOFS] = -1.0
    for row, building in enumerate(solution.buildings):
        parts = np.flatnonzero(state.roofs.building == building)
        sums[row, first + parts] = 1.0 / len(parts)
    values = np.concatenate([state.constants, state.buildings_m[solution.buildings], state.roofs.heights_m])
    values += (solution.shared_step - aligned.solution.shared_step)[: len(values)]
    sigmas = np.sqrt(np.diag(covariance_of(solution, sums)))
    for building, higher, sigma in zip(solution.buildings, sums @ values, sigmas, strict=True):
        yield int(building), float(higher), float(sigma)
