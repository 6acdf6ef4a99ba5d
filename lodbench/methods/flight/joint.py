"""The joint problem: poses of all photos, what they share, and the heights of the roofs they show.

Its unknowns, in this order: six numbers of each photo (metres, degrees); the flight's error of x, y, z
(metres), pitch, roll, yaw (degrees); the focal length (share), radial distortion, principal point (shares
of the width), and by how much masks are too large (pixels); what all roofs, and where all walls end, are
wrong about alike (metres); each building's height against the map, and each part's of its roof or foot
(metres); the similarity that places a reconstruction. A photo's pose is its prior, the flight's error and an
error of its own; a part's height is its building's and an error of its own, a building's that of all roofs
and its own. All is one sparse system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.estimation.optimization import ErrorGroup, NormalEquations
from lodbench.estimation.state_vector import differences, shortened
from lodbench.geometry.pose import rotation_derivatives
from lodbench.methods.flight.params import FlightParams
from lodbench.methods.flight.photo_terms import LENS, PhotoTerms, RoofParts
from lodbench.methods.flight.relative_poses import MOUNT, UNKNOWNS, Reconstruction, RelativePose
from lodbench.photos.measurements import Measurements

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

# The shared numbers before the buildings': flight's error, lens, all roofs, all feet of walls.
_FLIGHT, _LENS, ROOFS, BASE_OFFSET, CONSTANTS = slice(0, 6), slice(6, 6 + LENS), 6 + LENS, 7 + LENS, 8 + LENS
FOCAL = 6
# Heights by air pressure and priors that differ by more in the middle have nothing to do with each other.
_MOST_SCATTER_M = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The normal equations, solved."""

    photo_steps: Floats  # (P, 6) of the photos' poses
    shared_step: Floats  # (S,) of what they share: constants, buildings, parts of roofs, similarity
    buildings: Rows  # (N,) rows of the scene that the shared numbers speak of, ascending
    factorised: scipy.sparse.linalg.SuperLU  # the curvature of photos, then what they share
    groups: Sequence[ErrorGroup]  # of errors that have a scale of their own, in the order of ``State.scales``
    members: Sequence[int]  # how many errors of each have nothing to do with each other
    # (S, 2 N) curvature between all unknowns and where the buildings stand, east and north of each: what
    # photos do not solve for, as more photos say nothing of it
    pulls: Floats

    def moved_by_places(self) -> Floats:
        """Returns (S, 2 N) how unknowns move per metre that each building stands east and north off.

        Eq. (F18) of docs/methods/flight.md.
        """
        return np.asarray(-self.factorised.solve(self.pulls)) if self.pulls.size else self.pulls

    def scales(self) -> Floats:
        """Returns (6,) the scales that this calls for; see ``State.scales``."""
        step = np.concatenate([self.photo_steps.ravel(), self.shared_step])
        grouped = zip(self.groups, self.members, strict=True)
        return np.array([group.scale_after(self.factorised, step, count) for group, count in grouped])


@dataclass(slots=True, eq=False)
class State:
    """Where the joint problem stands."""

    vectors: Floats  # (P, 6) poses of the photos, metres and degrees
    priors: Floats  # (P, 6) what the sensors said of them
    roofs: RoofParts  # heights of parts of roofs
    buildings_m: Floats  # (B,) metres by which each building of the scene is higher than in the map
    weights: Floats  # (P,) how far each photo's own words count; 0 for one that is lost
    # (13,) the shared numbers before the buildings', see ``joint``
    constants: Floats = field(default_factory=lambda: np.zeros(CONSTANTS))
    reasons: dict[int, str] = field(default_factory=dict)  # why a photo is lost, by number
    ties: Sequence[RelativePose] = ()  # what pairs of photos say of their relative poses
    reconstruction: Reconstruction | None = None  # poses of photos up to a similarity, or None
    measured: Sequence[Measurements | None] = ()  # (P,) what was measured beside each photo, None for nothing
    # (6,) shares of what is declared that buildings, parts of roofs, feet of walls, places and turns of
    # photos in the reconstruction, and ties err by
    scales: Floats = field(default_factory=lambda: np.ones(6))

    @property
    def lens(self) -> Floats:
        """Returns (5,) focal length and k1, principal point right and down, how much masks are grown (px)."""
        return self.constants[_LENS]

    @property
    def offset(self) -> Floats:
        """Returns (6,) the flight's error: where photos were, less what the sensors said."""
        return self.constants[_FLIGHT]

    def begun(self, photos: Rows, offset: Floats) -> State:
        """Returns some of its photos, the flight's error further off by (6,), roofs as the map has them."""
        number = {int(photo): k for k, photo in enumerate(photos)}
        vectors, constants = self.vectors[photos] + offset, self.constants.copy()
        constants[_FLIGHT] += offset
        return State(
            vectors=vectors,
            priors=self.priors[photos],
            roofs=self.roofs.untouched(),
            buildings_m=np.zeros_like(self.buildings_m),
            weights=np.ones(len(photos)),
            constants=constants,
            ties=[
                replace(tie, first=number[tie.first], second=number[tie.second])
                for tie in self.ties
                if tie.first in number and tie.second in number
            ],
            reconstruction=None if self.reconstruction is None else self.reconstruction.part(number, vectors),
            measured=[self.measured[photo] for photo in photos] if self.measured else (),
        )

    def own_sigmas(self, usual: Floats) -> Floats:
        """Returns (P, 6) standard deviations of photos' own errors: as stated, or the usual (6,) ones.

        Eq. (F25) of docs/methods/flight.md.
        """
        known = self.measured or [None] * len(self.vectors)
        return np.array([usual if each is None else each.over(usual) for each in known])

    def shift(self, poses: Floats, constants: Floats) -> None:
        """Moves all poses by (6,) and what photos share by (13,); heights go with all roofs' and feet's."""
        self.vectors = self.vectors + poses
        self.constants = self.constants + constants
        is_roof = self.roofs.building >= 0
        self.roofs.heights_m = self.roofs.heights_m + np.where(
            is_roof, constants[ROOFS], constants[BASE_OFFSET]
        )
        self.buildings_m[np.unique(self.roofs.building[is_roof])] += constants[ROOFS]

    def step(self, solution: Solution) -> None:
        """Moves everything by a solution's steps."""
        shown, step = solution.buildings, solution.shared_step
        self.vectors = self.vectors + solution.photo_steps
        self.constants = self.constants + step[:CONSTANTS]
        self.buildings_m[shown] += step[CONSTANTS : CONSTANTS + len(shown)]
        parts = CONSTANTS + len(shown)
        self.roofs.heights_m = self.roofs.heights_m + step[parts : parts + len(self.roofs)]
        if self.reconstruction is not None:
            self.reconstruction = self.reconstruction.moved(step[-UNKNOWNS:])


def without_odd_heights(measured: Sequence[Measurements | None], priors: Floats) -> list[Measurements | None]:
    """Returns what was measured, without heights above a take-off point that are none by the priors.

    Drones that do not know them write zeros, and a new take-off is another point.
    """
    pairs = zip(priors[:, 2], measured, strict=True)
    gaps = np.array(
        [z - each.takeoff_height_m for z, each in pairs if each and each.takeoff_height_m is not None]
    )
    if not len(gaps) or float(np.median(np.abs(gaps - np.median(gaps)))) <= _MOST_SCATTER_M:
        return list(measured)
    return [each and replace(each, takeoff_height_m=None) for each in measured]


# Degrees of freedom of what heights err by: most are right to a little, some wrong by much.
_FREEDOM = 1.0


def solve(state: State, terms: Sequence[PhotoTerms | None], params: FlightParams) -> Solution:
    """Returns one Gauss-Newton step of the joint problem. Eqs. (F1), (F2) of docs/methods/flight.md.

    The terms are what each photo says where the state has it; None for one that says nothing.
    """
    buildings = np.unique(state.roofs.building[state.roofs.building >= 0])
    shared = 6 * len(terms)
    parts = shared + CONSTANTS + len(buildings)
    takeoff = parts + len(state.roofs)
    pressed = [k for k, each in enumerate(state.measured) if each and each.takeoff_height_m is not None]
    similarity = takeoff + (len(pressed) > 1)
    size = similarity + (0 if state.reconstruction is None else UNKNOWNS)
    equations = NormalEquations(size)
    of_roofs, of_parts, of_bases, of_centres, of_turns, of_ties = groups = [
        ErrorGroup(equations, scale) for scale in state.scales
    ]
    precision = params.constant_sigmas(state.scales) ** -2.0
    equations.add(shared + np.arange(CONSTANTS), np.diag(precision), precision * state.constants)
    _add_roofs(of_roofs, of_parts, state, shared, buildings, params)
    _add_bases(of_bases, state, shared, parts, params)
    if len(pressed) > 1:
        _add_barometer(equations, state, np.array(pressed), takeoff)
    own = state.own_sigmas(params.own_sigmas()) ** -2.0
    gaps = differences(state.vectors, state.priors) - state.offset
    apart = np.hstack([np.eye(6), -np.eye(6)])
    pulls = np.zeros((size, 2 * len(buildings)))
    for k, term in enumerate(terms):
        pose = np.arange(6 * k, 6 * k + 6)
        unknowns = np.concatenate([pose, shared + np.arange(6)])
        equations.add_residuals(unknowns, apart, gaps[k], np.diag(own[k]))
        if term is not None and state.weights[k] > 0:
            unknowns = np.concatenate([pose, shared + np.arange(6, 6 + LENS), parts + term.parts])
            own_size, weight = len(unknowns), state.weights[k]
            equations.add(
                unknowns,
                weight * term.information[:own_size, :own_size],
                weight * term.gradient[:own_size],
            )
            at = 2 * np.searchsorted(buildings, term.buildings)
            columns = np.stack([at, at + 1], axis=1).ravel()
            pulls[np.ix_(unknowns, columns)] += weight * term.information[:own_size, own_size:]
    derivatives = [rotation_derivatives(vector) for vector in state.vectors]
    _add_ties(of_ties, state, derivatives, shared + FOCAL)
    _add_reconstruction((of_centres, of_turns), state, derivatives, similarity, params)
    factorised, step = equations.solve(shared)
    steps = shortened(step[:shared].reshape(-1, 6))
    # What one building errs by goes together; what photos err by in a reconstruction does not.
    walls = len(np.unique(state.roofs.building[state.roofs.building < 0]))
    members = len(buildings), len(buildings), walls, of_centres.count, of_turns.count, of_ties.count
    return Solution(steps, step[shared:], buildings, factorised, groups, members, pulls)


def _add_ties(group: ErrorGroup, state: State, derivatives: Sequence[Floats], focal: int) -> None:
    """Adds what pairs of photos say of each other; ``focal`` is the focal length's column."""
    for tie in state.ties:
        unknowns = np.concatenate([np.arange(6) + 6 * tie.first, np.arange(6) + 6 * tie.second, [focal]])
        residuals, jacobian = tie.linearize(state.vectors, derivatives, state.constants[FOCAL])
        group.add_residuals(unknowns, jacobian, residuals, tie.weighted_information(residuals, group.scale))


def _add_reconstruction(
    groups: Sequence[ErrorGroup],
    state: State,
    derivatives: Sequence[Floats],
    similarity: int,
    params: FlightParams,
) -> None:
    """Adds where a reconstruction has photos; ``similarity`` is the first column of what places it."""
    if state.reconstruction is None:
        return
    shared = similarity + np.arange(UNKNOWNS)
    precision = params.mount_precision()
    groups[0].equations.add(shared[MOUNT], np.eye(3) * precision, precision * state.reconstruction.mount)
    for photo in state.reconstruction.photos:
        residuals, jacobian = state.reconstruction.linearize(photo, state.vectors, derivatives)
        unknowns = np.concatenate([np.arange(6) + 6 * photo, shared])
        information = state.reconstruction.weighted_information(residuals, [group.scale for group in groups])
        for group, part in zip(groups, (slice(0, 3), slice(3, 6)), strict=True):
            group.add_residuals(unknowns, jacobian[part], residuals[part], information[part, part])


def _add_barometer(equations: NormalEquations, state: State, photos: Rows, takeoff: int) -> None:
    """Adds that photos are as high above one take-off point as air pressure says, whose height is free.

    Eq. (F26) of docs/methods/flight.md.
    """
    known = [each for each in state.measured if each and each.takeoff_height_m is not None]
    gaps = state.vectors[photos, 2] - np.array([each.takeoff_height_m for each in known])
    gaps -= np.median(gaps)
    sigmas_m = np.array([each.takeoff_sigma_m for each in known])
    precisions = (_FREEDOM + 1.0) / (_FREEDOM + (gaps / sigmas_m) ** 2) / sigmas_m**2
    equations.add_differences(6 * photos + 2, np.full(len(photos), takeoff), gaps, precisions)


def _add_roofs(
    of_roofs: ErrorGroup,
    of_parts: ErrorGroup,
    state: State,
    shared: int,
    buildings: Rows,
    params: FlightParams,
) -> None:
    """Adds that buildings lie around all roofs, and parts around their building."""
    below = shared + CONSTANTS + np.arange(len(buildings))
    heights = state.buildings_m[buildings]
    _add_alike(of_roofs, below, shared + ROOFS, heights - state.constants[ROOFS], params.roof_m)
    is_roof = state.roofs.building >= 0
    parts = shared + CONSTANTS + len(buildings) + np.flatnonzero(is_roof)
    above = np.searchsorted(buildings, state.roofs.building[is_roof])
    _add_alike(of_parts, parts, below[above], state.roofs.heights_m[is_roof] - heights[above], params.part_m)


def _add_bases(group: ErrorGroup, state: State, shared: int, first: int, params: FlightParams) -> None:
    """Adds that feet of walls lie around all feet; the first column of parts is ``first``."""
    is_foot = state.roofs.building < 0
    gaps = state.roofs.heights_m[is_foot] - state.constants[BASE_OFFSET]
    _add_alike(group, first + np.flatnonzero(is_foot), shared + BASE_OFFSET, gaps, params.foot_m)


def _add_alike(group: ErrorGroup, these: Rows, those: Rows | int, gaps: Floats, sigma_m: float) -> None:
    """Adds that heights are alike to others, with Student's t for what they err by."""
    precisions = precisions_of(gaps, group.scale * sigma_m)
    group.add_differences(these, np.broadcast_to(those, these.shape), gaps, precisions)


def precisions_of(gaps: Floats, sigma_m: float) -> Floats:
    """Returns how precisely heights are known beforehand that are so far apart now: of Student's t.

    Eq. (F7) of docs/methods/flight.md.
    """
    sigma = max(sigma_m, 1e-4)
    return np.asarray((_FREEDOM + 1.0) / (_FREEDOM + (gaps / sigma) ** 2) / sigma**2)


def shared_covariance(solution: Solution, columns: Rows) -> Floats:
    """Returns the covariance of some of the shared numbers, (N, N)."""
    pick = np.zeros((len(columns), len(solution.shared_step)))
    pick[np.arange(len(columns)), columns] = 1.0
    return covariance_of(solution, pick)


def covariance_of(solution: Solution, sums: Floats) -> Floats:
    """Returns the covariance of some weighted sums, (N, S), of the first S shared numbers: (N, N)."""
    first, last = solution.photo_steps.size, solution.photo_steps.size + sums.shape[1]
    whole = np.zeros((solution.photo_steps.size + len(solution.shared_step), len(sums)))
    whole[first:last] = sums.T
    covariance = sums @ solution.factorised.solve(whole)[first:last]
    return np.asarray(0.5 * (covariance + covariance.T))


def photo_covariance(solution: Solution, photo: int) -> Floats:
    """Returns (6, 6) the covariance of a photo's pose, what the shared numbers leave open included."""
    rows = slice(6 * photo, 6 * photo + 6)
    unit = np.zeros((solution.photo_steps.size + len(solution.shared_step), 6))
    unit[rows] = np.eye(6)
    covariance = solution.factorised.solve(unit)[rows]
    return np.asarray(0.5 * (covariance + covariance.T))
