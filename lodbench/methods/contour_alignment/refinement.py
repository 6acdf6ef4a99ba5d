"""The last steps: hypotheses of what is wrong with map and camera, followed side by side and weighed.

A hypothesis is a world (how roofs and bases err), a prior's tilt as told or worse, and a lens likewise.
Each step is Gauss-Newton's to the optimum of the likeliest; at the end all that are left are a mixture of
Gaussians, weighed by their evidence: the density of the outline with pose and errors integrated out.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from lodbench.methods.contour_alignment.alignment import Aligner, shortened
from lodbench.methods.contour_alignment.likelihood import (
    CAMERA,
    TRACKS,
    Sums,
    WorldErrors,
    deal_out,
    density_anywhere,
    sum_up,
)
from lodbench.methods.contour_alignment.params import Params

Floats = NDArray[np.float64]

# Steps before the prior's tilt and the lens are held as told.
_FREE_STEPS = 3
# By how much less evidence, in its logarithm, a world is given up after a step, a track after the free ones.
_HOPELESS_WORLD, _HOPELESS_TRACK = 12.0, 15.0


@dataclass(frozen=True, slots=True, eq=False)
class Mode:
    """One hypothesis: a Gaussian.

    Attributes:
        world: How the city differs from the map.
        is_tilt_free: Whether the prior's tilt is worse than told.
        is_lens_free: Whether the lens is.
        step: (10,) from where it was linearised to its optimum: the camera's numbers and the shared errors.
        information: (10, 10) there, the prior included.
        evidence: Logarithm, odds included, up to a constant.
    """

    world: WorldErrors
    is_tilt_free: bool
    is_lens_free: bool
    step: Floats
    information: Floats
    evidence: float

    @property
    def key(self) -> tuple[str, bool, bool]:
        """Returns what tells it from others."""
        return self.world.name, self.is_tilt_free, self.is_lens_free


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A pose at the end of its steps.

    Attributes:
        vector: (7,) centre in metres, angles in degrees and percent of the lens, which the modes' steps
            lead away from.
        modes: What is left of the hypotheses, the likeliest first.
        weights: Their probabilities.
        overlap: Of mask and mapped buildings, see ``mapped_overlap``.
    """

    vector: Floats
    modes: tuple[Mode, ...]
    weights: Floats
    overlap: float


@dataclass(slots=True, eq=False)
class _Track:
    """Worlds that share a camera, with what is thought of their shared errors."""

    vector: Floats
    shared: dict[WorldErrors, Floats]
    is_lens_free: bool
    modes: list[Mode]

    @property
    def evidence(self) -> float:
        return max(mode.evidence for mode in self.modes)


def refine(aligner: Aligner, vector: Floats, params: Params) -> Refined | None:
    """Returns what is left of the hypotheses after the last steps; None if too little outline is seen."""
    tracks = [_Track(vector, {w: w.shared_mean for w in worlds}, is_free, []) for worlds, is_free in TRACKS]
    for step in range(params.final_steps + 1):
        tracks = [track for track in tracks if _weigh(aligner, track, params, step)]
        if not tracks:
            return None
        if step >= min(_FREE_STEPS, params.final_steps):
            best = max(track.evidence for track in tracks)
            tracks = [track for track in tracks if track.evidence > best - _HOPELESS_TRACK]
    return _mixture(aligner, tracks)


def _mixture(aligner: Aligner, tracks: list[_Track]) -> Refined:
    """Returns what is left as a mixture of Gaussians: Eq. (C12) of docs/methods/contour_alignment.md."""
    best = max(tracks, key=lambda track: track.evidence)
    # A hypothesis followed on several tracks counts once: where it explains most.
    found: dict[tuple[str, bool, bool], Mode] = {}
    for track in tracks:
        apart = np.append(track.vector - best.vector, np.zeros(3))
        for mode in track.modes:
            known = found.get(mode.key)
            if known is None or known.evidence < mode.evidence:
                found[mode.key] = replace(mode, step=mode.step + apart)
    modes = sorted(found.values(), key=lambda mode: -mode.evidence)
    weights = np.exp(np.array([mode.evidence for mode in modes]) - modes[0].evidence)
    return Refined(best.vector, tuple(modes), weights / weights.sum(), aligner.overlap(best.vector))


def _weigh(aligner: Aligner, track: _Track, params: Params, step: int) -> bool:
    """Weighs a track's hypotheses where it stands, and moves it on; False if no outline is seen."""
    here = aligner.measure(track.vector, params.fine_size)
    if here is None:
        return False
    points = deal_out(here)
    anywhere = density_anywhere(points, *next(iter(track.shared.items())), params)
    sums = {world: sum_up(points, world, shared, params, anywhere) for world, shared in track.shared.items()}
    offset = aligner.offset(track.vector)
    track.modes = [
        mode
        for world, said in sums.items()
        for mode in _modes(offset, world, track.shared[world], said, params)
    ]
    if step == params.final_steps:
        return True
    is_free = step < _FREE_STEPS
    mode = _likeliest(
        track.modes, needs_tilt=is_free and not track.is_lens_free, needs_lens=is_free or track.is_lens_free
    )
    move = shortened(mode.step[:CAMERA])
    track.shared = {
        world: track.shared[world] + _shared_step(world, track.shared[world], said, move)
        for world, said in sums.items()
    }
    track.vector = track.vector + move
    if step >= 1:
        best = {world: max(m.evidence for m in track.modes if m.world is world) for world in sums}
        track.shared = {
            w: shared for w, shared in track.shared.items() if best[w] > track.evidence - _HOPELESS_WORLD
        }
    return True


def _likeliest(modes: Iterable[Mode], *, needs_tilt: bool, needs_lens: bool) -> Mode:
    allowed = (m for m in modes if m.is_tilt_free >= needs_tilt and m.is_lens_free >= needs_lens)
    return max(allowed, key=lambda mode: mode.evidence)


def _modes(offset: Floats, world: WorldErrors, shared: Floats, said: Sums, params: Params) -> list[Mode]:
    """Returns a world's hypotheses of tilt and lens, given how far from the prior the camera stands, (7,).

    Eq. (C11) of docs/methods/contour_alignment.md.
    """
    away = np.concatenate([offset, shared - world.shared_mean])
    modes = []
    for is_tilt_free, is_lens_free in product((False, True), repeat=2):
        camera = params.camera_sigmas(is_tilt_free=is_tilt_free, is_lens_free=is_lens_free)
        precision = np.array([*camera, *world.shared_sigmas]) ** -2.0
        information = said.information + np.diag(precision)
        gradient = said.gradient + precision * away
        step = -np.linalg.solve(information, gradient)
        # Laplace: the height of the peak times its width, over the prior's.
        evidence = said.log_density - 0.5 * float(precision @ away**2) - 0.5 * float(gradient @ step)
        evidence -= 0.5 * float(np.linalg.slogdet(information)[1] - np.log(precision).sum())
        evidence += float(np.log(world.odds * params.camera_odds(is_tilt_free, is_lens_free)))
        modes.append(Mode(world, is_tilt_free, is_lens_free, step, information, evidence))
    return modes


def _shared_step(world: WorldErrors, shared: Floats, said: Sums, move: Floats) -> Floats:
    """Returns (3,) the step of the shared errors to their optimum, given the camera's, (7,)."""
    precision = world.shared_sigmas**-2.0
    information = said.information[CAMERA:, CAMERA:] + np.diag(precision)
    gradient = said.gradient[CAMERA:] + precision * (shared - world.shared_mean)
    return np.asarray(-np.linalg.solve(information, gradient + said.information[CAMERA:, :CAMERA] @ move))
