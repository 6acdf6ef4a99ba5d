"""The method: LoD-Loc v2's grid finds the neighbourhood, outlines aligned by least squares the pose."""

from __future__ import annotations

import time
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymap.city_map import corrected_map
from lodbench.citymap.laser import range_log_densities
from lodbench.citymodel.extrude import pitched_blocks
from lodbench.datasets.inputs import Input
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.estimation.outline_alignment import Aligner
from lodbench.estimation.state_vector import beyond_range
from lodbench.geometry import PoseGrid
from lodbench.geometry.pose import pose_from_vector
from lodbench.methods.contour_alignment.hypotheses import RIVAL_IOU, among_rivals, answer_of, refine
from lodbench.methods.contour_alignment.params import ContourAlignmentParams
from lodbench.methods.fits import PoseScorer, nothing_fits
from lodbench.methods.protocol import Estimate, Streams

# Of every map once; None where it stays as it is, since a map that holds itself is never freed.
_EXPECTED: WeakKeyDictionary[CityMap, dict[float, CityMap | None]] = WeakKeyDictionary()


def expected_map(city_map: CityMap, pitched_lower_m: float) -> CityMap:
    """Returns the map with blocks of pitched roofs so much lower, metres; made once."""
    if pitched_lower_m == 0 or city_map.scene.pitched is None:
        return city_map
    known = _EXPECTED.setdefault(city_map, {})
    if pitched_lower_m not in known:
        heights_m = np.where(pitched_blocks(city_map.scene), -pitched_lower_m, 0.0)
        drawn, _ = corrected_map(city_map, heights_m, least_m=0.0)
        known[pitched_lower_m] = None if drawn is city_map else drawn
    return known[pitched_lower_m] or city_map


Floats = NDArray[np.float64]


def find_starts(
    query: Query, city_map: CityMap, aligner: Aligner, params: ContourAlignmentParams
) -> tuple[Floats, float]:
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


def _apart(vectors: Floats, scores: Floats, params: ContourAlignmentParams) -> list[int]:
    """Returns the best few of some poses, best first, none within a few metres of a better one."""
    chosen: list[int] = []
    for i in np.argsort(-scores, kind="stable"):
        gaps = np.linalg.norm(vectors[chosen, :3] - vectors[i, :3], axis=1)
        if (gaps > 0.2 * params.basin_stride_m).all():
            chosen.append(int(i))
        if len(chosen) == params.starts:
            break
    return chosen


class ContourAlignment:
    """Finds all six numbers of a pose, and says how sure it is. Draws no random numbers."""

    params_type = ContourAlignmentParams
    name = "contour_alignment"
    requires = frozenset({Input.MASK})

    def __init__(self, params: ContourAlignmentParams | None = None) -> None:
        self.params = params or ContourAlignmentParams()

    def params_for_prior(self, prior: UniformPrior) -> ContourAlignmentParams:
        """Returns the parameters that search all that such a prior leaves open, tilt included."""
        return self.params.for_prior(prior)

    def params_for_true_tilt(self) -> ContourAlignmentParams:
        """Returns the parameters for priors of the true pitch and roll: a range of 0 holds them."""
        return replace(self.params, range_tilt_deg=0.0)

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the pose whose outline fits the mask's best under the prior.

        Raises:
            QueryFault: The mask is empty, or no hypothesis overlaps it or shows an outline.
        """
        started = time.perf_counter()
        params = self.params.with_lens(query.lens_percent).over_measured(query.measured)
        city_map = expected_map(city_map, params.pitched_lower_m)
        aligner = Aligner(query, city_map, params.outline_model(query.measured))
        scale = aligner.pixels_per_m(0.5 * params.range_z_m)
        starts, best = find_starts(query, city_map, aligner, params.over(scale))
        selected = time.perf_counter()
        ends, trace = self._align(aligner, starts)
        ranges = range_log_densities(query, city_map, ends)
        refined = refine(aligner, ends[int(np.argmax(np.array(trace) + RIVAL_IOU * ranges))], params)
        if refined is None:
            raise QueryFault("no outline of a building is in view of the aligned pose")
        answer = among_rivals(answer_of(refined), ends, np.array(trace), ranges)
        finished = time.perf_counter()
        return Estimate(
            pose=pose_from_vector(answer.vector),
            score=refined.overlap,
            seconds={"coarse": selected - started, "fine": finished - selected},
            trace={"coarse": (best,), "fine": trace},
            covariance=answer.covariance,
            probability=answer.probability,
            alternatives=answer.alternatives,
            alternative_probabilities=answer.alternative_probabilities,
            notes=beyond_range(
                aligner.prior.offsets(np.append(answer.vector, 0.0))[:6],
                answer.covariance,
                params.half_widths(),
            ),
        )

    def _align(self, aligner: Aligner, starts: Floats) -> tuple[Floats, tuple[float, ...]]:
        """Returns the starts, aligned, (N, 7), and the IoU of each."""
        width, height = self.params.fine_size
        half = max(8, width // 2), max(8, height // 2)
        aligned = [aligner.align(start, self.params.reaches_px(), half) for start in starts]
        here = [aligner.linearize(vector, self.params.near_px, self.params.fine_size) for vector in aligned]
        ious = [at.iou if at else 0.0 for at in here]
        if max(ious) <= 0:
            raise QueryFault("no outline of a building is in view of any aligned pose")
        return np.array(aligned), tuple(ious)
