"""From the best pose to the answer: the mean of what the photo leaves, roofs that err alike, lines."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Query
from lodbench.geometry import Camera
from lodbench.methods.protocol import Streams
from lodbench.methods.region.averaging import posterior_mean
from lodbench.methods.region.evidence import PhotoFit
from lodbench.methods.region.lines import aligned_by_lines
from lodbench.methods.region.map_errors import covariance_under_map_errors
from lodbench.methods.region.params import Params
from lodbench.methods.region.roofs import RaisedRoofs, RoofEvidence
from lodbench.methods.region.search import Surroundings
from lodbench.methods.region.trust import NO_LINES, TYPICAL_LINES
from lodbench.methods.region.uncertainty import information_at

Floats = NDArray[np.float64]
Nats = Callable[[Floats], Floats]


class Answer(NamedTuple):
    """A pose, (6,), and what tells how far to trust it.

    Attributes:
        vector: (6,) the mean of the poses around the best one, or by lines around theirs.
        covariance: (6, 6) of the answer's error.
        if_map_is_right: (6, 6) the same if the map had no errors.
        apart_m: How far the place by the model's lines is from that by regions and outlines.
        sharpness: How sharply the photo's edges fall off beside those lines.
    """

    vector: Floats
    covariance: Floats
    if_map_is_right: Floats
    apart_m: float
    sharpness: float


class Answering:
    """Ends the search for one photo.

    Vectors of seven numbers are a pose and how much higher than in the map all roofs are.

    Args:
        photo: As of ``read_picture``.
        query: The query.
        roofs: The map around it.
        around: How the outline moves.
        params: The method's.
    """

    def __init__(
        self,
        photo: NDArray[np.uint8],
        query: Query,
        roofs: RaisedRoofs,
        around: Surroundings,
        params: Params,
    ) -> None:
        self._photo, self._query, self._roofs = photo, query, roofs
        self._around, self._params = around, params
        fit = PhotoFit(photo, working_size(query.camera, params.fine_width), params, is_coarse=False)
        self._fine = RoofEvidence(query, roofs, fit, params)
        # Lines say what edges say, and more: the regions join them without.
        self._regions = RoofEvidence(query, roofs, fit.with_edges(0.0), params)

    def answer(self, best: Floats, streams: Streams) -> Answer:
        """Returns the answer near the best pose, (6,): by lines where edges are sharp beside them."""
        params, start = self._params, np.append(best, 0.0)
        covariance, if_map_is_right = self._certainty(self._fine.nats, start)
        mean = start
        if params.mean_pixels > 0:
            size = working_size(self._query.camera, params.mean_width)
            wide = RoofEvidence(self._query, self._roofs, PhotoFit(self._photo, size, params, False), params)
            mean = self._mean(wide.nats, start, covariance)
        by_regions = Answer(mean[:6], covariance, if_map_is_right, *TYPICAL_LINES)
        if params.lines_weight <= 0:
            return by_regions
        of_photo = self._photo, self._query, self._roofs
        lines = aligned_by_lines(*of_photo, mean, self._regions, self._around, params, streams)
        if lines is None:
            return by_regions._replace(apart_m=NO_LINES[0], sharpness=NO_LINES[1])
        apart_m = float(np.linalg.norm((lines.vector - mean)[:3]))
        if lines.sharpness < params.least_sharpness:
            return by_regions._replace(apart_m=apart_m, sharpness=lines.sharpness)
        covariance, if_map_is_right = self._certainty(lines.nats, lines.vector)
        mean = lines.vector
        if params.mean_pixels > 0:
            mean = self._mean(lines.nats, mean, covariance)
        return Answer(mean[:6], covariance, if_map_is_right, apart_m, lines.sharpness)

    def _certainty(self, nats: Nats, vector: Floats) -> tuple[Floats, Floats]:
        """Returns the covariance (6, 6) of an answer's error, and the same if the map had none."""
        pose, evidence = vector[:6], self._fine.at(float(vector[6]))

        def of_poses(poses: Floats) -> Floats:
            return nats(np.column_stack([poses, np.full(len(poses), vector[6])]))

        information = information_at(of_poses, pose, evidence, self._around)
        prior, outline = evidence.prior_information(), self._around.outline(pose, evidence)
        covariance = covariance_under_map_errors(information, prior, outline)
        return covariance, np.asarray(np.linalg.inv(information + prior))

    def _mean(self, nats: Nats, vector: Floats, covariance: Floats) -> Floats:
        share, spread = self._params.mean_share(), self._fine.widened(covariance)
        return posterior_mean(nats, self._fine.log_prior, share, vector, spread)


def working_size(camera: Camera, width: int) -> tuple[int, int]:
    """Returns a width and the height that keeps the photo's aspect; never more than the photo has."""
    width = min(width, camera.width)
    return width, max(1, round(width * camera.height / camera.width))
