"""Level roofs from outlines traced in two photos, snapped to line segments of all photos that show them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray
from shapely import Polygon

from lodbench.errors import DatasetError
from lodbench.geometry import Camera, Pose
from lodbench.geometry.camera import distort
from lodbench.segmentation.masks import read_photo

Floats = NDArray[np.float64]
# Shorter line segments are texture, pixels.
_SHORTEST_PX = 12.0
# The fixed point of a lens's inverse: photos of drones need five rounds.
_LENS_ROUNDS = 30
# How well a corner is traced by hand, pixels: what holds corners where no edge does.
_TRACED_PX = 4.0
# An edge is looked at every so many pixels, and this far from its ends, as a share.
_EVERY_PX, _MARGIN = 12.0, 0.08
# Segments are parallel to an edge within this, degrees; an edge is found where one is this near, pixels.
_PARALLEL_DEG, _MATCHED_PX = 8.0, 3.0
# Heights, and ways across each edge, tried: standard deviations of the tracing.
_STEPS = np.linspace(-2.5, 2.5, 41)
# Beyond this a segment counts less and less, pixels; a fit is as good as a segment is near in it.
_NEAR_PX = 1.5
_ROUNDS = 8
# What a standard deviation away from the tracing costs, as a share of the edge on segments.
_PULL = 0.03
# A step that brings so much less of an edge onto segments is e times less likely.
_RIVAL = 0.05
_STEP_M = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Traced:
    """One thing traced in two or more photos, its points in the same order in each."""

    # ``roof``: the corners of a level roof; ``ground``: places on level ground; ``length``: the two ends of
    # a known length.
    kind: str
    name: str  # of the building, or of whatever it is
    # By photo, (N, 2) column and row in the photo as stored, the first pixel's centre at 0.5.
    pixels: Mapping[str, Floats]
    metres: float | None = None  # of a ``length``


@dataclass(slots=True, eq=False)
class View:
    """A posed photo."""

    name: str  # as the model calls it
    camera: Camera  # of the photo as stored, lens distortion included
    pose: Pose  # world to camera
    photo: Path  # its file
    # Its line segments, once they were looked for: copies of the view share them.
    kept: list[Floats] = field(default_factory=list, repr=False)

    def project(self, points: Floats) -> Floats:
        """Returns (N, 2) pixels of (N, 3) points of the world; NaN behind the camera."""
        return self.camera.project(points @ self.pose.rotation.T + self.pose.translation)

    def rays(self, pixels: Floats) -> Floats:
        """Returns (N, 3) unit directions, world axes, of (N, 2) pixels."""
        camera = self.camera
        distorted = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        plain = distorted
        if camera.distortion:
            for _ in range(_LENS_ROUNDS):
                bent = np.stack(distort(camera.lens, camera.distortion, plain[:, 0], plain[:, 1]), axis=1)
                plain = plain + distorted - bent
        rays = np.column_stack([plain, np.ones(len(plain))]) @ self.pose.rotation
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def shows(self, pixels: Floats) -> NDArray[np.bool_]:
        """Tells which of (N, 2) pixels are in the photo."""
        inside = (pixels >= 0) & (pixels <= [self.camera.width, self.camera.height])
        return np.asarray(inside.all(axis=1))

    def segments(self) -> Floats:
        """Returns (S, 4) line segments of the photo, ends in pixels (von Gioi et al., LSD, 2010); kept."""
        import cv2

        if not self.kept:
            grey = cv2.cvtColor(read_photo(self.photo), cv2.COLOR_RGB2GRAY)
            lines = cv2.createLineSegmentDetector().detect(grey)[0]
            # OpenCV counts from pixel centres.
            ends = np.zeros((0, 4)) if lines is None else np.reshape(lines, (-1, 4)).astype(np.float64) + 0.5
            self.kept.append(ends[np.hypot(*(ends[:, 2:] - ends[:, :2]).T) >= _SHORTEST_PX])
        return self.kept[0]


def triangulated(pixels: Mapping[str, Floats], views: Mapping[str, View]) -> Floats:
    """Returns (N, 3) the places nearest to the rays of all photos.

    Raises:
        DatasetError: A photo is not there, or the rays of a point are parallel.
    """
    count = len(next(iter(pixels.values())))
    normal, side = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for name, points in pixels.items():
        if name not in views:
            raise DatasetError(
                f"There is no photo {name}.", "`--images` is the folder of the model's photos."
            )
        rays, center = views[name].rays(points), views[name].pose.center
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        normal, side = normal + across, side + across @ center
    if np.linalg.eigvalsh(normal)[:, 0].min() < 1e-6:
        raise DatasetError(
            f"The rays from {' and '.join(pixels)} are parallel.", "Trace in photos taken further apart."
        )
    return np.asarray(np.linalg.solve(normal, side[..., None])[..., 0])


@dataclass(frozen=True, slots=True, eq=False)
class Roof:
    """A level roof."""

    name: str  # of the building
    corners: Floats  # (N, 2) plan, world
    height: float  # of the roof, world
    covariance: Floats  # (2N + 1, 2N + 1) of the corners, x and y by turns, and the height
    # Median distance of its edges to the segments found for them; of a roof that is not snapped, of its
    # corners to those traced.
    residual_px: float
    # Share of the places along its edges for which a segment was found; NaN where not snapped.
    matched_share: float = np.nan
    photos: int = 0  # how many show it

    @property
    def points(self) -> Floats:
        """Returns (N, 3) corners, world."""
        return np.column_stack([self.corners, np.full(len(self.corners), self.height)])

    @property
    def height_sigma(self) -> float:
        """Returns the standard deviation of the height."""
        return float(np.sqrt(self.covariance[-1, -1]))

    @property
    def plan_sigma(self) -> float:
        """Returns the standard deviation of a corner in plan, either axis, root mean square."""
        return float(np.sqrt(np.mean(np.diag(self.covariance)[:-1])))


def traced_roof(traced: Traced, views: Mapping[str, View]) -> Roof:
    """Returns the level roof whose corners lie nearest to those traced.

    Raises:
        DatasetError: A photo is not there, the photos were taken too close together, or the outline crosses
            itself.
    """
    start = triangulated(traced.pixels, views)

    def residuals(numbers: Floats) -> Floats:
        points = _points(numbers)
        gaps = [views[name].project(points) - pixels for name, pixels in traced.pixels.items()]
        return np.nan_to_num(np.concatenate(gaps), nan=1e4).ravel()

    solution = scipy.optimize.least_squares(
        residuals, np.append(start[:, :2].ravel(), np.median(start[:, 2])), loss="soft_l1", f_scale=_TRACED_PX
    )
    corners, height = _numbers(solution.x)
    if not Polygon(corners).is_valid:
        hint = "Its corners must be in one order in all photos."
        raise DatasetError(f"The outline of {traced.name} crosses itself.", hint)
    away = np.hypot(*residuals(solution.x).reshape(-1, 2).T)
    covariance = _TRACED_PX**2 * np.linalg.pinv(solution.jac.T @ solution.jac)
    return Roof(traced.name, corners, height, covariance, float(np.median(away)), np.nan, len(traced.pixels))


def snapped_roof(roof: Roof, views: Sequence[View]) -> Roof:
    """Returns a roof moved so that its edges lie on line segments of the photos that show it.

    First of all heights that the tracing allows, each with the corners that then fit it best, the one with
    most of the edges near segments; then likewise for each edge, moved across itself. Corners and height
    are then refined together by robust least squares over the distances to the nearest parallel segments,
    which are looked for anew each round. The tracing, with its covariance, holds what no edge does. The
    covariance counts each photo as one witness, however many places it shows.

    Raises:
        DatasetError: None of them shows it.
    """
    shown = [Shown(view, roof) for view in views if view.pose.center[2] > roof.height]
    shown = [each for each in shown if each.view.shows(each.view.project(roof.points)).any()]
    if not shown:
        raise DatasetError(
            f"No photo but the queries shows {roof.name} from above.", "Keep fewer as queries."
        )
    traced = np.append(roof.corners.ravel(), roof.height)
    now, rival = _best_height(traced, roof.covariance, shown)
    for edge in range(len(roof.corners)):
        now, other = _best_offset(now, edge, roof.plan_sigma, shown)
        rival = rival + other
    hold = np.linalg.pinv(roof.covariance)
    for _ in range(_ROUNDS):
        parts = [each.equations(now) for each in shown]
        normal = hold + sum(part[0] for part in parts)
        now = now + np.linalg.solve(normal, hold @ (traced - now) + sum(part[1] for part in parts))
    sides = np.stack([part[1] for part in parts])
    spread = sides.T @ sides * len(parts) / max(1, len(parts) - 1)
    inverse = np.linalg.inv(normal)
    corners, height = _numbers(now)
    if not Polygon(corners).is_valid:  # a corner between two short edges: as traced
        corners, height, rival = roof.corners, roof.height, roof.covariance
    away, share = _edges(_points(np.append(corners.ravel(), height)), shown)
    covariance = inverse @ (hold + spread) @ inverse + rival
    return Roof(roof.name, corners, height, covariance, away, share, len(shown))


class Shown:
    """A photo that shows a roof, and the segments around it there."""

    def __init__(self, view: View, roof: Roof) -> None:
        self.view = view
        pixels = view.project(roof.points)
        pixels = pixels[np.isfinite(pixels).all(axis=1)]
        ends = view.segments()
        if len(pixels):
            # As far as what is tried may move an edge.
            margin = 20.0 * _TRACED_PX
            low, high = np.minimum(ends[:, :2], ends[:, 2:]), np.maximum(ends[:, :2], ends[:, 2:])
            near = (high >= pixels.min(axis=0) - margin) & (low <= pixels.max(axis=0) + margin)
            ends = ends[near.all(axis=1)]
        run = ends[:, 2:] - ends[:, :2]
        self._lengths = np.linalg.norm(run, axis=1)
        self._run = run / self._lengths[:, None]
        self._normal = np.stack([-self._run[:, 1], self._run[:, 0]], axis=1)
        self._offset = np.sum(self._normal * ends[:, :2], axis=1)
        self._first = np.sum(self._run * ends[:, :2], axis=1)

    def nearest(self, at: Floats, direction: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Returns how far the nearest parallel segment beside each place is, inf for none, and its number."""
        if not len(self._offset):
            return np.full(len(at), np.inf), np.zeros(len(at), np.int64)
        passed = at @ self._run.T - self._first
        fits = np.abs(direction @ self._normal.T) < np.sin(np.radians(_PARALLEL_DEG))
        fits &= (passed > -2.0) & (passed < self._lengths + 2.0)
        away = np.where(fits, np.abs(at @ self._normal.T - self._offset), np.inf)
        best = np.argmin(away, axis=1)
        return away[np.arange(len(at)), best], best

    def away(self, starts: Floats, ends: Floats) -> Floats:
        """Returns how far segments are from places along straight edges, (E, 3) each end; those shown."""
        places, directions, _, _ = self._places(starts, ends)
        return self.nearest(places, directions)[0]

    def fits(self, starts: Floats, ends: Floats) -> Floats:
        """Returns (E,) sums of how near segments are to places along each edge, 1 on one; and (E,) places."""
        places, directions, edge, _ = self._places(starts, ends)
        near = np.exp(-0.5 * (self.nearest(places, directions)[0] / _NEAR_PX) ** 2)
        sums = [np.bincount(edge, each, len(starts)) for each in (near, np.ones(len(edge)))]
        return np.stack(sums)

    def equations(self, numbers: Floats) -> tuple[Floats, Floats]:
        """Returns the normal matrix and right side of least squares over the segments near a roof's edges."""
        points = _points(numbers)
        ahead = np.roll(points, -1, axis=0)
        places, directions, edge, share = self._places(points, ahead)
        away, best = self.nearest(places, directions)
        near = away < 2.0 * _MATCHED_PX
        edge, share, best, places = edge[near], share[near], best[near], places[near]
        normal = self._normal[best]
        gap = np.sum(normal * places, axis=1) - self._offset[best]
        world = points[edge] + share[:, None] * (ahead - points)[edge]
        slopes = [
            np.sum(normal * (self.view.project(world + step) - places), axis=1) / _STEP_M
            for step in _STEP_M * np.eye(3)
        ]
        rows, count = np.zeros((len(gap), len(numbers))), len(points)
        row, following = np.arange(len(gap)), (edge + 1) % count
        for axis in (0, 1):
            rows[row, 2 * edge + axis] = (1.0 - share) * slopes[axis]
            rows[row, 2 * following + axis] = share * slopes[axis]
        rows[:, -1] = slopes[2]
        weight = 1.0 / (1.0 + (gap / _NEAR_PX) ** 2) ** 2 / _NEAR_PX**2
        weighted = rows.T * weight
        return weighted @ rows, -weighted @ gap

    def _places(self, starts: Floats, ends: Floats) -> tuple[Floats, Floats, NDArray[np.int64], Floats]:
        """Returns places along edges that the photo shows: pixels, directions (P, 2), edge and share (P,)."""
        lengths = np.linalg.norm(self.view.project(ends) - self.view.project(starts), axis=1)
        counts = np.clip(np.nan_to_num(lengths) // _EVERY_PX, 3, 60).astype(int)
        edge = np.repeat(np.arange(len(starts)), counts)
        share = np.concatenate([np.linspace(_MARGIN, 1 - _MARGIN, count) for count in counts])
        world = starts[edge] + share[:, None] * (ends - starts)[edge]
        at, ahead = self.view.project(world), self.view.project(world + 1e-3 * (ends - starts)[edge])
        inside = self.view.shows(at)
        run = (ahead - at)[inside]
        direction = run / np.maximum(np.linalg.norm(run, axis=1, keepdims=True), 1e-12)
        return at[inside], direction, edge[inside], share[inside]


def _edges(points: Floats, shown: Sequence[Shown]) -> tuple[float, float]:
    away = np.concatenate([np.zeros(0), *(each.away(points, np.roll(points, -1, axis=0)) for each in shown)])
    near = away[away <= _MATCHED_PX]
    return (float(np.median(near)) if len(near) else np.nan), len(near) / max(1, len(away))


def _points(numbers: Floats) -> Floats:
    plan = numbers[:-1].reshape(-1, 2)
    return np.column_stack([plan, np.full(len(plan), numbers[-1])])


def _numbers(numbers: Floats) -> tuple[Floats, float]:
    return numbers[:-1].reshape(-1, 2).copy(), float(numbers[-1])


def _best_height(traced: Floats, covariance: Floats, shown: Sequence[Shown]) -> tuple[Floats, Floats]:
    """Returns corners and height, the height the one at which most of the edges lie near segments.

    Returns:
        numbers: (2N + 1,) corners and height.
        rival: (2N + 1, 2N + 1) covariance over heights that fit nearly as well.
    """
    slope = covariance[:, -1] / np.sqrt(covariance[-1, -1])
    points = np.stack([_points(traced + step * slope) for step in _STEPS])
    ends = np.roll(points, -1, axis=1)
    fits = [each.fits(points.reshape(-1, 3), ends.reshape(-1, 3)) for each in shown]
    near, count = np.sum(fits, axis=0)
    near, count = (each.reshape(len(_STEPS), -1).sum(axis=1) for each in (near, count))
    best, spread = _best(near, count)
    return traced + best * slope, spread * np.outer(slope, slope)


def _best_offset(numbers: Floats, edge: int, sigma: float, shown: Sequence[Shown]) -> tuple[Floats, Floats]:
    """Returns corners and height with one edge moved across itself, likewise."""
    points = _points(numbers)
    following = (edge + 1) % len(points)
    run = points[following] - points[edge]
    across = sigma * np.array([-run[1], run[0], 0.0]) / max(float(np.linalg.norm(run)), 1e-9)
    moves = _STEPS[:, None] * across
    fits = [each.fits(points[edge] + moves, points[following] + moves) for each in shown]
    best, spread = _best(*np.sum(fits, axis=0))
    move = np.zeros_like(numbers)
    # Neighbours turn a little; the refinement has them straight again.
    for corner in (edge, following):
        move[2 * corner : 2 * corner + 2] = across[:2]
    return numbers + best * move, spread * np.outer(move, move)


def _best(near: Floats, count: Floats) -> tuple[float, float]:
    """Returns the step at which the largest share is near, and the variance over steps that rival it."""
    fit = near / np.maximum(count, 1.0) - _PULL * _STEPS**2
    best = float(_STEPS[int(np.argmax(fit))])
    weight = np.exp((fit - fit.max()) / _RIVAL)
    return best, float(weight @ (_STEPS - best) ** 2 / weight.sum())
