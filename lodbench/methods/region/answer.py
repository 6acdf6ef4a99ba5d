"""From the best pose to the answer: the mean of what the photo leaves, roofs that err alike, lines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, TypeGuard

import numpy as np
from numpy.typing import NDArray

from lodbench.estimation.posterior import covariance_under_map_errors, curvature_around, posterior_mean
from lodbench.estimation.state_vector import BESIDE_POSE, CAMERAS, LENS, POSE, POSES, RAISED, ROOFS, TILT
from lodbench.methods.protocol import Streams
from lodbench.methods.region.evidence import StatePosterior
from lodbench.methods.region.line_alignment import LineAligner, LineAlignment
from lodbench.methods.region.params import RegionParams
from lodbench.methods.region.search import Mode, Problem
from lodbench.methods.region.trust import NO_LINES, TYPICAL_LINES, LineFeatures

Floats = NDArray[np.float64]
# How far apart outlines of cameras lie that curvature and mean are of, pixels of the fine size: beyond the
# stairs of single pixels, within the mode.
_APART_PX = 1.5
# How much of the range of tilts an answer has to take for the range to be doubted.
_PULLED = 0.7
# The deviation of a lens, percent, at which the trust model was fitted.
_FITTED_PERCENT = 0.2
# Where roofs alone are less likely by so many nats, lines where walls end lead astray.
_CONTRADICTED = 5.0
# Of (N, 10) vectors, and of a share of the photo's nats.
LogLikelihood = Callable[[Floats, float], Floats]


class Answer(NamedTuple):
    """A pose, (6,), and what the trust in it depends on.

    Attributes:
        vector: (6,) the mean of the poses around the best one, or by lines around theirs.
        covariance: (6, 6) of the answer's error.
        if_map_is_right: (6, 6) the same if the map had no errors.
        apart_m: How far the place by the model's lines is from the best by regions and outlines.
        lines: Nats by which edges along them are likelier than anywhere; 0 where there are none.
        sharpness: Whether edges lie on them or beside them, as of ``LineLikelihood``.
        evidence: (M,) the logarithm of what speaks for each mode of the search, up to a constant: lines, or
            where there are none its posterior; -inf of those not followed. The vector comes from the best.
        lens_percent: How much longer the lens is than declared.
    """

    vector: Floats
    covariance: Floats
    if_map_is_right: Floats
    apart_m: float
    lines: float
    sharpness: float
    evidence: Floats
    lens_percent: float = 0.0


class PoseFinalizer:
    """Makes an answer from the modes of the search for one photo.

    Vectors of ten numbers are state vectors (``estimation.state_vector``).
    """

    def __init__(self, problem: Problem, params: RegionParams) -> None:
        self._problem, self._params = problem, params
        self._roofs, self._jacobian = problem.roofs, problem.jacobian
        self._fit = problem.photo.fit(params.fine_width, is_coarse=False)

    def answer(self, modes: list[Mode], streams: Streams) -> Answer:
        """Returns the answer near the best of some modes, by lines where edges are sharp beside them.

        Args:
            modes: Best first by regions and outlines; lines choose among them.
            streams: Of random numbers.
        """
        params = self._params
        starts = np.array([np.append(mode.gaussian.mean, np.zeros(BESIDE_POSE)) for mode in modes])
        searched = np.array([mode.log_posterior for mode in modes])
        if params.lines_weight <= 0:
            return self._by_regions(starts[0], TYPICAL_LINES, searched)
        aligned = self._best_aligned(starts, streams)
        if aligned is None:
            return self._by_regions(starts[0], NO_LINES, searched)
        start = starts[int(aligned.evidence.argmax())]
        apart_m = float(np.linalg.norm((aligned.vector - start)[:3]))
        lines = float(aligned.lines(aligned.vector[None])[0])
        features = LineFeatures(apart_m, lines, aligned.sharpness)
        if aligned.sharpness < params.least_sharpness:
            return self._by_regions(start, features, aligned.evidence)
        covariances = self._certainty(aligned.log_likelihood, aligned.vector, aligned.regions)
        mean = self._mean(aligned.log_likelihood, aligned.vector, covariances[0], aligned.regions)
        return Answer(mean[POSE], *covariances, *features, aligned.evidence, float(mean[LENS]))

    def _best_aligned(self, starts: Floats, streams: Streams) -> LineAlignment | None:
        """Returns lines on edges, with tilt and lens as declared, or others where these are plainly likelier.

        Where walls end counts only as far as roofs, which nothing hides, do not contradict it
        (docs/adr/0012, point 6); another tilt only where the photo disagrees with the stated one (point 8);
        another lens only beside an exact map: elsewhere roofs make up for it (point 7).
        """
        params = self._params
        found = self._alignment(params, streams).from_best(starts, self._roofs)
        if found is None:
            return None
        with_bases = self._alignment(params, streams, has_bases=True).from_aligned(found, self._roofs)
        if with_bases is not None and found.worse_by(with_bases.vector) < _CONTRADICTED:
            found = with_bases
        if self._pulls_at_tilt(found):
            wide = replace(params, range_tilt_deg=2.0 * params.tilt_doubt_deg)
            other = self._alignment(wide, streams).from_aligned(found, self._roofs, is_far=True)
            if self._is_plain(other, found):
                found, params = other, wide
        if params.lens_doubt_percent > params.lens_percent and found.sharpness >= params.least_sharpness:
            wide = replace(params, lens_percent=params.lens_doubt_percent)
            other = self._alignment(wide, streams).from_aligned(found, self._roofs)
            if self._is_plain(other, found):
                found = other
        return found

    def _pulls_at_tilt(self, found: LineAlignment) -> bool:
        """Returns whether pitch or roll ends so near the end of its range that both may err more."""
        range_deg = self._params.range_tilt_deg
        if not 0.0 < range_deg < 2.0 * self._params.tilt_doubt_deg:
            return False
        tilt_deg = found.regions.at(0.0).prior.offsets(found.vector[POSE])[TILT]
        return bool(np.abs(tilt_deg).max() > _PULLED * 0.5 * range_deg)

    def _is_plain(self, other: LineAlignment | None, found: LineAlignment) -> TypeGuard[LineAlignment]:
        return other is not None and other.lead_over(found) >= self._params.doubt_nats

    def _alignment(self, params: RegionParams, streams: Streams, has_bases: bool = False) -> LineAligner:
        """Returns what aligns the model's lines with the photo's edges, tilt and lens known so well."""
        # Edges are in the lines' likelihood: that of regions is without.
        return LineAligner(self._problem, self._fit.with_edges(0.0), params, streams, has_bases)

    def _by_regions(self, vector: Floats, features: LineFeatures, evidence: Floats) -> Answer:
        """Returns the mean of what regions and outlines leave around (10,), of a wider photo."""
        params, of_map = self._params, (self._problem.query, self._roofs)
        fine = StatePosterior(*of_map, self._fit, params)
        covariances = self._certainty(_of_share(fine), vector, fine)
        if params.place_sigma_m <= 0:
            return Answer(vector[POSE], *covariances, *features, evidence)
        wide = StatePosterior(*of_map, self._problem.photo.fit(params.mean_width, is_coarse=False), params)
        mean = self._mean(_of_share(wide), vector, covariances[0], wide)
        return Answer(mean[POSE], *covariances, *features, evidence)

    def _certainty(
        self, log_likelihood: LogLikelihood, vector: Floats, regions: StatePosterior
    ) -> tuple[Floats, Floats]:
        """Returns the covariance (6, 6) of an answer's error, and the same if the map had none."""
        pose, evidence = vector[POSE], regions.at(float(vector[ROOFS]))

        def of_poses(poses: Floats) -> Floats:
            return log_likelihood(np.column_stack([poses, np.tile(vector[POSES:], (len(poses), 1))]), 1.0)

        spread = self._jacobian.spread(pose, evidence, _APART_PX)
        information = np.zeros((6, 6)) if spread is None else curvature_around(of_poses, spread)
        prior, outline = evidence.prior.information(), self._jacobian.outline(pose, evidence)
        lens_percent = self._params.lens_percent
        covariance = covariance_under_map_errors(information, prior, outline, lens_percent)
        if_right = np.linalg.inv(information + prior)
        if lens_percent > _FITTED_PERCENT:
            _, ridge = self._lens_ridge(vector, regions)
            if_right += (lens_percent**2 - _FITTED_PERCENT**2) * np.outer(ridge[POSE], ridge[POSE])
        return covariance, np.asarray(if_right)

    def _mean(
        self, log_likelihood: LogLikelihood, vector: Floats, covariance: Floats, regions: StatePosterior
    ) -> Floats:
        """Returns the posterior's mean around (10,), bases and eaves held; or the point itself."""
        least_m = self._params.place_sigma_m
        if least_m <= 0:
            return vector

        def whole(vectors: Floats) -> Floats:
            return np.column_stack([vectors, np.tile(vector[RAISED:], (len(vectors), 1))])

        return posterior_mean(
            lambda vectors, share: log_likelihood(whole(vectors), share),
            lambda vectors: regions.log_prior(whole(vectors)),
            vector[:RAISED],
            regions.widened(self._with_lens(vector, covariance, regions))[:RAISED, :RAISED],
            least_m,
        )

    def _with_lens(self, vector: Floats, covariance: Floats, regions: StatePosterior) -> Floats:
        """Returns the covariance (7, 7) of cameras around (10,), given that of poses, (6, 6)."""
        variance, ridge = self._lens_ridge(vector, regions)
        whole = variance * np.outer(ridge, ridge)
        whole[POSE, POSE] += covariance
        return np.asarray(whole)

    def _lens_ridge(self, vector: Floats, regions: StatePosterior) -> tuple[float, Floats]:
        """Returns the variance of the lens around (10,), and (7,) how like cameras go with it."""
        evidence = regions.at(float(vector[ROOFS]))
        prior = regions.prior_information()[:CAMERAS, :CAMERAS]
        cloud = self._jacobian.spread(vector[:CAMERAS], evidence, _APART_PX, prior)
        along = np.eye(CAMERAS)[LENS] / prior[LENS, LENS] if cloud is None else cloud.covariance[:, LENS]
        return float(along[LENS]), along / along[LENS]


def _of_share(evidence: StatePosterior) -> LogLikelihood:
    return lambda vectors, share: share * evidence.log_likelihood(vectors)
