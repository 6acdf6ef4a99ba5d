"""The joint problem: poses of all photos, what they share, and the heights of the roofs they show.

Its unknowns, in this order: six numbers of each photo (metres, degrees); the flight's error of x, y, z
(metres), pitch, roll, yaw (degrees); the focal length (share), radial distortion, and by how much masks are
too large (pixels); what all roofs, and where all walls end, are wrong about alike (metres); each building's
height against the map, and each part's of its roof or foot (metres); the similarity that places a
reconstruction. A photo's pose is its prior, the flight's error and an error of its own; a part's height is
its building's and an error of its own, a building's that of all roofs and its own. All is one sparse system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU

from lodbench.methods.contour_alignment.pose_vector import rotation_derivatives
from lodbench.methods.flight.normal_equations import NormalEquations
from lodbench.methods.flight.params import Params
from lodbench.methods.flight.photo_terms import LENS, PhotoTerms
from lodbench.methods.flight.reconstruction import MOUNT, UNKNOWNS, Reconstruction
from lodbench.methods.flight.relative_poses import RelativePose
from lodbench.methods.flight.roof_parts import RoofParts

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

# The shared numbers before the buildings': flight's error, lens, all roofs, all feet of walls.
_FLIGHT, _LENS, ROOFS, _FEET, CONSTANTS = slice(0, 6), slice(6, 6 + LENS), 6 + LENS, 7 + LENS, 8 + LENS
FOCAL = 6
# Degrees of freedom of what heights err by: most are right to a little, some wrong by much.
_FREEDOM = 1.0
# The longest step of a photo: a linearisation says little beyond it (metres, degrees).
_LONGEST_STEP = np.array([6.0, 6.0, 10.0, 2.0, 2.0, 4.0])


@dataclass(slots=True, eq=False)
class State:
    """Where the joint problem stands.

    Attributes:
        vectors: (P, 6) poses of the photos, metres and degrees.
        priors: (P, 6) what the sensors said of them.
        constants: (11,) the shared numbers before the buildings', as in the module's text.
        roofs: Heights of parts of roofs.
        buildings_m: (B,) metres by which each building of the scene is higher than in the map.
        weights: (P,) how far each photo's own words count; 0 for one that is lost.
        reasons: Why a photo is lost, by number.
        ties: What pairs of photos say of their relative poses.
        reconstruction: Poses of photos up to a similarity, or None.
    """

    vectors: Floats
    priors: Floats
    roofs: RoofParts
    buildings_m: Floats
    weights: Floats
    constants: Floats = field(default_factory=lambda: np.zeros(CONSTANTS))
    reasons: dict[int, str] = field(default_factory=dict)
    ties: Sequence[RelativePose] = ()
    reconstruction: Reconstruction | None = None

    @property
    def lens(self) -> Floats:
        """Returns (3,) the focal length's change as a share, k1, and pixels that masks are too large by."""
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
        )

    def shift(self, poses: Floats, constants: Floats) -> None:
        """Moves all poses by (6,) and what photos share by (11,); heights go with all roofs' and feet's."""
        self.vectors = self.vectors + poses
        self.constants = self.constants + constants
        is_roof = self.roofs.building >= 0
        self.roofs.heights_m = self.roofs.heights_m + np.where(is_roof, constants[ROOFS], constants[_FEET])
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


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The normal equations, solved.

    Attributes:
        photo_steps: (P, 6) of the photos' poses.
        shared_step: (S,) of what they share: constants, buildings, parts of roofs, similarity.
        buildings: (N,) rows of the scene that the shared numbers speak of, ascending.
        factorised: The curvature of photos, then what they share.
    """

    photo_steps: Floats
    shared_step: Floats
    buildings: Rows
    factorised: SuperLU


def differences(vectors: Floats, priors: Floats) -> Floats:
    """Returns (P, 6) poses less priors, angles within half a turn."""
    gaps = vectors - priors
    gaps[:, 3:] = (gaps[:, 3:] + 180.0) % 360.0 - 180.0
    return np.asarray(gaps)


def solve(state: State, terms: Sequence[PhotoTerms | None], params: Params) -> Solution:
    """Returns one Gauss-Newton step of the joint problem.

    Args:
        state: Where it stands.
        terms: What each photo says there; None for one that says nothing.
        params: How far everything may be wrong.
    """
    buildings = np.unique(state.roofs.building[state.roofs.building >= 0])
    shared = 6 * len(terms)
    parts = shared + CONSTANTS + len(buildings)
    similarity = parts + len(state.roofs)
    size = similarity + (0 if state.reconstruction is None else UNKNOWNS)
    equations = NormalEquations(size)
    _add_map(equations, state, shared, buildings, params)
    own = np.diag(params.own_sigmas() ** -2.0)
    gaps = differences(state.vectors, state.priors) - state.offset
    apart = np.hstack([np.eye(6), -np.eye(6)])
    for k, term in enumerate(terms):
        pose = np.arange(6 * k, 6 * k + 6)
        equations.add_residuals(np.concatenate([pose, shared + np.arange(6)]), apart, gaps[k], own)
        if term is not None and state.weights[k] > 0:
            unknowns = np.concatenate([pose, shared + np.arange(6, 6 + LENS), parts + term.parts])
            equations.add(unknowns, state.weights[k] * term.information, state.weights[k] * term.gradient)
    _add_relative_poses(equations, state, shared + FOCAL, similarity, params)
    factorised, step = equations.solve()
    steps = step[:shared].reshape(-1, 6)
    longest = np.maximum(1.0, np.max(np.abs(steps) / _LONGEST_STEP, axis=1, initial=0.0))
    return Solution(steps / longest[:, None], step[shared:], buildings, factorised)


def _add_relative_poses(
    equations: NormalEquations, state: State, focal: int, similarity: int, params: Params
) -> None:
    """Adds what is known of photos' poses relative to each other."""
    if not state.ties and state.reconstruction is None:
        return
    derivatives = [rotation_derivatives(vector) for vector in state.vectors]
    for tie in state.ties:
        unknowns = np.concatenate([np.arange(6) + 6 * tie.first, np.arange(6) + 6 * tie.second, [focal]])
        residuals, jacobian = tie.linearize(state.vectors, derivatives, state.constants[FOCAL])
        equations.add_residuals(unknowns, jacobian, residuals, tie.weighted_information(residuals))
    if state.reconstruction is not None:
        shared = similarity + np.arange(UNKNOWNS)
        precision = params.mount_precision()
        equations.add(shared[MOUNT], np.eye(3) * precision, precision * state.reconstruction.mount)
        for photo in state.reconstruction.photos:
            residuals, jacobian = state.reconstruction.linearize(photo, state.vectors, derivatives)
            unknowns = np.concatenate([np.arange(6) + 6 * photo, shared])
            information = state.reconstruction.weighted_information(residuals)
            equations.add_residuals(unknowns, jacobian, residuals, information)


def _add_map(equations: NormalEquations, state: State, shared: int, buildings: Rows, params: Params) -> None:
    """Adds what is known beforehand of the shared numbers, whose first column is ``shared``."""
    precision = params.constant_sigmas() ** -2.0
    equations.add(shared + np.arange(CONSTANTS), np.diag(precision), precision * state.constants)
    # Buildings lie around all roofs, parts around their building.
    below = shared + CONSTANTS + np.arange(len(buildings))
    heights = state.buildings_m[buildings]
    _tie(equations, below, shared + ROOFS, heights - state.constants[ROOFS], params.roof_m)
    parts = shared + CONSTANTS + len(buildings) + np.arange(len(state.roofs))
    is_roof = state.roofs.building >= 0
    above = np.searchsorted(buildings, state.roofs.building[is_roof])
    own = state.roofs.heights_m[is_roof] - heights[above]
    _tie(equations, parts[is_roof], below[above], own, params.part_m)
    own = state.roofs.heights_m[~is_roof] - state.constants[_FEET]
    _tie(equations, parts[~is_roof], shared + _FEET, own, params.foot_m)


def _tie(equations: NormalEquations, these: Rows, those: Rows | int, gaps: Floats, sigma: float) -> None:
    """Adds that heights are alike to others, with Student's t for what they err by."""
    sigma = max(sigma, 1e-4)
    precisions = (_FREEDOM + 1.0) / (_FREEDOM + (gaps / sigma) ** 2) / sigma**2
    equations.add_differences(these, np.broadcast_to(those, these.shape), gaps, precisions)


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
    found = sums @ solution.factorised.solve(whole)[first:last]
    return np.asarray(0.5 * (found + found.T))


def photo_covariance(solution: Solution, photo: int) -> Floats:
    """Returns (6, 6) the covariance of a photo's pose, what the shared numbers leave open included."""
    rows = slice(6 * photo, 6 * photo + 6)
    unit = np.zeros((solution.photo_steps.size + len(solution.shared_step), 6))
    unit[rows] = np.eye(6)
    found = solution.factorised.solve(unit)[rows]
    return np.asarray(0.5 * (found + found.T))
