"""Heights of footprints from photos with known poses: roofs are swept from the ground up, then finely.

The first sweep hides nothing behind other buildings, whose heights are not known yet; the later ones draw
every building as high as the sweep before found it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymap.city_map import corrected_map
from lodbench.citymodel.scene import Scene, floors_and_rises
from lodbench.datasets.query import Query
from lodbench.methods.flight.roof_edges import open_pictures
from lodbench.methods.flight.roof_sweep import HEIGHTS_M, RoofCurve, sweep_roofs

Floats = NDArray[np.float64]

# Blocks are this high before anything is known: the least that a map is drawn with, metres.
_LOWEST_M = 2.0
# The first sweep ends here, or lower for roofs that would leave the photos; its step, metres.
_HIGHEST_M, _STEP_M = (60.0, 30.0, 15.0), 0.5
_FINE_SWEEPS = 2
# A first height counts whose neighbourhood, metres, holds so much of the probability.
_NEIGHBOURHOOD_M, _LEAST_SHARE = 4.0, 0.9
# A peak is so wide, metres; standard deviations are not below the first, heights known worse than the second
# are not known.
_PEAK_M, _BEST_SIGMA_M, _WORST_SIGMA_M = 1.0, 0.2, 1.5


class SweptHeight(NamedTuple):
    """The height of a building above its floor, metres, its standard deviation, and photos compared."""

    height_m: float
    sigma_m: float
    photos: int


def footprint_heights(queries: Sequence[Query], scene: Scene) -> dict[int, SweptHeight]:
    """Returns the heights of the blocks that photos measure, by row of the scene.

    Left out are buildings that fewer than three photos show, whose heights remain ambiguous, or whose
    standard deviation is above 1.5 m. Errors that all photos share (scale, common height) are not part of the
    deviations. Eq. (F21), (F22) of docs/methods/flight.md.

    Args:
        queries: The photos, with their poses as priors (scene frame).
        scene: Blocks of level 1 on the right ground; how high they are does not count.
    """
    rises = floors_and_rises(scene)[1]
    poses = [query.prior for query in queries]
    city_map = CityMap(scene)
    flat_map = corrected_map(city_map, _LOWEST_M - rises, 0.0)[0]
    found: dict[int, SweptHeight] = {}
    for highest_m in _HIGHEST_M:
        rising = np.arange(0.0, highest_m - _LOWEST_M + 0.1, _STEP_M)
        curves = sweep_roofs(open_pictures(queries, poses, np.zeros(2)), flat_map, rising)
        for row, curve in curves.items():
            if row not in found and _share_at_peak(curve, rising) >= _LEAST_SHARE:
                found[row] = _height(curve, _LOWEST_M + rising)
        if len(found) == np.count_nonzero(rises > 0):
            break
    for _ in range(_FINE_SWEEPS):
        drawn_m = np.full(len(rises), _LOWEST_M)
        for row, height in found.items():
            drawn_m[row] = max(height.height_m, _LOWEST_M)
        drawn = corrected_map(city_map, drawn_m - rises, 0.0)[0]
        curves = sweep_roofs(open_pictures(queries, poses, np.zeros(2)), drawn)
        found = {
            row: _height(curve, drawn_m[row] + HEIGHTS_M) for row, curve in curves.items() if row in found
        }
    return {row: height for row, height in found.items() if height.sigma_m <= _WORST_SIGMA_M}


def _density(curve: RoofCurve, heights_m: Floats) -> Floats:
    nats = np.where(heights_m >= _LOWEST_M, curve.nats, -np.inf)
    shares = np.exp(nats - nats.max())
    return np.asarray(shares / shares.sum())


def _share_at_peak(curve: RoofCurve, rising_m: Floats) -> float:
    shares = _density(curve, rising_m + _LOWEST_M)
    return float(shares[np.abs(rising_m - rising_m[np.argmax(shares)]) <= _NEIGHBOURHOOD_M].sum())


def _height(curve: RoofCurve, heights_m: Floats) -> SweptHeight:
    """Returns the mean of a curve's peak, and the deviation of its whole density from that."""
    shares = _density(curve, heights_m)
    is_peak = np.abs(heights_m - heights_m[np.argmax(shares)]) <= _PEAK_M
    best = float(shares[is_peak] @ heights_m[is_peak] / shares[is_peak].sum())
    sigma = float(np.sqrt(shares @ (heights_m - best) ** 2))
    return SweptHeight(best, max(sigma, _BEST_SIGMA_M), curve.photos)
