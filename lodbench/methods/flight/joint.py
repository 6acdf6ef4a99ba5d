"""The joint problem: poses of all photos, what they share, and the heights of the roofs they show.

Numbers that all photos share, in this order: the flight's error of x, y, z (metres), pitch, roll, yaw
(degrees); the focal length (share), radial distortion, and by how much masks are too large (pixels); what all
roofs, and where all walls end, are wrong about alike (metres); each building's height against the map, and
each part's of its roof or foot (metres). A photo's pose is its prior, the flight's error and an error of its
own; a part's height is its building's and an error of its own, a building's that of all roofs and its own.
Photos are eliminated one by one (Schur complement), so that work and memory grow with their number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from lodbench.methods.flight.params import Params
from lodbench.methods.flight.photo_terms import LENS, PhotoTerms
from lodbench.methods.flight.roof_parts import RoofParts

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

# The shared numbers before the buildings': flight's error, lens, all roofs, all feet of walls.
_FLIGHT, _LENS, ROOFS, _FEET, CONSTANTS = slice(0, 6), slice(6, 6 + LENS), 6 + LENS, 7 + LENS, 8 + LENS
# Degrees of freedom of what heights of roofs err by.
_FREEDOM = 2.0
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
    """

    vectors: Floats
    priors: Floats
    roofs: RoofParts
    buildings_m: Floats
    weights: Floats
    constants: Floats = field(default_factory=lambda: np.zeros(CONSTANTS))

    @property
    def lens(self) -> Floats:
        """Returns (3,) the focal length's change as a share, k1, and pixels that masks are too large by."""
        return self.constants[_LENS]

    @property
    def offset(self) -> Floats:
        """Returns (6,) the flight's error: where photos were, less what the sensors said."""
        return self.constants[_FLIGHT]

    def step(self, solution: Solution) -> None:
        """Moves everything by a solution's steps."""
        shown = solution.buildings
        self.vectors = self.vectors + solution.photo_steps
        self.constants = self.constants + solution.shared_step[:CONSTANTS]
        self.buildings_m[shown] += solution.shared_step[CONSTANTS : CONSTANTS + len(shown)]
        self.roofs.heights_m = self.roofs.heights_m + solution.shared_step[CONSTANTS + len(shown) :]


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The normal equations, solved.

    Attributes:
        photo_steps: (P, 6) of the photos' poses.
        shared_step: (S,) of what they share: constants, then buildings, then parts of roofs.
        buildings: (N,) rows of the scene that the shared numbers speak of, ascending.
        factorised: The shared numbers' curvature.
        photo_information: (P, 6, 6) of each pose, given what is shared.
        couplings: Of each photo: its columns among the shared numbers, and (6, N) its coupling with them.
    """

    photo_steps: Floats
    shared_step: Floats
    buildings: Rows
    factorised: SuperLU
    photo_information: Floats
    couplings: Sequence[tuple[Rows, Floats]]


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
    own = np.diag(params.own_sigmas() ** -2.0)
    gaps = differences(state.vectors, state.priors) - state.offset
    buildings = np.unique(state.roofs.building[state.roofs.building >= 0])
    first_part = CONSTANTS + len(buildings)
    system = _SharedSystem(first_part + len(state.roofs))
    system.add_priors(state, buildings, params)
    inner, right, couplings = [], [], []
    for k, term in enumerate(terms):
        columns, block, slope = _photo_block(term, gaps[k], own, state.weights[k], first_part)
        factor = np.linalg.solve(block[:6, :6], np.column_stack([block[:6, 6:], slope[:6]]))
        reduced = block[6:, 6:] - block[6:, :6] @ factor[:, :-1]
        system.add(columns, reduced, slope[6:] - block[6:, :6] @ factor[:, -1])
        inner.append(block[:6, :6])
        right.append(slope[:6])
        couplings.append((columns, block[:6, 6:]))
    factorised, shared_step = system.solve()
    steps = np.array(
        [
            -np.linalg.solve(inner[k], right[k] + coupling @ shared_step[columns])
            for k, (columns, coupling) in enumerate(couplings)
        ]
    )
    longest = np.maximum(1.0, np.max(np.abs(steps) / _LONGEST_STEP, axis=1, initial=0.0))
    return Solution(steps / longest[:, None], shared_step, buildings, factorised, np.array(inner), couplings)


def _photo_block(
    term: PhotoTerms | None, gap: Floats, own: Floats, weight: float, first_part: int
) -> tuple[Rows, Floats, Floats]:
    """Returns a photo's shared columns, and curvature and slope of its pose (6) and those.

    Args:
        term: What the photo says.
        gap: (6,) its pose less its prior and the flight's error.
        own: (6, 6) how well the sensors know that.
        weight: How far its own words count.
        first_part: Column of the first part of a roof.
    """
    parts = np.zeros(0, np.int64) if term is None else first_part + term.parts
    columns = np.concatenate([np.arange(ROOFS), parts])
    block, slope = np.zeros((6 + len(columns), 6 + len(columns))), np.zeros(6 + len(columns))
    if term is not None:
        # The flight's error stands between the photo's pose and the lens.
        place = np.concatenate([np.arange(6), np.arange(12, 6 + len(columns))])
        block[np.ix_(place, place)] = weight * term.information
        slope[place] = weight * term.gradient
    block[:6, :6] += own
    block[:6, 6:12] -= own
    block[6:12, :6] -= own
    block[6:12, 6:12] += own
    slope[:6] += own @ gap
    slope[6:12] -= own @ gap
    return columns, block, slope


class _SharedSystem:
    """Curvature and slope of the shared numbers, summed entry by entry."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._gradient = np.zeros(size)
        self._rows: list[Rows] = []
        self._columns: list[Rows] = []
        self._values: list[Floats] = []

    def add(self, columns: Rows, block: Floats, gradient: Floats) -> None:
        """Adds a dense block at some columns."""
        self._rows.append(np.repeat(columns, len(columns)))
        self._columns.append(np.tile(columns, len(columns)))
        self._values.append(block.ravel())
        self._gradient[columns] += gradient

    def add_priors(self, state: State, buildings: Rows, params: Params) -> None:
        """Adds what is known of the shared numbers beforehand."""
        precision = params.constant_sigmas() ** -2.0
        self.add(np.arange(CONSTANTS), np.diag(precision), precision * state.constants)
        # Buildings lie around all roofs, parts around their building.
        below = CONSTANTS + np.arange(len(buildings))
        heights = state.buildings_m[buildings]
        roofs = np.full(len(buildings), ROOFS)
        self._tie(below, roofs, heights - state.constants[ROOFS], params.roof_m)
        parts = CONSTANTS + len(buildings) + np.arange(len(state.roofs))
        is_roof = state.roofs.building >= 0
        above = np.searchsorted(buildings, state.roofs.building[is_roof])
        own = state.roofs.heights_m[is_roof] - heights[above]
        self._tie(parts[is_roof], CONSTANTS + above, own, params.part_m)
        feet = parts[~is_roof]
        own = state.roofs.heights_m[~is_roof] - state.constants[_FEET]
        self._tie(feet, np.full(len(feet), _FEET), own, params.foot_m)

    def _tie(self, these: Rows, those: Rows, gaps: Floats, sigma: float) -> None:
        """Adds that some numbers are alike to others, whose differences are ``gaps``."""
        sigma = max(sigma, 1e-4)
        # Most heights are right to a little, some wrong by much: Student's t rather than a Gaussian.
        values = (_FREEDOM + 1.0) / (_FREEDOM + (gaps / sigma) ** 2) / sigma**2
        for rows, columns, sign in (
            (these, these, 1),
            (those, those, 1),
            (these, those, -1),
            (those, these, -1),
        ):
            self._rows.append(rows)
            self._columns.append(columns)
            self._values.append(sign * values)
        np.add.at(self._gradient, these, values * gaps)
        np.add.at(self._gradient, those, -values * gaps)

    def solve(self) -> tuple[SuperLU, Floats]:
        """Returns the factorised curvature, and the step."""
        where = np.concatenate(self._rows), np.concatenate(self._columns)
        shape = self._size, self._size
        factorised = splu(csc_matrix(coo_matrix((np.concatenate(self._values), where), shape)))
        return factorised, -factorised.solve(self._gradient)


def shared_covariance(solution: Solution, columns: Rows) -> Floats:
    """Returns the covariance of some of the shared numbers, (N, N)."""
    pick = np.zeros((len(columns), len(solution.shared_step)))
    pick[np.arange(len(columns)), columns] = 1.0
    return covariance_of(solution, pick)


def covariance_of(solution: Solution, sums: Floats) -> Floats:
    """Returns the covariance of some weighted sums, (N, S), of the shared numbers: (N, N)."""
    found = sums @ solution.factorised.solve(np.ascontiguousarray(sums.T))
    return np.asarray(0.5 * (found + found.T))


def photo_covariance(solution: Solution, photo: int) -> Floats:
    """Returns (6, 6) the covariance of a photo's pose: its own, and what it has from the shared numbers."""
    columns, coupling = solution.couplings[photo]
    inverse = np.linalg.inv(solution.photo_information[photo])
    lever = inverse @ coupling
    spread = inverse + lever @ shared_covariance(solution, columns) @ lever.T
    return np.asarray(0.5 * (spread + spread.T))
