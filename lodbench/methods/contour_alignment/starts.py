"""Where alignment starts: the best samples of a grid, or the basins of a wider one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.geometry import PoseGrid
from lodbench.methods.contour_alignment.alignment import Aligner
from lodbench.methods.contour_alignment.params import Params
from lodbench.methods.fits import nothing_fits
from lodbench.methods.lodlocv2.method import PoseScorer

Floats = NDArray[np.float64]


def find_starts(query: Query, city_map: CityMap, aligner: Aligner, params: Params) -> tuple[Floats, float]:
    """Returns the poses to align, (N, 6) best first, and the best IoU.

    Raises:
        QueryFault: The mask is empty, or no hypothesis overlaps it.
    """
    if not params.searches_basins():
        return _best_samples(query, city_map, params.grid(), params.coarse_size, params.starts)
    size = max(8, params.fine_size[0] // 4), max(8, params.fine_size[1] // 4)
    grid = params.basin_grid()
    kept = max(params.starts, round(params.basin_share * len(grid)))
    samples, _ = _best_samples(query, city_map, grid, size, kept)
    basins = [aligner.align(sample, params.basin_reaches_px(), size) for sample in samples]
    here = [aligner.linearize(basin, params.reach_px, size) for basin in basins]
    ious = np.array([at.iou if at else 0.0 for at in here])
    chosen = _apart(np.array(basins), ious, params)
    return np.array(basins)[chosen], float(ious[chosen[0]])


def _best_samples(
    query: Query, city_map: CityMap, grid: PoseGrid, size: tuple[int, int], count: int
) -> tuple[Floats, float]:
    """Returns the best poses of a grid, (N, 6), and the best IoU."""
    score = PoseScorer(query, city_map, size)
    particles = score(*grid.around(query.prior))
    order = np.argsort(-particles.scores, kind="stable")[:count]
    best = float(particles.scores[order[0]])
    if best <= 0:
        raise nothing_fits("no hypothesis overlaps the mask")
    tilt = np.broadcast_to([score.pitch_deg, score.roll_deg], (len(order), 2))
    lens = np.zeros(len(order))
    return np.column_stack([particles.centers[order], tilt, particles.yaws_deg[order], lens]), best


def _apart(vectors: Floats, scores: Floats, params: Params) -> list[int]:
    """Returns the best few of some poses, best first, none within a few metres of a better one."""
    chosen: list[int] = []
    for i in np.argsort(-scores, kind="stable"):
        gaps = np.linalg.norm(vectors[chosen, :3] - vectors[i, :3], axis=1)
        if (gaps > 0.2 * params.basin_stride_m).all():
            chosen.append(int(i))
        if len(chosen) == params.starts:
            break
    return chosen
