"""The method: LoD-Loc v2's grid finds the neighbourhood, outlines aligned by least squares the pose."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input
from lodbench.datasets.priors import UniformPrior
from lodbench.datasets.query import Query
from lodbench.errors import QueryFault
from lodbench.geometry.pose_vector import pose_from_vector
from lodbench.methods.contour_alignment.alignment import Aligner
from lodbench.methods.contour_alignment.expected_map import expected_map
from lodbench.methods.contour_alignment.params import Params
from lodbench.methods.contour_alignment.refinement import refine
from lodbench.methods.contour_alignment.starts import find_starts
from lodbench.methods.contour_alignment.uncertainty import among_rivals, answer_of, beyond_range
from lodbench.methods.protocol import Estimate, Streams

Floats = NDArray[np.float64]


class ContourAlignment:
    """Finds all six numbers of a pose, and says how sure it is. Draws no random numbers."""

    params_type = Params
    name = "contour_alignment"
    requires = frozenset({Input.MASK})

    def __init__(self, params: Params | None = None) -> None:
        self.params = params or Params()

    def params_for_prior(self, prior: UniformPrior) -> Params:
        """Returns the parameters that search all that such a prior leaves open, tilt included."""
        return self.params.for_prior(prior)

    def params_for_true_tilt(self) -> Params:
        """Returns the parameters for priors of the true pitch and roll: a range of 0 holds them."""
        return replace(self.params, range_tilt_deg=0.0)

    def localize(self, query: Query, city_map: CityMap, streams: Streams) -> Estimate:
        """Returns the pose whose outline fits the mask's best under the prior.

        Raises:
            QueryFault: The mask is empty, or no hypothesis overlaps it or shows an outline.
        """
        started, params = time.perf_counter(), self.params.with_lens(query.lens_percent)
        city_map = expected_map(city_map, params.pitched_lower_m)
        aligner = Aligner(query, city_map, params)
        starts, best = find_starts(query, city_map, aligner, params.over(aligner.pixels_per_m()))
        selected = time.perf_counter()
        ends, trace = self._align(aligner, starts)
        refined = refine(aligner, ends[int(np.argmax(trace))], params)
        if refined is None:
            raise QueryFault("no outline of a building is in view of the aligned pose")
        answer = among_rivals(answer_of(refined), ends, np.array(trace))
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
                aligner.offset(np.append(answer.vector, 0.0))[:6],
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
