"""The method: LoD-Loc v2's grid finds the neighbourhood, outlines aligned by least squares the pose.

Its last steps are over hypotheses of what is wrong with map and camera: a world (how roofs and bases err), a
prior's tilt as declared or worse, and a lens likewise. Each step is Gauss-Newton's to the optimum of the
likeliest; at the end all that are left are a mixture of Gaussians, weighed by their evidence: the density of
the outline with pose and errors integrated out. Their mixture says where the camera is, how surely, and where
else it may be.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
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
from lodbench.estimation.optimization import Quadratic
from lodbench.estimation.outline_alignment import Aligner
from lodbench.estimation.posterior import mode_probabilities
from lodbench.estimation.state_vector import (
    DRAWS,
    NUM_POSE,
    NUM_POSE_AND_FOCAL,
    WITHIN_M,
    beyond_range,
    fixed_draws,
    is_near,
    shortened,
    weight_within,
)
from lodbench.geometry import Pose, PoseGrid
from lodbench.geometry.pose import pose_from_vector, turn_per_angle
from lodbench.methods.contour_alignment.likelihood import (
    TRACKS,
    WorldErrors,
    density_anywhere,
    in_chunks,
    log_likelihood,
)
from lodbench.methods.contour_alignment.params import ContourAlignmentParams
from lodbench.methods.fits import PoseScorer, nothing_fits
from lodbench.methods.protocol import Estimate, Streams

Floats = NDArray[np.float64]

# Steps before the prior's tilt and the lens are held as declared.
_FREE_STEPS = 3
# By how much less evidence, in its logarithm, a world is given up after a step, a track after the free ones.
_PRUNE_WORLD, _PRUNE_TRACK = 12.0, 15.0


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A Gaussian of camera and shared errors under one hypothesis."""

    world: WorldErrors  # how the city differs from the map
    is_tilt_free: bool  # whether the prior's tilt is worse than declared
    is_lens_free: bool  # whether the lens is
    # (10,) from where it was linearised to its optimum: the camera's numbers and the shared errors
    step: Floats
    information: Floats  # (10, 10) there, the prior included
    evidence: float  # logarithm, odds included, up to a constant

    @property
    def key(self) -> tuple[str, bool, bool]:
        """Returns its name."""
        return self.world.name, self.is_tilt_free, self.is_lens_free


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A pose at the end of its steps."""

    # (7,) centre in metres, angles in degrees and percent of the lens, which the steps of hypotheses lead
    # away from
    vector: Floats
    hypotheses: tuple[Hypothesis, ...]  # those that are left, the likeliest first
    weights: Floats  # their probabilities
    overlap: float  # of mask and mapped buildings, see ``mapped_overlap``


@dataclass(slots=True, eq=False)
class _Track:
    """Worlds that share a camera, with their shared errors as estimated so far."""

    vector: Floats
    shared: dict[WorldErrors, Floats]
    is_lens_free: bool
    hypotheses: list[Hypothesis]

    @property
    def evidence(self) -> float:
        return max(each.evidence for each in self.hypotheses)


def refine(aligner: Aligner, vector: Floats, params: ContourAlignmentParams) -> Refined | None:
    """Returns what is left of the hypotheses after the last steps; None without an outline in view."""
    tracks = [_Track(vector, {w: w.shared_mean for w in worlds}, is_free, []) for worlds, is_free in TRACKS]
    for step in range(params.final_steps + 1):
        tracks = [track for track in tracks if _weigh(aligner, track, params, step)]
        if not tracks:
            return None
        if step >= min(_FREE_STEPS, params.final_steps):
            best = max(track.evidence for track in tracks)
            tracks = [track for track in tracks if track.evidence > best - _PRUNE_TRACK]
    return _mixture(aligner, tracks)


def _mixture(aligner: Aligner, tracks: list[_Track]) -> Refined:
    """Returns what is left as a mixture of Gaussians: Eq. (C12) of docs/methods/contour_alignment.md."""
    best = max(tracks, key=lambda track: track.evidence)
    # A hypothesis followed on several tracks counts once: where it explains most.
    by_key: dict[tuple[str, bool, bool], Hypothesis] = {}
    for track in tracks:
        apart = np.append(track.vector - best.vector, np.zeros(3))
        for each in track.hypotheses:
            known = by_key.get(each.key)
            if known is None or known.evidence < each.evidence:
                by_key[each.key] = replace(each, step=each.step + apart)
    hypotheses = sorted(by_key.values(), key=lambda each: -each.evidence)
    weights = mode_probabilities(np.array([each.evidence for each in hypotheses]))
    return Refined(best.vector, tuple(hypotheses), weights, aligner.overlap(best.vector))


def _weigh(aligner: Aligner, track: _Track, params: ContourAlignmentParams, step: int) -> bool:
    """Weighs a track's hypotheses where it stands, and moves it on; False where no outline is in view."""
    here = aligner.measure(track.vector, params.fine_size)
    if here is None:
        return False
    outline = in_chunks(here)
    anywhere = density_anywhere(outline, *next(iter(track.shared.items())), params)
    likelihoods = {
        world: log_likelihood(outline, world, shared, params, anywhere)
        for world, shared in track.shared.items()
    }
    prior = aligner.prior
    known = prior.offsets(track.vector), prior.sigmas[:NUM_POSE]
    track.hypotheses = [
        each
        for world, likelihood in likelihoods.items()
        for each in _hypotheses(*known, world, track.shared[world], likelihood, params)
    ]
    if step == params.final_steps:
        return True
    is_free = step < _FREE_STEPS
    needs_tilt, needs_lens = is_free and not track.is_lens_free, is_free or track.is_lens_free
    allowed = (m for m in track.hypotheses if m.is_tilt_free >= needs_tilt and m.is_lens_free >= needs_lens)
    move = shortened(max(allowed, key=lambda each: each.evidence).step[:NUM_POSE_AND_FOCAL])
    track.shared = {
        world: track.shared[world] + _shared_step(world, track.shared[world], likelihood, move)
        for world, likelihood in likelihoods.items()
    }
    track.vector = track.vector + move
    if step >= 1:
        best = {world: max(m.evidence for m in track.hypotheses if m.world is world) for world in likelihoods}
        track.shared = {
            w: shared for w, shared in track.shared.items() if best[w] > track.evidence - _PRUNE_WORLD
        }
    return True


def _hypotheses(
    offset: Floats,
    sigmas: Floats,
    world: WorldErrors,
    shared: Floats,
    likelihood: Quadratic,
    params: ContourAlignmentParams,
) -> list[Hypothesis]:
    """Returns a world's hypotheses of tilt and lens, given how far from the prior the camera stands, (7,).

    Eq. (C11) of docs/methods/contour_alignment.md; ``sigmas``, (6,), are the prior's.
    """
    away = np.concatenate([offset, shared - world.shared_mean])
    hypotheses = []
    for is_tilt_free, is_lens_free in product((False, True), repeat=2):
        camera = params.camera_sigmas(sigmas, is_tilt_free=is_tilt_free, is_lens_free=is_lens_free)
        precision = np.array([*camera, *world.shared_sigmas]) ** -2.0
        posterior = likelihood.times_prior(precision, away)
        step = posterior.step()
        # Laplace: the height of the peak times its width, over the prior's.
        evidence = posterior.log_density - 0.5 * float(posterior.gradient @ step)
        evidence -= 0.5 * float(np.linalg.slogdet(posterior.information)[1] - np.log(precision).sum())
        evidence += float(np.log(world.odds * params.camera_odds(is_tilt_free, is_lens_free)))
        hypotheses.append(
            Hypothesis(world, is_tilt_free, is_lens_free, step, posterior.information, evidence)
        )
    return hypotheses


def _shared_step(world: WorldErrors, shared: Floats, likelihood: Quadratic, move: Floats) -> Floats:
    """Returns (3,) the step of the shared errors to their optimum, given the camera's, (7,)."""
    of_shared = Quadratic(
        likelihood.information[NUM_POSE_AND_FOCAL:, NUM_POSE_AND_FOCAL:],
        likelihood.gradient[NUM_POSE_AND_FOCAL:],
    )
    posterior = of_shared.times_prior(world.shared_sigmas**-2.0, shared - world.shared_mean)
    gradient = posterior.gradient + likelihood.information[NUM_POSE_AND_FOCAL:, :NUM_POSE_AND_FOCAL] @ move
    return posterior._replace(gradient=gradient).step()


# Hypotheses less likely than this are left out; answers less likely are no alternatives.
_LEAST_WEIGHT, _LEAST_ALTERNATIVE = 0.002, 0.02
# An end of the alignment whose IoU is less by this is believed 1/e as much.
RIVAL_IOU = 0.004
# A mask that holds no more than the one of mapped buildings above their surroundings does not show them; by
# the other it is as good as outlines are taken to be (see ``mapped_overlap``).
_NO_OVERLAP, _OVERLAP = 0.3, 0.7


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """The point of a mixture that is most likely near the truth."""

    vector: Floats  # (6,) centre in metres and angles in degrees
    covariance: Floats  # (6, 6) of the error there, what the hypotheses disagree about included
    probability: float  # that it is within (2 m, 2 deg)
    alternatives: tuple[Pose, ...]  # where other hypotheses put the camera, beyond that, the likeliest first
    alternative_probabilities: tuple[float, ...]  # of each


def answer_of(refined: Refined) -> Answer:
    """Returns the answer that a mixture of hypotheses gives.

    Eq. (C13) of docs/methods/contour_alignment.md.
    """
    kept = int(np.count_nonzero(refined.weights >= _LEAST_WEIGHT))
    hypotheses, weights = refined.hypotheses[:kept], refined.weights[:kept] / refined.weights[:kept].sum()
    counts = np.maximum(8, np.rint(DRAWS * weights).astype(int))
    drawn = [_draws(each.information, each.step, n) for each, n in zip(hypotheses, counts, strict=True)]
    errors, shares = np.concatenate(drawn), np.repeat(weights / counts, counts)
    turn = turn_per_angle(refined.vector)
    means = [each.step[:6] for each in hypotheses]
    chances = [weight_within(errors - mean, shares, turn) for mean in (*means, shares @ errors)]
    best = int(np.argmax(chances))
    center = (*means, shares @ errors)[best]
    spread = (shares[:, None] * (errors - center)).T @ (errors - center)
    overlap = float(np.clip((refined.overlap - _NO_OVERLAP) / (_OVERLAP - _NO_OVERLAP), 0.0, 1.0))
    others = _others(means, weights, center, turn)
    return Answer(
        refined.vector[:6] + center,
        0.5 * (spread + spread.T),
        chances[best] * overlap,
        tuple(pose_from_vector(refined.vector[:6] + mean) for mean, _ in others),
        tuple(overlap * weight for _, weight in others),
    )


def among_rivals(answer: Answer, ends: Floats, ious: Floats, ranges: Floats) -> Answer:
    """Returns an answer whose probabilities are shared with places where the silhouette fits nearly as well.

    Eq. (C14) of docs/methods/contour_alignment.md. Outlines there are other points, whose densities do not
    compare with the answer's; IoUs do.

    Args:
        answer: What the end of highest IoU led to.
        ends: (N, 7) where the alignment of the starts ended.
        ious: (N,) of silhouette and mask there.
        ranges: (N,) nats that a laser's range says of them; the answer comes from the best by both.
    """
    ious = ious + RIVAL_IOU * ranges
    order = np.argsort(-ious, kind="stable")
    apart: list[int] = []
    for k in order:
        if all(np.linalg.norm(ends[k, :3] - ends[j, :3]) >= WITHIN_M for j in apart):
            apart.append(int(k))
    weights = np.exp((ious[apart] - ious[apart[0]]) / RIVAL_IOU)
    shares = weights / weights.sum()
    # The answer may have moved on to where another one ended.
    turn = turn_per_angle(answer.vector)
    rivals = [
        (pose_from_vector(ends[k]), float(share))
        for k, share in zip(apart[1:], shares[1:], strict=True)
        if share >= _LEAST_ALTERNATIVE and not is_near(ends[k, :6] - answer.vector, turn)
    ]
    known = zip(answer.alternatives, shares[0] * np.array(answer.alternative_probabilities), strict=True)
    others = sorted([*known, *rivals], key=lambda other: -other[1])
    return replace(
        answer,
        probability=answer.probability * float(shares[0]),
        alternatives=tuple(pose for pose, _ in others),
        alternative_probabilities=tuple(float(share) for _, share in others),
    )


def _others(
    means: Sequence[Floats], weights: Floats, center: Floats, turn: Floats
) -> list[tuple[Floats, float]]:
    """Returns where else the camera may be, with the weight of all hypotheses that put it near there."""
    others: list[tuple[Floats, float]] = []
    for mean, weight in zip(means, weights, strict=True):
        if is_near(mean - center, turn):
            continue
        near = [k for k, (other, _) in enumerate(others) if is_near(mean - other, turn)]
        if near:
            others[near[0]] = others[near[0]][0], others[near[0]][1] + float(weight)
        else:
            others.append((mean, float(weight)))
    likely = [other for other in others if other[1] >= _LEAST_ALTERNATIVE]
    return sorted(likely, key=lambda other: -other[1])


def _draws(information: Floats, step: Floats, count: int) -> Floats:
    """Returns (count, 6) draws of a hypothesis, lens and shared errors left out."""
    inverse = np.linalg.inv(information)[:6, :6]
    return np.asarray(step[:6] + fixed_draws(0.5 * (inverse + inverse.T), count))


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
