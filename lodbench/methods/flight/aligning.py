"""The steps of a flight's joint problem: what photos say where they are thought to be, solved, and again.

What edges of a photo say is a block of the least squares as masks' is: the model's lines are laid over the
photo, and each point of them is compared with the edges across it. Unlike a mask that is cut with the map's
help, edges do not depend on where the search began (docs/adr/0014, point 10).

What footprints of the map are wrong about, which no photo shows: cameras go aside with a building. Walls of
a block stand where the lowest level of detail draws them, metres beside those of the hall that is there.
More photos say nothing of that, more buildings do: their errors have little to do with each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymap.city_map import corrected_map
from lodbench.datasets.query import Query
from lodbench.estimation.edge_alignment import (
    LensErrors,
    ModelLines,
    PhotoEdges,
    lines_in_view,
    project_lines,
)
from lodbench.estimation.outline_alignment import Aligner
from lodbench.estimation.state_vector import differences
from lodbench.geometry import Camera
from lodbench.geometry.pose import pose_from_vector
from lodbench.methods.flight.joint import Solution, State, solve
from lodbench.methods.flight.params import FlightParams
from lodbench.methods.flight.photo_terms import Fit, PhotoTerms, Residuals, RoofParts, flight_terms, summed_up
from lodbench.photos.pictures import read_picture
from lodbench.segmentation import binary_mask

Floats = NDArray[np.float64]

# Edges are looked at in photos so wide, pixels; points of lines are so far apart, farther in a dense city.
_EDGES_WIDTH, _SPACING_PX, _MOST_POINTS = 1200, 4.0, 1000
# Standard deviations of how far edges lie from the model's lines, per scale of the masks' robust kernel, and
# in the last steps, pixels; how far is looked, deviations.
_SIGMA_PER_REACH, _SIGMA_PX, _SIGMAS = 0.4, 1.2, 3.0
# Errors of a line go together over this length, and those of a roof, pixels.
_LENGTHS_PX = (80.0, 120.0)
# Standard deviation of where each building stands, east and north, metres; see ``summed_up``.
_VIEW_PLACE_M = 0.3
_NOISE_PX, _BORDER_PX, _LEAST_WEIGHT, _FEWEST_POINTS = (0.7, 12.0), 3.0, 1e-6, 12
# Where walls end says nothing: hedges, cars and slopes hide it, and of a map the ground errs most.
# On two real flights the bases of walls show 1 to 2.5 m above the map's (docs/adr/0012, point 6).
_LOWEST_RISE = 0.2
# Matrices of points in the last steps; one leads there.
_MOST_SUBSETS = 4


class EdgePhoto(NamedTuple):
    """A photo whose edges are compared with lines."""

    edges: PhotoEdges  # of the photo
    camera: Camera  # as declared, of the size of the edges
    city_map: CityMap  # whose lines


def edge_photo(query: Query, city_map: CityMap) -> EdgePhoto | None:
    """Returns a query's photo; None for one that cannot be read."""
    picture = None if query.image is None else read_picture(query.image)
    if picture is None:
        return None
    camera = query.camera.scaled_to_width(min(_EDGES_WIDTH, query.camera.width))
    return EdgePhoto(PhotoEdges(picture, (camera.width, camera.height)), camera, city_map)


def edge_terms(
    photos: Sequence[EdgePhoto | None],
    vectors: Floats,
    lens: Floats,
    roofs: RoofParts,
    reach_px: float | None,
    trust: tuple[float, float],
    threads: Executor | None,
) -> list[PhotoTerms | None]:
    """Returns what photos' edges say at their poses; None for one that shows too few lines or is None.

    Arguments as of ``flight_terms``; edges narrow with the scale of the masks' robust kernel, None in the
    last steps.
    """
    spread = map if threads is None else threads.map
    errors = LensErrors(*(float(v) for v in lens[:4]))

    def look(k: int) -> ModelLines | None:
        photo = photos[k]
        if photo is None:
            return None
        camera = errors.pinhole(photo.camera)
        lines = lines_in_view(photo.city_map, camera, pose_from_vector(vectors[k]), _SPACING_PX)
        lines = lines.of(lines.relative_heights > _LOWEST_RISE)
        few = -(-len(lines) // _MOST_POINTS)
        return lines.of(np.arange(len(lines)) % few == 0) if few > 1 else lines

    shown = list(spread(look, range(len(photos))))
    # In the order of photos.
    parts = [
        None if each is None else roofs.roof_and_foot_numbers(each.buildings, each.points[:, :2])
        for each in shown
    ]

    def terms(k: int) -> PhotoTerms | None:
        photo, lines, numbers = photos[k], shown[k], parts[k]
        if photo is None or lines is None or numbers is None or len(lines) < _FEWEST_POINTS:
            return None
        return _terms(photo, lines, vectors[k], errors, numbers, roofs, reach_px, trust)

    return list(spread(terms, range(len(photos))))


def _terms(
    photo: EdgePhoto,
    lines: ModelLines,
    vector: Floats,
    errors: LensErrors,
    numbers: tuple[NDArray[np.int64], NDArray[np.int64]],
    roofs: RoofParts,
    reach_px: float | None,
    trust: tuple[float, float],
) -> PhotoTerms | None:
    """Returns what one photo's edges say, given the numbers of the parts of roofs and feet of its points."""
    sigma_px = _SIGMA_PX if reach_px is None else max(_SIGMA_PER_REACH * reach_px, _SIGMA_PX)
    roof_parts, foot_parts = numbers
    # Lines are of roofs as drawn: they are laid where the heights found so far have them.
    points = lines.points.copy()
    lifted_m = roofs.heights_m[roof_parts] - roofs.drawn_m[lines.buildings]
    points[:, 2] += (
        lines.relative_heights * lifted_m + (1.0 - lines.relative_heights) * roofs.heights_m[foot_parts]
    )
    laid = project_lines(points, lines.along, photo.camera, vector, errors)
    size = np.array([photo.camera.width, photo.camera.height])
    inside = ((laid.pixels > _BORDER_PX) & (laid.pixels < size - _BORDER_PX)).all(axis=1)
    if np.count_nonzero(inside) < _FEWEST_POINTS:
        return None
    pixels, normals = laid.pixels[inside], laid.normals[inside]
    candidates = photo.edges.across(pixels, normals, _SIGMAS * sigma_px)
    distances, chances = candidates.expected(len(pixels), sigma_px)
    rises, up = lines.relative_heights[inside], laid.by_place[inside, 2]
    camera, none = laid.by_camera[inside], np.zeros(len(pixels))
    slopes = np.column_stack([camera[:, :6], none, up * rises, up * (1.0 - rises), camera[:, 6:], none])
    residuals = Residuals(
        pixels, -distances, slopes, chances, lines.buildings[inside], lines.points[inside, :2]
    )
    near = distances[chances > 0.5]
    spread_px = 1.4826 * float(np.median(np.abs(near))) if len(near) else _NOISE_PX[1]
    noise_px = float(np.clip(spread_px, *_NOISE_PX))
    return summed_up(
        residuals,
        lines.buildings[inside],
        (roof_parts[inside], foot_parts[inside]),
        Fit(*[float(chances.mean())] * 2),
        (noise_px, np.maximum(chances, _LEAST_WEIGHT)),
        _LENGTHS_PX,
        _MOST_SUBSETS if reach_px is None else 1,
        trust,
        _VIEW_PLACE_M,
    )


# Scales of the robust kernel in the joint steps, first and last, pixels of the fine size.
_REACHES_PX = (24.0, 4.0)


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """A flight at the end of its steps; photos in the order of the state's."""

    state: State  # poses, and what photos share
    terms: Sequence[PhotoTerms | None]  # what each photo says there
    solution: Solution  # the last normal equations
    # The same with the map as wrong as declared: one building that errs is noticed whether or not the others
    # do
    as_declared: Solution


def align(
    queries: Sequence[Query],
    state: State,
    city_map: CityMap,
    params: FlightParams,
    evidence: Evidence | None = None,
) -> Aligned:
    """Returns where a flight ends from a state, which steps move: robust kernels that narrow, then none.

    ``evidence`` is ``Evidence.of`` the same queries, map and parameters, where there is one already.
    """
    evidence = evidence or Evidence.of(queries, city_map, params)
    steps = params.steps
    reaches: list[float | None] = [*map(float, np.geomspace(*_REACHES_PX, steps)), *([None] * steps)]
    # As the map has them: of roofs that earlier steps drew higher, none is drawn so here.
    state.roofs.drawn_m = np.zeros_like(state.roofs.drawn_m)
    with side_by_side(city_map.threads) as threads:
        for number, reach_px in enumerate(reaches):
            if number in (steps // 2, steps):
                drawn, state.roofs.drawn_m = corrected_map(city_map, state.roofs.building_heights())
                evidence = evidence.over(drawn)
            terms = evidence.terms(state, reach_px, params, threads)
            if number >= steps:
                _leave_out_lost(state, terms, params)
            solution = solve(state, terms, params)
            if number == len(reaches) - 1:
                as_declared = solve(replace(state, scales=np.ones_like(state.scales)), terms, params)
            state.step(solution)
            if params.narrows and steps <= number < len(reaches) - 1:
                state.scales = solution.scales()
    return Aligned(state, terms, solution, as_declared)


@dataclass(frozen=True, slots=True)
class Evidence:
    """What a flight's photos are compared by: outlines of masks, or edges."""

    masks: Sequence[Aligner] = ()  # aligners of all photos; none where edges say the poses
    photos: Sequence[EdgePhoto | None] = ()  # their edges; none where masks do

    @classmethod
    def of(cls, queries: Sequence[Query], city_map: CityMap, params: FlightParams) -> Evidence:
        """Returns that of a flight's photos, over a map."""
        if params.single == "region":
            return cls(photos=[edge_photo(query, city_map) for query in queries])
        return cls(masks=[Aligner(query, city_map, params.photo().outline_model()) for query in queries])

    def over(self, city_map: CityMap) -> Evidence:
        """Returns the same over another map."""
        photos = [None if photo is None else photo._replace(city_map=city_map) for photo in self.photos]
        return Evidence([aligner.over(city_map) for aligner in self.masks], photos)

    def terms(
        self, state: State, reach_px: float | None, params: FlightParams, threads: Executor | None
    ) -> list[PhotoTerms | None]:
        """Returns what photos say where a state has them; see ``flight_terms``."""
        here = state.vectors, state.lens, state.roofs, reach_px
        if self.photos:
            return edge_terms(self.photos, *here, params.trust(), threads)
        return flight_terms(self.masks, *here, params.trust(), threads)


def _leave_out_lost(state: State, terms: Sequence[PhotoTerms | None], params: FlightParams) -> None:
    """Takes the weight from photos that are further from where the flight says than sensors err.

    Eq. (F15) of docs/methods/flight.md.
    """
    gaps = differences(state.vectors, state.priors) - state.offset
    away = np.sqrt(((gaps / state.own_sigmas(params.own_sigmas())) ** 2).mean(axis=1))
    fits = np.array([0.0 if term is None else term.overlap for term in terms])
    poor = 0.5 * float(np.median(fits))
    lost = (away > params.lost_sigmas) | (fits < poor)
    state.weights = np.where(lost, 0.0, 1.0)
    state.reasons = {k: _reason(terms[k], away[k], fits[k] < poor) for k in np.flatnonzero(lost).tolist()}


def mean_iou(terms: Sequence[PhotoTerms | None]) -> float:
    """Returns the mean IoU of silhouettes and masks, 0 for photos that say nothing."""
    return float(np.mean([0.0 if term is None else term.iou for term in terms]))


def side_by_side(threads: int) -> AbstractContextManager[Executor | None]:
    """Returns who looks at photos; None for one thread, the caller's: contexts of OpenGL belong to one."""
    return ThreadPoolExecutor(threads) if threads > 1 else nullcontext()


def _reason(term: PhotoTerms | None, away: float, fits_badly: bool) -> str:
    if term is None:
        return "no building outline in its mask at the pose given by the other photos"
    if fits_badly:
        return f"its mask fits the map less than half as well as the others' (overlap {term.overlap:.2f})"
    return f"its position is off that from the other photos by {away:.0f} times the sensors' error"


def footprint_covariance(
    terms: Sequence[PhotoTerms | None], roofs: RoofParts, footprint_m: float, size: int
) -> Floats:
    """Returns the covariance of what all cameras are off by with the buildings they show, (size, size).

    Eq. (F17) of docs/methods/flight.md. East and north come first, square metres; all else is 0. One
    building's footprint is off by ``footprint_m`` along each axis.
    """
    shown = [roofs.building[term.parts] for term in terms if term is not None]
    buildings = np.concatenate([np.zeros(0, np.int64), *shown])
    counts = np.bincount(buildings[buildings >= 0]).astype(np.float64)
    covariance = np.zeros((size, size))
    # Weights as parts of roofs that photos show: so many buildings of one weight would say as much.
    alike = counts.sum() ** 2 / (counts**2).sum() if counts.any() else 1.0
    covariance[0, 0] = covariance[1, 1] = footprint_m**2 / alike
    return covariance


# Masks are compared at this width, pixels.
_WIDTH = 150


def flight_error(
    queries: Sequence[Query], priors: Floats, offsets: Floats, city_map: CityMap, params: FlightParams
) -> tuple[Floats, float]:
    """Returns (6,) what the sensors of a flight are wrong about alike, and the mean IoU with it.

    Eq. (F14) of docs/methods/flight.md.

    Args:
        queries: The photos.
        priors: (P, 6) what the sensors said, metres and degrees.
        offsets: (N, 6) candidates: poses that photos have by themselves, less what was said of them.
        city_map: Draws silhouettes.
        params: How many candidates, and judges.
    """
    judges = _spread(len(queries), params.votes)
    tried = np.concatenate([np.zeros((1, 6)), offsets[_spread(len(offsets), params.votes)]])
    ious = np.array([_mean_iou(offset, queries, priors, judges, city_map) for offset in tried])
    best = tried[int(np.argmax(ious))]
    # Photos that agree with the best: their mean is surer than each.
    width = 3.0 * params.own_sigmas() + 0.25 * params.shared_sigmas()
    agreeing = offsets[(np.abs(offsets - best) < width).all(axis=1)]
    if len(agreeing) > 2:
        middle = np.median(agreeing, axis=0)
        iou = _mean_iou(middle, queries, priors, judges, city_map)
        if iou > ious.max():
            return middle, iou
    return best, float(ious.max())


def _mean_iou(
    offset: Floats, queries: Sequence[Query], priors: Floats, judges: NDArray[np.int64], city_map: CityMap
) -> float:
    total = 0.0
    for k in judges:
        camera = queries[k].camera
        small = camera.scaled_to_width(_WIDTH)
        mask = binary_mask(queries[k].mask, small.width, small.height)
        shown = city_map.render(small, pose_from_vector(priors[k] + offset))
        union = np.count_nonzero(shown | mask)
        total += np.count_nonzero(shown & mask) / union if union else 0.0
    return total / len(judges)


def _spread(count: int, most: int) -> NDArray[np.int64]:
    """Returns at most so many indices, spread evenly."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(np.int64))


Rows = NDArray[np.int64]

# Other starts, metres from where the first one ended: corners of a tetrahedron, so that all ways count alike.
STARTS_M = 1.7 * np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
# Ends whose silhouettes overlap the masks less than the best's by more than this are no answers.
_WORSE_IOU = 0.02
# Photos that start again.
_MOST_PHOTOS = 40


def restarted(count: int, tied: bool) -> Rows:
    """Returns the numbers of the photos of a flight that start again, ascending.

    Of a longer flight some from all over it, since those of one stretch may all look one way; but those in
    its middle where neighbours are tied to each other, since photos far apart are not.
    """
    used = min(count, _MOST_PHOTOS)
    if tied:
        return np.arange(used) + (count - used) // 2
    return np.linspace(0, count - 1, used).round().astype(np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Ends:
    """Where starts end, against where the first does."""

    # (N, 6) by how much photos end elsewhere in the mean, metres and degrees; the first is none
    shifts: Floats
    constants: Floats  # (N, 13) what photos share there, see ``joint``

    @property
    def middle(self) -> tuple[Floats, Floats]:
        """Returns the mean shift, (6,), and by how much the constants' mean differs from the first's."""
        return self.shifts.mean(axis=0), self.constants.mean(axis=0) - self.constants[0]

    @property
    def covariances(self) -> tuple[Floats, Floats]:
        """Returns the covariance of an end, (6, 6), and of the constants, (13, 13); zero for one end."""
        if len(self.shifts) == 1:
            return np.zeros((6, 6)), np.zeros((self.constants.shape[1],) * 2)
        return np.cov(self.shifts, rowvar=False), np.cov(self.constants, rowvar=False)


def ends_of(ends: Sequence[tuple[Floats, Floats, float]]) -> Ends:
    """Returns where starts end, but for those that fit worse. Eq. (F16) of docs/methods/flight.md.

    Args:
        ends: Of each end (P, 6) poses of the same photos, (13,) what they share, and the mean IoU; the first
            is the one that the others are compared with.
    """
    best = max(iou for _, _, iou in ends)
    kept = [ends[0], *(end for end in ends[1:] if end[2] > best - _WORSE_IOU)]
    shifts = [np.median(differences(vectors, ends[0][0]), axis=0) for vectors, _, _ in kept]
    return Ends(np.array(shifts), np.array([constants for _, constants, _ in kept]))
