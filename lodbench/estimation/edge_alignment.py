"""Lines of a model through a camera not quite as declared; a pose refined by a photo's edges along them.

Refined is by Gauss-Newton on distances of roof lines to parallel edges.

A point of a model's line shows one of the photo's edges nearby, or none. Its edge is unknown: the likelihood
is a mixture over all edges across the line and a uniform background, whose density is measured on the photo
(expectation and maximisation over a narrowing deviation; docs/adr/0011, point 11).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.citymodel.extrude import pitched_blocks
from lodbench.citymodel.scene import Scene, floors_and_rises
from lodbench.estimation.optimization import Quadratic
from lodbench.estimation.state_vector import NUM_POSE, differences
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.geometry.angles import rotation_from_euler
from lodbench.geometry.pose import pose_from_vector, rotation_derivatives
from lodbench.rendering.photo_bins import gradient_forms

Floats = NDArray[np.float64]

# Points are taken for no nearer than this, metres.
_NEAREST_M = 1e-6


@dataclass(frozen=True, slots=True)
class LensErrors:
    """Errors of a camera's declared intrinsics."""

    focal: float = 0.0  # by which share the focal length is longer than declared
    k1: float = 0.0  # radial distortion, normalised coordinates
    right: float = 0.0  # how far right of the declared principal point the true one is, share of the width
    down: float = 0.0  # how far below, share of the width

    def pinhole(self, camera: Camera) -> Camera:
        """Returns a pinhole as near to a camera with these errors as one can be, to draw with."""
        return replace(
            camera,
            fx=camera.fx * (1.0 + self.focal),
            fy=camera.fy * (1.0 + self.focal),
            cx=camera.cx + self.right * camera.width,
            cy=camera.cy + self.down * camera.width,
        )


EXACT = LensErrors()


def project(local: Floats, camera: Camera, lens: LensErrors = EXACT) -> Floats:
    """Returns pixels (..., 2) of points in camera axes (..., 3), metres; pixel centres at +0.5."""
    away = local[..., :2] / np.maximum(local[..., 2:], _NEAREST_M)
    stretch = 1.0 + lens.k1 * (away**2).sum(axis=-1, keepdims=True)
    focal = np.array([camera.fx, camera.fy]) * (1.0 + lens.focal)
    centre = np.array([camera.cx, camera.cy]) + camera.width * np.array([lens.right, lens.down])
    return np.asarray(away * stretch * focal + centre)


def projection_slopes(local: Floats, camera: Camera, lens: LensErrors = EXACT) -> Floats:
    """Returns (N, 2, 7) how pixels of points (N, 3) change with these, then with ``LensErrors``."""
    depth = np.maximum(local[:, 2], _NEAREST_M)
    away = local[:, :2] / depth[:, None]
    square = (away**2).sum(axis=1)
    stretch = 1.0 + lens.k1 * square
    declared = np.array([camera.fx, camera.fy])
    focal = declared * (1.0 + lens.focal)
    by_away = stretch[:, None, None] * np.eye(2) + 2.0 * lens.k1 * away[:, :, None] * away[:, None, :]
    slopes = np.zeros((len(local), 2, 7))
    slopes[:, :, :2] = by_away / depth[:, None, None]
    slopes[:, :, 2] = -(by_away @ away[..., None])[..., 0] / depth[:, None]
    slopes[:, :, :3] *= focal[:, None]
    slopes[:, :, 3] = away * stretch[:, None] * declared
    slopes[:, :, 4] = away * square[:, None] * focal
    slopes[:, 0, 5] = slopes[:, 1, 6] = camera.width
    return slopes


# Least angle between two faces to be a line, degrees; the shortest line, pixels.
_CREASE_DEG, _SHORTEST_PX = 25.0, 6.0
# What is lower than this has no height that could err, metres.
_FLAT_M = 0.1
# The distance along a line to the point that gives its direction in the picture, fraction of its length.
_FURTHER = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class ModelLines:
    """N points spread evenly along the lines of a model that a view shows."""

    points: Floats  # (N, 3) scene metres
    along: Floats  # (N, 3) from where its line begins to where it ends, metres
    # (N,) heights as fractions of the building's height: 0 base, 1 ridge. Also how much a point moves up if
    # roofs are 1 m higher; if bases are, it moves by the rest.
    relative_heights: Floats
    buildings: NDArray[np.int64]  # (N,) rows of the scene
    lines: NDArray[np.int64]  # (N,) numbers of the lines
    lengths_px: Floats  # (N,) length of line that each stands for, pixels
    is_contour: NDArray[np.bool_]  # (N,) whether the building ends there as the view shows it

    def __len__(self) -> int:
        return len(self.points)

    def of(self, chosen: NDArray[np.bool_]) -> ModelLines:
        """Returns some of the points."""
        parts = (getattr(self, name)[chosen] for name in self.__slots__)
        return ModelLines(*parts)


def lines_in_view(city_map: CityMap, camera: Camera, pose: Pose, spacing_px: float) -> ModelLines:
    """Returns points on the lines of a map that are visible from a pose, ``spacing_px`` pixels apart."""
    (view,) = city_map.edges(camera, pose.rotation[None], pose.center[None], _CREASE_DEG)
    lengths = np.linalg.norm(view.pixels[:, 1] - view.pixels[:, 0], axis=1)
    rows = np.flatnonzero(view.is_visible & (lengths > _SHORTEST_PX))
    counts = np.maximum((lengths[rows] / spacing_px).astype(np.int64), 1)
    which = np.repeat(np.arange(len(rows)), counts)
    place = (np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[which]
    rows = rows[which]
    start, along = view.points[rows, 0], view.points[rows, 1] - view.points[rows, 0]
    points, buildings = start + place[:, None] * along, view.building[rows]
    return ModelLines(
        points=points,
        along=along,
        relative_heights=relative_heights(city_map.scene, points[:, 2], buildings),
        buildings=buildings,
        lines=which,
        lengths_px=lengths[rows] / counts[which],
        is_contour=view.kind[rows] == 1,
    )


def relative_heights(scene: Scene, heights_m: Floats, buildings: NDArray[np.int64]) -> Floats:
    """Returns (N,) at which share of its building's height each height lies; 1 for what is flat."""
    floors, rises = (each[buildings] for each in floors_and_rises(scene))
    tall = rises > _FLAT_M
    relative = (heights_m - floors) / np.where(tall, rises, 1.0)
    return np.asarray(np.where(tall, np.clip(relative, 0.0, 1.0), 1.0))


# Columns of slopes: x, y, z (metres), pitch, roll, yaw (degrees), then ``LensErrors`` in its order.
NUM_POSE_AND_LENS = 10


@dataclass(frozen=True, slots=True, eq=False)
class Projected:
    """Points of lines in a picture."""

    pixels: Floats  # (N, 2) pixels; pixel centres at +0.5
    normals: Floats  # (N, 2) unit, across their lines
    by_camera: Floats  # (N, 10) how far each moves along its normal per unit of the pose and ``LensErrors``
    by_place: Floats  # (N, 3) the same per metre that the point itself moves, scene axes


def project_lines(
    points: Floats, along: Floats, camera: Camera, vector: Floats, lens: LensErrors
) -> Projected:
    """Returns points of lines as a lens shows them, with their slopes.

    Args:
        points: (N, 3) scene metres.
        along: (N, 3) their lines' directions, metres.
        camera: Pinhole as declared.
        vector: (6,) centre in metres, pitch, roll and yaw in degrees.
        lens: How the camera differs from that.
    """
    rotation = rotation_from_euler(EulerAngles(*(float(v) for v in vector[3:6])))
    away = points - vector[:3]
    local = away @ rotation.T
    pixels, per_local = project(local, camera, lens), projection_slopes(local, camera, lens)
    line = project((away + _FURTHER * along) @ rotation.T, camera, lens) - pixels
    line /= np.maximum(np.linalg.norm(line, axis=1), 1e-12)[:, None]
    normals = np.stack([-line[:, 1], line[:, 0]], axis=1)
    across = np.einsum("ni,nij->nj", normals, per_local[:, :, :3])
    by_place = across @ rotation
    turns = np.einsum("kij,nj->nki", rotation_derivatives(vector), away)
    by_angles = np.einsum("ni,nki->nk", across, turns)
    by_lens = np.einsum("ni,nij->nj", normals, per_local[:, :, 3:])
    return Projected(pixels, normals, np.concatenate([-by_place, by_angles, by_lens], axis=1), by_place)


# The least mean strength of a photo's gradient, CIE Lab units (0 to 100) per pixel.
_LEAST_MEAN = 0.05
# Distance of samples across a line, pixels: at whole pixels interpolation flattens all samples alike and does
# not move a maximum (at half pixels it moves it by up to a quarter of a pixel).
_STEP_PX = 1.0
# The least strength of an edge, and the largest that counts, in mean strengths around it.
_WEAKEST, _STRONGEST = 0.8, 4.0
# The least fraction of its squared gradient across the line: within 26 degrees of the line's normal.
_PARALLEL = 0.8
# Rows of a picture that OpenCV interpolates in one call.
_MOST_ROWS = 30_000
# The weight of "no edge" of a point: that of an edge of mean strength, two standard deviations off.
_NO_EDGE = float(np.exp(-2.0))


class Candidates(NamedTuple):
    """Edges of the photo that points of lines may show."""

    points: NDArray[np.int64]  # (M,) indices of the points
    distances: Floats  # (M,) distances from the point along its normal, pixels
    strengths: Floats  # (M,) strengths, in mean strengths of the photo around, at most 4

    def nearest(self, count: int) -> Floats:
        """Returns (count,) the distance of the nearest candidate of each point, pixels; inf without one."""
        distances = np.full(count, np.inf)
        np.minimum.at(distances, self.points, np.abs(self.distances))
        return distances

    def expected(self, count: int, sigma_px: float) -> tuple[Floats, Floats]:
        """Returns (count,) expected distances, and (count,) probabilities that there is an edge.

        Eq. (F5) of docs/methods/flight.md; ``sigma_px`` is the deviation of the photo's edge from the line.
        """
        likely = self.strengths * np.exp(-0.5 * (self.distances / sigma_px) ** 2)
        sums = np.bincount(self.points, likely, count)
        means = np.bincount(self.points, likely * self.distances, count) / np.maximum(sums, 1e-12)
        return means, sums / (sums + _NO_EDGE)


class PhotoEdges:
    """How strongly a photo changes along any direction at any place of it.

    Args:
        photo: (H, W) or (H, W, 3) BGR, 8 bits.
        size: Width and height to work at, pixels.
        blur_px: Standard deviation of the blur before, pixels of that size.

    Attributes:
        size: As given.
    """

    def __init__(self, photo: NDArray[Any], size: tuple[int, int], blur_px: float = 1.0) -> None:
        self.size = size
        self._forms = gradient_forms(photo, size, blur_px, _LEAST_MEAN)

    def across(self, pixels: Floats, normals: Floats, reach_px: float) -> Candidates:
        """Returns the edges across lines, to a fraction of a pixel.

        Points of lines, (N, 2), are pixels of the size with centres at +0.5, normals (N, 2) unit.
        """
        steps = int(np.ceil(reach_px / _STEP_PX)) + 1
        offsets = _STEP_PX * np.arange(-steps, steps + 1)
        positions = (pixels[:, None] + offsets[:, None] * normals[:, None] - 0.5).astype(np.float32)
        forms = self._forms_at(positions)
        x, y = normals[:, None, 0], normals[:, None, 1]
        squares = forms[..., 0] * x**2 + 2.0 * forms[..., 1] * x * y + forms[..., 2] * y**2
        is_parallel = squares > _PARALLEL * (forms[..., 0] + forms[..., 2])
        strengths = np.sqrt(np.maximum(squares, 0.0))
        before, here, after = strengths[:, :-2], strengths[:, 1:-1], strengths[:, 2:]
        is_peak = (here >= before) & (here > after) & (here > _WEAKEST) & is_parallel[:, 1:-1]
        points, peaks = np.nonzero(is_peak)
        one, middle, other = (part[points, peaks] for part in (before, here, after))
        # The maximum of the parabola through three samples.
        shift = 0.5 * (one - other) / np.minimum(one - 2.0 * middle + other, -1e-12)
        distances = offsets[peaks + 1] + _STEP_PX * np.clip(shift, -0.5, 0.5)
        return Candidates(points, distances, np.minimum(middle, _STRONGEST))

    def _forms_at(self, positions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns (N, S, 3) the forms at (N, S, 2), pixel centres whole; OpenCV takes no N of 0 or 2^15."""
        forms = np.empty((*positions.shape[:2], 3), dtype=np.float32)
        for first in range(0, len(positions), _MOST_ROWS):
            columns, rows = (
                np.ascontiguousarray(positions[first : first + _MOST_ROWS, :, k]) for k in (0, 1)
            )
            forms[first : first + _MOST_ROWS] = cv2.remap(
                self._forms, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
            )
        return forms


# The distance between points along lines, and the least distance of points from the border, pixels.
_SPACING_PX, _BORDER_PX = 6.0, 3.0
# Standard deviations of an edge about its line, pixels: from an answer's error to that of map and edges.
_SIGMAS_PX = (8.0, 6.0, 4.0, 3.0, 2.0, 1.5, 1.5, 1.5)
# Gauss-Newton steps at each; how far edges are looked for, standard deviations; the least number of points.
_STEPS, _REACH, _FEWEST_POINTS = 2, 3.0, 12
# The probability that a point shows an edge.
_SHOWN = 0.7
# The length of line over which errors of edges and map are correlated, pixels.
_TOGETHER_PX = 120.0
# Some are correlated over more: squared errors of 29 answers are 1.8 times the variance without this factor.
_VARIANCE_INFLATION = 1.7
# The largest number of points: towards the horizon of a dense city lines have tens of thousands.
_MOST_POINTS = 3000
# The distance from lines within which the background is measured, pixels.
_BACKGROUND_PX = 30.0
# Lines below this relative height are left out: bases of walls are hidden (docs/adr/0012, point 6).
_LOWEST_RELATIVE_HEIGHT = 0.2


class EdgeAlignment(NamedTuple):
    """A pose refined by edges."""

    vector: Floats  # (6,) the pose, metres and degrees
    covariance: Floats  # (6, 6) covariance of its error, that by the lens included
    log_ratio_to_background: float  # log-ratio of its edges to the photo's background, prior included, nats
    gain: float  # difference of that from the value at the start, nats


class EdgeLikelihood:
    """The likelihood of the edges of one photo, times a Gaussian prior of pose and lens.

    Blocks whose source states a pitched roof are left out: edges of the block are not those of the roof.

    Args:
        edges: the photo's edges.
        camera: pinhole, of any size.
        city_map: the map whose roof lines are compared.
        prior: (6,) the prior pose, metres and degrees.
        sigmas: (10,) standard deviations of the pose, none 0, and of ``LensErrors``, fixed where 0.
    """

    def __init__(
        self, edges: PhotoEdges, camera: Camera, city_map: CityMap, prior: Floats, sigmas: Floats
    ) -> None:
        self._camera, self._size, self._edges = camera.scaled(*edges.size), np.array(edges.size), edges
        self._map, self._is_flat = city_map, ~pitched_blocks(city_map.scene)
        self._prior = np.append(prior, np.zeros(NUM_POSE_AND_LENS - NUM_POSE))
        self._free = np.flatnonzero(sigmas > 0)
        self._sigmas = sigmas[self._free]
        self._background = self._measured_background()

    def refined(self, vector: Floats) -> EdgeAlignment | None:
        """Returns the pose that edges and priors make most probable near (6,); None where few lines show."""
        start = np.append(vector, np.zeros(NUM_POSE_AND_LENS - NUM_POSE))
        refined, posterior_information = start, np.diag(self._sigmas**-2.0)
        for sigma_px in _SIGMAS_PX:
            lines = self._lines(refined)
            if len(lines) < _FEWEST_POINTS:
                return None
            for _ in range(_STEPS):
                refined, posterior_information = self._step(lines, refined, sigma_px)
        covariance = _VARIANCE_INFLATION * np.linalg.inv(posterior_information)[:NUM_POSE, :NUM_POSE]
        log_ratio = self.log_ratio_to_background(refined)
        gain = log_ratio - self.log_ratio_to_background(start)
        return EdgeAlignment(refined[:NUM_POSE], np.asarray(covariance), log_ratio, gain)

    def log_ratio_to_background(self, vector: Floats) -> float:
        """Returns the log-ratio of edges at a pose and lens, (10,), to background, prior included, nats.

        Eq. (R22) of docs/methods/region.md.
        """
        lines = self._lines(vector)
        prior = -0.5 * float(((self._away(vector) / self._sigmas) ** 2).sum())
        ratios = self._ratios(self._laid(lines, vector), _SIGMAS_PX[-1])[0]
        return prior + float((lines.lengths_px * np.log(1.0 - _SHOWN + ratios)).sum()) / _TOGETHER_PX

    def _step(self, lines: ModelLines, vector: Floats, sigma_px: float) -> tuple[Floats, Floats]:
        """Returns the next (10,), and the posterior's information on those of its numbers that are free.

        Eq. (R23) of docs/methods/region.md.
        """
        laid = self._laid(lines, vector)
        ratios, distances = self._ratios(laid, sigma_px)
        shown = ratios / (ratios + 1.0 - _SHOWN)
        weighed = laid.by_camera * (shown * lines.lengths_px / (_TOGETHER_PX * sigma_px**2))[:, None]
        information = (weighed.T @ laid.by_camera)[np.ix_(self._free, self._free)]
        information += np.diag(self._sigmas**-2.0)
        gradient = self._away(vector) / self._sigmas**2 - (weighed.T @ distances)[self._free]
        posterior = Quadratic(information, gradient)
        stepped = vector.copy()
        stepped[self._free] += posterior.step()
        return stepped, posterior.information

    def _ratios(self, laid: Projected, sigma_px: float) -> tuple[Floats, Floats]:
        """Returns the (N,) ratio of a point's edges to background, r - 0.3, and their (N,) expected distance.

        Eq. (R21) of docs/methods/region.md.
        """
        count, (density, strength) = len(laid.pixels), self._background
        edges = self._edges.across(laid.pixels, laid.normals, _REACH * sigma_px)
        normal = np.exp(-0.5 * (edges.distances / sigma_px) ** 2) / (sigma_px * np.sqrt(2.0 * np.pi))
        likely = _SHOWN / density * normal * edges.strengths / strength
        ratios = np.bincount(edges.points, likely, count)
        means = np.bincount(edges.points, likely * edges.distances, count) / np.maximum(ratios, 1e-12)
        return np.asarray(ratios, dtype=np.float64), means

    def _measured_background(self) -> tuple[float, float]:
        """Returns the number of edges per pixel across lines, and their mean strength, near the prior."""
        lines = self._lines(self._prior)
        laid = self._laid(lines, self._prior)
        edges = self._edges.across(laid.pixels, laid.normals, _BACKGROUND_PX)
        if not len(edges.points):
            return 1.0 / _BACKGROUND_PX, 1.0
        return len(edges.points) / (2.0 * _BACKGROUND_PX * len(lines)), float(edges.strengths.mean())

    def _lines(self, vector: Floats) -> ModelLines:
        """Returns points on roof lines that (10,) shows inside the photo."""
        lines = lines_in_view(self._map, self._camera, pose_from_vector(vector[:NUM_POSE]), _SPACING_PX)
        lines = lines.of((lines.relative_heights > _LOWEST_RELATIVE_HEIGHT) & self._is_flat[lines.buildings])
        pixels = self._laid(lines, vector).pixels
        is_inside = (pixels > _BORDER_PX) & (pixels < self._size - _BORDER_PX)
        lines = lines.of(np.asarray(is_inside.all(axis=1)))
        every = -(-len(lines) // _MOST_POINTS)
        if every < 2:
            return lines
        lines = lines.of(np.arange(len(lines)) % every == 0)
        return replace(lines, lengths_px=every * lines.lengths_px)

    def _laid(self, lines: ModelLines, vector: Floats) -> Projected:
        lens = LensErrors(*(float(v) for v in vector[NUM_POSE:]))
        return project_lines(lines.points, lines.along, self._camera, vector[:NUM_POSE], lens)

    def _away(self, vector: Floats) -> Floats:
        """Returns the differences of the free numbers of (10,) from the prior."""
        return np.asarray(differences(vector, self._prior)[self._free])
