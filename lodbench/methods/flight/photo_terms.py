"""What one photo says of its pose, and of what all photos share: a block of the joint least squares."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.estimation.edge_alignment import LensErrors, project, projection_slopes
from lodbench.estimation.outline_alignment import (
    FAR_PX,
    LEAST_WEIGHT,
    NOISE_PX,
    Aligner,
    OutlineModel,
    OutlinePoints,
    add_outliers,
    near_distances,
    outline_covariance,
    outline_noise,
)
from lodbench.kernels import add_products, measure_distances, whiten

Floats = NDArray[np.float64]

# More cells than a city is wide, or high; a building's number times its square is one.
_MOST_CELLS = 1 << 20


class RoofParts:
    """The parts that photos have shown so far, numbered in the order they were met.

    Attributes:
        heights_m: (N,) by how much each is higher than in the map, metres.
        building: (N,) row of the scene's building it belongs to.
        drawn_m: (B,) by how much each building of the scene is drawn higher than the map has it, metres.

    Args:
        cell_m: Width of a part, metres.
        buildings: Number of the scene's buildings.
    """

    def __init__(self, cell_m: float, buildings: int) -> None:
        self._cell_m = cell_m
        self.drawn_m: Floats = np.zeros(buildings)
        self._numbers: dict[int, int] = {}
        self.heights_m: Floats = np.zeros(0)
        self.building: NDArray[np.int64] = np.zeros(0, dtype=np.int64)

    def untouched(self) -> RoofParts:
        """Returns the same with no part met."""
        return RoofParts(self._cell_m, len(self.drawn_m))

    def __len__(self) -> int:
        return len(self.building)

    def numbers_of(self, buildings: NDArray[np.int64], places: Floats) -> NDArray[np.int64]:
        """Returns the numbers of the parts that points lie in, (N,); new parts are as high as their building.

        Of (N,) rows of the scene and (N, 2) places east and north, scene metres.
        """
        cells = np.floor(places / self._cell_m).astype(np.int64) + _MOST_CELLS // 2
        # One number for building and cell: of few points in many photos, it is the sorting that takes long.
        keys, inverse = np.unique(
            (buildings * _MOST_CELLS + cells[:, 0]) * _MOST_CELLS + cells[:, 1], return_inverse=True
        )
        unique_keys = keys.tolist()
        new = [key for key in unique_keys if key not in self._numbers]
        if new:
            self._numbers.update(zip(new, range(len(self), len(self) + len(new)), strict=True))
            owners = np.array(new, dtype=np.int64) // _MOST_CELLS**2
            heights = [self._height_of(building) for building in owners.tolist()]
            self.building = np.concatenate([self.building, owners])
            self.heights_m = np.concatenate([self.heights_m, heights])
        numbers = np.array([self._numbers[key] for key in unique_keys], dtype=np.int64)
        return numbers[inverse]

    def roof_and_foot_numbers(
        self, buildings: NDArray[np.int64], places: Floats
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Returns ``numbers_of`` roofs, and of where walls end: these have heights of their own."""
        return self.numbers_of(buildings, places), self.numbers_of(-1 - buildings, places)

    def building_heights(self) -> Floats:
        """Returns (B,) the mean height of each building's parts against the map, metres; 0 without any."""
        is_roof = self.building >= 0
        rows, heights = self.building[is_roof], self.heights_m[is_roof]
        counts = np.bincount(rows, minlength=len(self.drawn_m))
        return np.asarray(np.bincount(rows, heights, len(self.drawn_m)) / np.maximum(counts, 1))

    def _height_of(self, building: int) -> float:
        same = self.heights_m[self.building == building]
        return float(same.mean()) if len(same) else 0.0


# Points of one matrix, which costs their number cubed, and matrices of a photo in the last steps; see
# contour_alignment. One leads there.
_MOST_POINTS, _MOST_SUBSETS = 250, 4
_FEWEST_POINTS, _BORDER_PX = 12, 2.0
# Steps of expectation maximisation.
_MIXTURE_STEPS = 12
# Numbers of a camera: the focal length's change as a share, radial distortion, how far right and down the
# principal point is, shares of the width, and by how much masks are too large, pixels.
LENS = 5
# Columns of slopes: the roof's height, the foot's, and the lens's numbers.
TOP, FOOT, _LENS = 7, 8, slice(9, 9 + LENS)


class Fit(NamedTuple):
    """How well a photo fits: IoU, and overlap with mapped buildings; see ``PhotoTerms``."""

    iou: float
    overlap: float


@dataclass(frozen=True, slots=True, eq=False)
class PhotoTerms:
    """A quadratic in a photo's pose (6), the lens (5), heights of N parts and places of M buildings."""

    # (6 + 5 + N + 2 M, the same) its curvature; places are east, then north, of each building
    information: Floats
    gradient: Floats  # (6 + 5 + N + 2 M,) its slope
    parts: NDArray[np.int64]  # (N,) numbers of the parts it shows
    buildings: NDArray[np.int64]  # (M,) rows of the scene's buildings it shows, ascending
    iou: float  # of silhouette and mask; of edges the share of the model's lines that show one
    overlap: float  # of mask and mapped buildings, see ``mapped_overlap``; of edges as ``iou``
    noise_px: float  # standard deviation of the mask's outline, or of edges
    count: int  # points it rests on


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Points through a lens: where they are looked up, how far they are from a mask's outline or edges."""

    pixels: Floats  # (N, 2) of the working size
    distances: Floats  # (N,) positive inside the mask
    slopes: Floats  # (N, 14) their change per unit of ``OutlinePoints.moves`` and of the lens's numbers
    agreement: Floats  # (N,) 1 where the mask's outline runs as the silhouette's does
    buildings: NDArray[np.int64]  # (N,) rows of the edges' buildings
    places: Floats  # (N, 2) east and north, scene metres


def flight_terms(
    aligners: Sequence[Aligner],
    vectors: Floats,
    lens: Floats,
    roofs: RoofParts,
    reach_px: float | None,
    trust: tuple[float, float],
    threads: Executor | None,
) -> list[PhotoTerms | None]:
    """Returns what photos say at their poses; None for one that too little outline is seen in.

    Args:
        aligners: Of the photos.
        vectors: (P, 6) their poses: metres and degrees.
        lens: (5,) as of ``State.lens``.
        roofs: By how much parts of roofs are higher than in the map; parts that are met are added.
        reach_px: Scale of the robust kernel; None for what the outline's noise calls for.
        trust: Standard deviation of a roof's height as one view sees it, metres; and by how much less
            outlines say than their covariance has it.
        threads: Photos are looked at side by side, None for one after the other; what they say does not
            depend on it.
    """
    spread = map if threads is None else threads.map
    is_last = reach_px is None
    looks = list(spread(lambda k: _look(aligners[k], vectors[k], lens, is_last), range(len(aligners))))
    # In the order of photos.
    parts = [None if one is None else roofs.roof_and_foot_numbers(rows, one.places) for one, _, rows in looks]

    def terms(k: int) -> PhotoTerms | None:
        (one, fit, rows), numbers = looks[k], parts[k]
        if one is None or numbers is None:
            return None
        return _terms(one, fit, rows, numbers, roofs, reach_px, aligners[k].model, trust)

    return list(spread(terms, range(len(aligners))))


def _look(
    aligner: Aligner, vector: Floats, lens: Floats, is_last: bool
) -> tuple[Residuals | None, Fit, NDArray[np.int64]]:
    """Returns a photo's outline points, how well it fits, and the scene's buildings they are of."""
    # The lens bends points afterwards: what is rendered has the focal length as declared.
    points, iou = aligner.outline(np.append(vector, 0.0), aligner.model.size)
    # Only what is answered is compared with mapped buildings alone.
    fit = Fit(iou, aligner.overlap(np.append(vector, 0.0)) if is_last else iou)
    residuals = _through_lens(aligner, points, lens, aligner.model.size)
    if len(residuals.distances) < _FEWEST_POINTS:
        return None, fit, np.zeros(0, dtype=np.int64)
    return residuals, fit, aligner.edges.buildings[residuals.buildings]


def _terms(
    residuals: Residuals,
    fit: Fit,
    rows: NDArray[np.int64],
    numbers: tuple[NDArray[np.int64], NDArray[np.int64]],
    roofs: RoofParts,
    reach_px: float | None,
    model: OutlineModel,
    trust: tuple[float, float],
) -> PhotoTerms:
    """Returns what outline points say, given the numbers of the parts of roofs and feet that they are of."""
    roof, foot = numbers
    # The silhouette stands where roofs are drawn: the heights found move it from there, to first order.
    lifted = residuals.slopes[:, TOP] * (roofs.heights_m[roof] - roofs.drawn_m[rows])
    lifted = lifted + residuals.slopes[:, FOOT] * roofs.heights_m[foot]
    residuals = replace(residuals, distances=residuals.distances + lifted)
    noise_px, weights = _outline_noise(residuals, reach_px)
    lengths_px = model.outline_px, model.roof_part_px
    subsets = _MOST_SUBSETS if reach_px is None else 1
    return summed_up(residuals, rows, numbers, fit, (noise_px, weights), lengths_px, subsets, trust)


def summed_up(
    residuals: Residuals,
    rows: NDArray[np.int64],
    numbers: tuple[NDArray[np.int64], NDArray[np.int64]],
    fit: Fit,
    noise: tuple[float, Floats],
    lengths_px: tuple[float, float],
    most_subsets: int,
    trust: tuple[float, float],
    view_place_m: float = 0.0,
) -> PhotoTerms:
    """Returns the quadratic that residuals make under errors that go together.

    Eq. (F3) of docs/methods/flight.md.

    Args:
        residuals: The residuals, where the heights found have moved the points.
        rows: (N,) of the scene's buildings that they are of.
        numbers: (N,) of the parts of roofs, and (N,) of feet, that they are of.
        fit: How well the photo fits.
        noise: Standard deviation of the residuals, pixels, and (N,) how far each counts.
        lengths_px: Over which they go together, and a roof's errors do, pixels.
        most_subsets: Of points, each under a matrix of its own; the others are left out.
        trust: As of ``flight_terms``.
        view_place_m: Standard deviation of where each building stands as one view shows it, east and north,
            metres: a large one does not outweigh all others.
    """
    parts, column = np.unique(np.stack(numbers), return_inverse=True)
    buildings, place = np.unique(rows, return_inverse=True)
    first = 6 + LENS + len(parts)
    # Columns of each point: its roof's part, its foot's part, and its building's east and north.
    columns = np.vstack([6 + LENS + column.reshape(2, -1), first + 2 * place, first + 2 * place + 1])
    size = first + 2 * len(buildings)
    products = np.zeros((size + 1, size + 1))
    count = len(residuals.distances)
    subsets = -(-count // _MOST_POINTS)
    used = min(subsets, most_subsets)
    for k in range(used):
        chosen = slice(k * subsets // used, None, subsets)
        # Only of what these points are of: in a dense city that is little of what the photo shows.
        here, local = np.unique(columns[:, chosen], return_inverse=True)
        local = 6 + LENS + local.reshape(4, -1)
        where = np.concatenate([np.arange(6 + LENS), here, [size]])
        slopes = residuals.slopes[chosen]
        jacobian = np.zeros((len(slopes), len(where)))
        jacobian[:, :6], jacobian[:, 6 : 6 + LENS] = slopes[:, :6], slopes[:, _LENS]
        lines = np.arange(len(jacobian))
        # A building that stands elsewhere moves as the camera does, the other way.
        by_map = slopes[:, TOP], slopes[:, FOOT], -slopes[:, 0], -slopes[:, 1]
        for numbers_of_column, slope in zip(local, by_map, strict=True):
            jacobian[lines, numbers_of_column] += slope
        jacobian[:, -1] = residuals.distances[chosen]
        whiten(_covariance(residuals, chosen, noise, lengths_px, trust[0], view_place_m), jacobian)
        sums = np.zeros((len(where), len(where)))
        add_products(jacobian, 1.0 / (used * trust[1]), sums)
        products[np.ix_(where, where)] += sums
    products += np.triu(products, 1).T
    return PhotoTerms(products[:-1, :-1], products[:-1, -1], parts, buildings, *fit, noise[0], count)


def _covariance(
    residuals: Residuals,
    chosen: slice,
    noise: tuple[float, Floats],
    lengths_px: tuple[float, float],
    view_roof_m: float,
    view_place_m: float,
) -> Floats:
    """Returns the lower half of the covariance of some points' distances; see ``outline_covariance``."""
    noise_px, weights = noise[0], noise[1][chosen]
    by_map = residuals.slopes[chosen, TOP], residuals.slopes[chosen, FOOT]
    errors_m2 = (0.0, view_roof_m**2, 0.0)
    matrix = outline_covariance(
        residuals.pixels[chosen], *by_map, residuals.buildings[chosen], noise_px, lengths_px, errors_m2
    )
    if view_place_m > 0.0:
        moves, building = view_place_m * residuals.slopes[chosen, :2], residuals.buildings[chosen]
        matrix += np.tril(moves @ moves.T) * (building[:, None] == building)
    add_outliers(matrix, noise_px, weights)
    return matrix


def _through_lens(aligner: Aligner, points: OutlinePoints, lens: Floats, size: tuple[int, int]) -> Residuals:
    """Returns outline points as a lens of another focal length and with distortion shows them.

    Eq. (F6) of docs/methods/flight.md.
    """
    level = aligner.level(size)
    camera = level.camera
    rays = (points.pixels - np.array([camera.cx, camera.cy])) / np.array([camera.fx, camera.fy])
    stretch = (1.0 + lens[0]) * (1.0 + lens[1] * (rays**2).sum(axis=1))
    rays, errors = np.column_stack([rays, np.ones(len(rays))]), LensErrors(*(float(v) for v in lens[:4]))
    pixels, by_lens = project(rays, camera, errors), projection_slopes(rays, camera, errors)[:, :, 3:]
    limit = np.array([camera.width, camera.height]) - _BORDER_PX
    inside = ((pixels > _BORDER_PX) & (pixels < limit)).all(axis=1)
    stretched = points.moves * stretch[:, None, None]
    moves = np.concatenate([stretched, by_lens.transpose(0, 2, 1)], axis=1)[inside]
    count = int(inside.sum())
    distances, slopes, agreement = np.empty(count), np.empty((count, 13)), np.empty(count)
    pixels = np.ascontiguousarray(pixels[inside])
    normals, moves = np.ascontiguousarray(points.normals[inside]), np.ascontiguousarray(moves)
    measure_distances(pixels, normals, moves, level.distance, distances, slopes, agreement)
    slopes = np.column_stack([slopes, -np.ones(count)])
    distances = distances - lens[4]
    return Residuals(
        pixels, distances, slopes, agreement, points.buildings[inside], points.east_north[inside]
    )


def _outline_noise(residuals: Residuals, reach_px: float | None) -> tuple[float, Floats]:
    """Returns the standard deviation of the mask's outline in pixels, and (N,) how far points count.

    Eq. (F4) of docs/methods/flight.md. Points are on the outline, or on none: trees and holes cut into a
    mask, yards and neighbours add to it. How often they do either, and how far the rest is off, comes from
    the view itself (expectation maximisation of a Gaussian between two uniform densities).
    """
    distances, near = residuals.distances, near_distances(residuals.distances, residuals.agreement)
    noise_px = outline_noise(near)
    agreement = np.maximum(residuals.agreement, 1e-3)
    if reach_px is not None:
        kernel = 1.0 / (1.0 + (distances / reach_px) ** 2)
        return noise_px, np.maximum(kernel**2 * agreement, LEAST_WEIGHT)
    shares = np.array([0.8, 0.1, 0.1])
    for _ in range(_MIXTURE_STEPS if len(near) else 0):
        chances = _chances(near, noise_px, shares)
        inside = chances[:, 0] / chances.sum(axis=1)
        noise_px = float(np.clip(np.sqrt(inside @ near**2 / max(inside.sum(), 1e-9)), *NOISE_PX))
        shares = np.maximum((chances / chances.sum(axis=1)[:, None]).mean(axis=0), 0.02)
    chances = _chances(distances, noise_px, shares)
    weights = chances[:, 0] / chances.sum(axis=1) * agreement
    return noise_px, np.maximum(weights, LEAST_WEIGHT)


def _chances(distances: Floats, noise_px: float, shares: Floats) -> Floats:
    """Returns (N, 3) densities of points on the outline, where a mask is cut, and where it is grown."""
    inlier = np.exp(-0.5 * (distances / noise_px) ** 2) / (noise_px * np.sqrt(2.0 * np.pi))
    sides = np.stack([distances < 0.0, distances >= 0.0], axis=1) / FAR_PX
    return np.column_stack([inlier, sides]) * shares
