"""The model's visible lines over the photo's edges: how well they fit, and starts from them.

Where the map's lines fall on the photo's edges at all: starts where regions have no mode. A street of roofs
as dark as its yards has its best silhouette elsewhere; edges along its roofs are where they are. Every
sample of a fine grid is tried with a blurred photo (docs/adr/0011, point 8).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.datasets.query import Query
from lodbench.estimation.optimization import maximize
from lodbench.estimation.state_vector import ALL, BESIDE_POSE, POSE, ROOFS, Gaussian, views_of
from lodbench.geometry import Camera
from lodbench.geometry.angles import rotations_from_euler
from lodbench.geometry.pose import pose_from_vector
from lodbench.kernels import count_along_lines, sum_along_lines
from lodbench.kernels.arguments import EDGE_LEVELS, LinePoints, LinePoses
from lodbench.methods.protocol import Streams
from lodbench.methods.region.evidence import PosePosterior
from lodbench.methods.region.params import RegionParams
from lodbench.methods.region.roofs import STEP_M, RaisedRoofs, step_of
from lodbench.methods.region.search import Problem, local_maxima, samples
from lodbench.rendering.photo_bins import Levels

Floats = NDArray[np.float64]

# Least angle between two faces to be a line, degrees; distance of points and least length of lines, pixels.
_CREASE_DEG, _SPACING_PX, _SHORTEST_PX = 25.0, 3.0, 2.0
# Most points, as far apart as that needs: fewer leave an answer to where they happen to fall (docs/adr/0011,
# point 6).
_MOST_POINTS = 6000
# How strongly edges may stand out along lines: 0 not at all, 1 as ``_log_ratios`` says.
_STRENGTHS = np.linspace(0.0, 0.97, 12)
# Beside a line: what is on it, what is near it and what is far from it, pixels.
_ON, _NEAR, _FAR = (-1.0, 0.0, 1.0), (-4.0, -3.0, 3.0, 4.0), (-10.0, -9.0, -8.0, 8.0, 9.0, 10.0)
# What lines of real photos stand out by at least; a share of less than that says nothing.
_LEAST_CONTRAST = 0.5
# How much higher a roof may be by itself, deviations, and how many it ends from the map at most.
_OWN, _MOST_SIGMAS = np.arange(-3.0, 4.0), 4.0
# Lines lower than this share of their building's height are where its walls end.
_LOWEST_SHARE = 0.2
# Fewer poses are not worth handing over to threads.
_FEW = 8
# The deviation of roofs that are declared exact.
_LEAST_SIGMA_M = 1e-9


def _log_ratios() -> Floats:
    """Returns (A, 16): by strength, how much likelier a level is on a line than anywhere, logarithm.

    Eq. (R10) of docs/methods/region.md.

    Anywhere, levels are equally likely; on a line their density rises with the cube.
    """
    rise = ((np.arange(EDGE_LEVELS) + 0.5) / EDGE_LEVELS) ** 3
    excess = rise / rise.mean() - 1.0
    return np.asarray(np.log1p(_STRENGTHS[:, None] * excess / -excess.min()))


_RATIOS = _log_ratios()


def worth_of_levels() -> Floats:
    """Returns (2, 16) what each level is worth on lines of either kind that stand out middling, nats."""
    return np.asarray(_RATIOS[[len(_STRENGTHS) // 2] * 2])


class LineLikelihood:
    """The likelihood of the photo's edges given state vectors near one, by the lines visible from there.

    Each roof may be higher or lower by itself besides. The likelihood is the sum over how much, building by
    building: where a map's roofs err each in its own way, lines say less, but nothing wrong.

    Args:
        levels: How strongly the photo changes, as of ``Photo.levels``.
        query: The query.
        roofs: The map, which says what lines are seen.
        vector: (10,) the pose that they are seen from, and the rest of the state vector.
        params: The method's.
        has_bases: Whether lines where walls end count too.

    Attributes:
        buildings: Those of the map whose lines are seen.
    """

    def __init__(
        self,
        levels: Levels,
        query: Query,
        roofs: RaisedRoofs,
        vector: Floats,
        params: RegionParams,
        has_bases: bool = False,
    ) -> None:
        camera = query.camera.scaled(levels.shape[1], levels.shape[0])
        self._intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
        self._levels = levels
        step = int(step_of(vector[ROOFS]))
        points, spacing_px = points_on_lines(roofs, step, camera, vector[POSE], has_bases)
        self.buildings, buildings = np.unique(points.buildings, return_inverse=True)
        self._points = points._replace(buildings=buildings)
        self._roofs = roofs
        self._of_map_m = np.array([step * STEP_M, roofs.bases_m, roofs.eaves_m])
        self._weight = params.lines_weight * spacing_px
        self._sigma_m = max(params.own_roofs_m, _LEAST_SIGMA_M)
        self._own_m = params.own_roofs_m * (_OWN if params.own_roofs_m > 0 else _OWN[:1])
        in_all = (roofs.own_m[self.buildings, None] + self._own_m) / self._sigma_m
        self._log_prior = -0.5 * in_all**2 - scipy.special.logsumexp(
            -0.5 * (self._own_m / self._sigma_m) ** 2
        )
        self._strengths = self._best_strengths(vector)

    def __len__(self) -> int:
        return len(self._points.kinds)

    def __call__(self, vectors: Floats, share: float = 1.0) -> Floats:
        """Returns the (N,) logarithm of the likelihood of cameras and the map (N, 10), up to a constant.

        Eq. (R11) of docs/methods/region.md.

        How strongly edges stand out along outlines and along creases is taken as fits the first pose best.

        Args:
            vectors: State vectors.
            share: Of the photo's nats that count.
        """
        return self.submit(vectors, share)()

    def submit(self, vectors: Floats, share: float = 1.0) -> Callable[[], Floats]:
        """Begins a call on the roofs' threads, but for few poses; returns what waits for it, once."""

        def work(part: Floats) -> Floats:
            # Along a last axis so short most of the time would go into its many ends.
            by_height = np.ascontiguousarray(np.moveaxis(self._of_buildings(part, share), 2, 0))
            return np.asarray(np.logaddexp.reduce(by_height, axis=0).sum(axis=1))

        if len(vectors) < _FEW:
            return lambda: work(vectors)
        done = self._roofs.parallel_map(work, np.array_split(vectors, self._roofs.threads))
        return lambda: np.concatenate(list(done))

    def own_roofs_m(self, vector: Floats) -> Floats:
        """Returns (B,) how much higher than all roofs each of the map is to be expected, metres."""
        (logs,) = self._of_buildings(vector[None], 1.0)
        own_m = self._roofs.own_m.copy()
        own_m[self.buildings] += scipy.special.softmax(logs, axis=1) @ self._own_m
        return np.clip(own_m, -_MOST_SIGMAS * self._sigma_m, _MOST_SIGMAS * self._sigma_m)

    def sharpness(self, vector: Floats) -> float:
        """Returns which share of their height edges have lost 3 to 4 pixels beside the lines.

        Eq. (R14) of docs/methods/region.md.

        1 beside lines drawn by a pen, 0 or less where nothing stands out.
        """
        heights = []
        for offsets in (_ON, _NEAR, _FAR):
            counts = np.sum([self._counts(vector, np.zeros(1), px) for px in offsets], axis=(0, 1, 2, 3))
            heights.append(float(counts @ _RATIOS[-1]) / max(float(counts.sum()), 1.0))
        on, near, far = heights
        return (on - max(near, far)) / max(on - far, _LEAST_CONTRAST)

    def _best_strengths(self, vector: Floats) -> NDArray[np.int64]:
        """Returns (2,) how strongly edges stand out along creases and outlines, as fits (10,) best.

        One after the other, twice.
        """
        # (2, S, B, D): what lines of a kind say, by how strongly edges stand out along them.
        creases, outlines = np.moveaxis(self._counts(vector, self._own_m) @ _RATIOS.T, -1, 1)
        best = np.full(2, len(_STRENGTHS) // 2)
        for _ in range(2):
            best[0] = self._likeliest(creases + outlines[best[1]])
            best[1] = self._likeliest(creases[best[0]] + outlines)
        return best

    def _likeliest(self, sums: Floats) -> int:
        """Returns which of some sums, (S, B, D), is the likeliest."""
        return int(
            scipy.special.logsumexp(self._weight * sums + self._log_prior, axis=2).sum(axis=1).argmax()
        )

    def _of_buildings(self, vectors: Floats, share: float) -> Floats:
        """Returns (N, B, D) the logarithm of likelihood and prior of each building's own roofs."""
        sums = np.zeros((len(vectors), len(self.buildings), len(self._own_m)))
        view, worth = (line_poses(*self._views(vectors)), self._intrinsics), _RATIOS[self._strengths]
        levels = self._levels.ravel(), self._levels.shape
        sum_along_lines(self._points, *view, *levels, self._own_m, worth, sums)
        return np.asarray(share * self._weight * sums + self._log_prior)

    def _counts(self, vector: Floats, own_m: Floats, offset_px: float = 0.0) -> NDArray[np.int64]:
        """Returns (2, B, D, 16) how many points meet each level, by kind, building and height of its roof."""
        counts = np.zeros((2, len(self.buildings), len(own_m), EDGE_LEVELS), dtype=np.int64)
        view = line_poses(*self._views(vector[None])), self._intrinsics
        levels = self._levels.ravel(), self._levels.shape
        count_along_lines(self._points, *view, *levels, offset_px, own_m, counts)
        return counts

    def _views(self, vectors: Floats) -> tuple[Floats, Floats, Floats]:
        """Returns rotations, centres and how the map errs more than is drawn, of (N, 10)."""
        return *views_of(vectors), vectors[:, ROOFS:] - self._of_map_m


def points_on_lines(
    roofs: RaisedRoofs, step: int, camera: Camera, vector: Floats, has_bases: bool = False
) -> tuple[LinePoints, float]:
    """Returns points evenly along the lines seen from a pose, (6,), and their distance, pixels.

    Lines where walls end are left out, or not: hedges, cars and slopes hide them, and of a map the ground
    errs most. On two real flights bases show 1 to 2.5 m above the map's (docs/adr/0012, point 6).
    """
    pose = pose_from_vector(vector)
    (seen,) = roofs.at(step).edges(camera, pose.rotation[None], pose.center[None], _CREASE_DEG)
    lengths = np.linalg.norm(seen.pixels[:, 1] - seen.pixels[:, 0], axis=1)
    lines = np.flatnonzero(seen.is_visible & (lengths > _SHORTEST_PX))
    spacing_px = max(_SPACING_PX, float(lengths[lines].sum()) / _MOST_POINTS)
    # One after the other along all lines: a short one has its share of points, and no more.
    ends = np.cumsum(lengths[lines])
    stations = (np.arange(int(ends[-1] / spacing_px) if len(lines) else 0) + 0.5) * spacing_px
    which = np.searchsorted(ends, stations)
    rows = lines[which]
    place = 1.0 - (ends[which] - stations) / lengths[rows]
    if not has_bases:
        middle, owners = seen.points[rows, :, 2].mean(axis=1), seen.building[rows]
        kept = (roofs.shares(middle, owners, step) > _LOWEST_SHARE) | ~roofs.is_tall[owners]
        rows, which, place = rows[kept], which[kept], place[kept]
    starts, along = seen.points[rows, 0], seen.points[rows, 1] - seen.points[rows, 0]
    points = starts + place[:, None] * along
    # Halfway to the end of the line, its direction is the same.
    pairs = np.stack([points, points + 0.5 * (1.0 - place)[:, None] * along], axis=1)
    owners = seen.building[rows]
    heights = pairs[..., 2].T
    rises = np.stack([roofs.shares(each, owners, step) for each in heights], axis=1)
    lifts = np.stack([roofs.lifts(each, owners, step) for each in heights], axis=1)
    first, last = seen.shares[rows].T
    outward = rises[:, :1] * roofs.outward(seen.corners[rows], first + place * (last - first))
    return LinePoints(pairs, rises, lifts, outward, seen.kind[rows].astype(np.int64), owners), spacing_px


# Width and blur of the photo, pixels: lines a stride beside the right place still meet its edges.
_WIDTH, _BLUR_PX = 320, 2.5
# How far samples of the grid are apart, metres in place and in height, and degrees; farther where there would
# be more of them than so many.
_STRIDE_M, _STRIDE_Z_M, _STRIDE_YAW_DEG, _MOST_SAMPLES = 2.5, 6.0, 1.5, 100_000
# Lines are those seen from the prior in a picture so many times as wide; so many of their points are tried.
_WIDER, _MOST_START_POINTS = 1.6, 600
_STARTS, _GENERATIONS = 20, 14


def line_starts(
    problem: Problem, posterior: PosePosterior, params: RegionParams, streams: Streams
) -> list[Gaussian]:
    """Returns poses around which the map's lines lie along edges of the photo, best first.

    Args:
        problem: The query, its photo and the map.
        posterior: Whose prior counts.
        params: The method's.
        streams: Of random numbers.
    """
    coarse, query, roofs = _with_strides(params), problem.query, problem.roofs
    levels = problem.photo.levels(_BLUR_PX, _WIDTH)
    grid = coarse.grid()
    vectors = samples(grid, query.prior)
    sums = _sums_at(vectors.reshape(-1, grid.z.count, 6), levels, query.camera, roofs)
    found = vectors[local_maxima(sums, grid, coarse.turns_around(), _STARTS)]
    # What the grid leaves open: half a stride, and tilt.
    half_m, half_z_m = 0.5 * coarse.stride_m, 0.5 * coarse.stride_z_m
    tilts_deg = params.prior_sigmas()[3:5]
    open_to_it = np.diag(np.square([half_m, half_m, half_z_m, *tilts_deg, 0.5 * coarse.stride_yaw_deg]))
    ends = []
    for k, start in enumerate(found):
        lines = LineLikelihood(levels, query, roofs, np.append(start, np.zeros(BESIDE_POSE)), coarse)
        if len(lines):
            value, spread = _by_lines(lines, posterior), Gaussian(start, open_to_it)
            ends.append(maximize(value, spread, _GENERATIONS, params.population, streams("line start", k)))
    return ends


def _by_lines(lines: LineLikelihood, posterior: PosePosterior) -> Callable[[Floats], Floats]:
    """Returns the log-posterior of poses (N, 6) by lines, roofs as in the map."""

    def value(vectors: Floats) -> Floats:
        whole = np.column_stack([vectors, np.zeros((len(vectors), BESIDE_POSE))])
        return lines(whole) + posterior.prior.log_density(vectors)

    return value


def _with_strides(params: RegionParams) -> RegionParams:
    """Returns the parameters with the strides of the fine grid, or longer ones that make no more samples."""
    fine = replace(params, stride_m=_STRIDE_M, stride_z_m=_STRIDE_Z_M, stride_yaw_deg=_STRIDE_YAW_DEG)
    longer = max(1.0, (len(fine.grid()) / _MOST_SAMPLES) ** 0.25)
    return replace(
        fine,
        stride_m=longer * _STRIDE_M,
        stride_z_m=longer * _STRIDE_Z_M,
        stride_yaw_deg=longer * _STRIDE_YAW_DEG,
    )


def _sums_at(vectors: Floats, levels: Levels, photo_camera: Camera, roofs: RaisedRoofs) -> Floats:
    """Returns (N * Z,) what edges say along lines, of poses (N, Z, 6) at Z heights."""
    camera = photo_camera.scaled(levels.shape[1], levels.shape[0])
    intrinsics, worth = (camera.fx, camera.fy, camera.cx, camera.cy), worth_of_levels()

    def at(height: int) -> Floats:
        poses = np.ascontiguousarray(vectors[:, height])
        points, each_px = _some_points(roofs, camera, poses[len(poses) // 2])
        rotations, centers = rotations_from_euler(poses[:, 3:]), np.ascontiguousarray(poses[:, :3])
        view = line_poses(rotations, centers, np.zeros((len(poses), ALL - ROOFS))), intrinsics
        sums = np.zeros((len(poses), 1, 1))
        sum_along_lines(points, *view, levels.ravel(), levels.shape, np.zeros(1), worth, sums)
        return np.asarray(each_px * sums[:, 0, 0])

    return np.stack(list(roofs.parallel_map(at, range(vectors.shape[1]))), axis=1).ravel()


def line_poses(rotations: Floats, centers: Floats, of_all_m: Floats) -> LinePoses:
    """Returns poses for sums along lines.

    Args:
        rotations: (N, 3, 3) cam_from_world.
        centers: (N, 3) metres.
        of_all_m: (N, 3) of ``LinePoses.of_all``.
    """
    count = len(rotations)
    turns, places, of_all = (
        tuple(np.ascontiguousarray(each.reshape(count, -1).T)) for each in (rotations, centers, of_all_m)
    )
    return LinePoses(turns, places, of_all)


def _some_points(roofs: RaisedRoofs, camera: Camera, vector: Floats) -> tuple[LinePoints, float]:
    """Returns points of the lines in a wider view, and how many pixels of line one stands for."""
    margins = (round(0.5 * (_WIDER - 1.0) * size) for size in (camera.width, camera.height))
    points, spacing_px = points_on_lines(roofs, 0, camera.with_margins(*margins), vector)
    every = max(1, -(-len(points.kinds) // _MOST_START_POINTS))
    some = LinePoints._make(np.ascontiguousarray(each[::every]) for each in points)
    return some._replace(buildings=np.zeros(len(some.kinds), dtype=np.int64)), spacing_px * every
