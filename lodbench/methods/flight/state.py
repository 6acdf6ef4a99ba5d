"""Where the joint problem of a flight stands: poses, what photos share, and heights of roofs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.estimation.normal_equations import ErrorGroup
from lodbench.methods.flight.photo_terms import LENS
from lodbench.methods.flight.relative_poses import UNKNOWNS, Reconstruction, RelativePose
from lodbench.methods.flight.roof_parts import RoofParts
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
    """The normal equations, solved.

    Attributes:
        photo_steps: (P, 6) of the photos' poses.
        shared_step: (S,) of what they share: constants, buildings, parts of roofs, similarity.
        buildings: (N,) rows of the scene that the shared numbers speak of, ascending.
        factorised: The curvature of photos, then what they share.
        groups: Of errors that have a scale of their own, in the order of ``State.scales``.
        members: How many errors of each have nothing to do with each other.
        pulls: (S, 2 N) curvature between all unknowns and where the buildings stand, east and north of each:
            what photos do not solve for, as more photos say nothing of it.
    """

    photo_steps: Floats
    shared_step: Floats
    buildings: Rows
    factorised: scipy.sparse.linalg.SuperLU
    groups: Sequence[ErrorGroup]
    members: Sequence[int]
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
    """Where the joint problem stands.

    Attributes:
        vectors: (P, 6) poses of the photos, metres and degrees.
        priors: (P, 6) what the sensors said of them.
        constants: (13,) the shared numbers before the buildings', see ``joint``.
        roofs: Heights of parts of roofs.
        buildings_m: (B,) metres by which each building of the scene is higher than in the map.
        weights: (P,) how far each photo's own words count; 0 for one that is lost.
        reasons: Why a photo is lost, by number.
        ties: What pairs of photos say of their relative poses.
        reconstruction: Poses of photos up to a similarity, or None.
        measured: (P,) what was measured beside each photo, None for nothing.
        scales: (6,) shares of what is told that buildings, parts of roofs, feet of walls, places and turns
            of photos in the reconstruction, and ties err by.
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
    measured: Sequence[Measurements | None] = ()
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
