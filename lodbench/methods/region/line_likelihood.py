"""The likelihood of the photo's edges given the model's visible lines, and starts of the search by it.

Starts by lines are for places where regions have no mode: a street of roofs as dark as its yards has its best
silhouette elsewhere, but the edges along its roofs are in place. Every pose of a fine grid is compared with
a blurred photo (docs/adr/0011, point 8).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.datasets.query import Query
from lodbench.estimation.optimization import maximize
from lodbench.estimation.state_vector import ALL_ROOFS, NUM_AFTER_POSE, POSE, Gaussian, views_of
from lodbench.geometry import Camera
from lodbench.geometry.angles import rotations_from_euler
from lodbench.geometry.pose import pose_from_vector
from lodbench.kernels import count_along_lines, sum_along_lines
from lodbench.kernels.arguments import EDGE_LEVELS, LinePoints, LinePoses
from lodbench.methods.protocol import Streams
from lodbench.methods.region.params import RegionParams
from lodbench.methods.region.posteriors import PosePosterior, QueryContext, grid_poses, local_maxima
from lodbench.methods.region.roofs import ROOF_LEVEL_STEP_M, RaisedRoofs, roof_level_of
from lodbench.rendering.photo_bins import Levels

Floats = NDArray[np.float64]

# The least angle between two faces whose common edge is a crease, degrees.
_CREASE_DEG = 25.0
# The distance between points along lines, and the least length of a line, pixels.
_SPACING_PX, _SHORTEST_PX = 3.0, 2.0
# The largest number of points; their distance grows for it. Answers by fewer depend on where these happen to
# lie (docs/adr/0011, point 6).
_MOST_POINTS = 6000
# The strengths with which edges may stand out along lines, A of (R10).
_STRENGTHS = np.linspace(0.0, 0.97, 12)
# Offsets across a line at which edges are on it, near it and far from it, pixels.
_ON, _NEAR, _FAR = (-1.0, 0.0, 1.0), (-4.0, -3.0, 3.0, 4.0), (-10.0, -9.0, -8.0, 8.0, 9.0, 10.0)
# The least contrast of lines (on minus far) that sharpness is a fraction of, mean nats.
_LEAST_CONTRAST = 0.5
# Offsets of one roof that are summed over, in its standard deviations.
_ROOF_OFFSET_GRID = np.arange(-3.0, 4.0)
# The largest expected offset of one roof, in its standard deviations.
_MOST_SIGMAS = 4.0
# Lines below this relative height of their building are at its base.
_BASE_RELATIVE_HEIGHT = 0.2
# The least number of poses that is split over threads.
_FEWEST_FOR_THREADS = 8
# The least standard deviation of one roof, metres: it is divided by, also where the setting is 0. No matrix
# is inverted, so that it may be smaller than that of ``StatePosterior``.
_LEAST_SIGMA_M = 1e-9


def _log_ratios() -> Floats:
    """Returns (A, 16) the log-ratio of each level on a line to anywhere, by strength.

    Eq. (R10) of docs/methods/region.md.
    """
    rise = ((np.arange(EDGE_LEVELS) + 0.5) / EDGE_LEVELS) ** 3
    excess = rise / rise.mean() - 1.0
    return np.asarray(np.log1p(_STRENGTHS[:, None] * excess / -excess.min()))


_RATIOS = _log_ratios()


class LineLikelihood:
    """The log-likelihood ratio of the photo's edges, on visible lines against anywhere, near a state vector.

    Each building's likelihood is a sum over offsets of its own roof: where roofs of a map err independently,
    lines constrain the pose less, but without bias.

    Args:
        levels: (H, W, 12) edge levels of the photo, as returned by ``Photo.levels``.
        query: the query.
        roofs: the map.
        vector: (10,) the state vector at which visible lines are extracted.
        params: the method's parameters.
        has_bases: whether lines at bases of walls are used as well.

    Attributes:
        buildings: the buildings of the map that have visible lines.
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
        roof_level = int(roof_level_of(vector[ALL_ROOFS]))
        points, spacing_px = points_on_lines(roofs, roof_level, camera, vector[POSE], has_bases)
        self.buildings, buildings = np.unique(points.buildings, return_inverse=True)
        self._points = points._replace(buildings=buildings)
        self._roofs = roofs
        drawn_roof_m = roof_level * ROOF_LEVEL_STEP_M
        self._drawn_offsets_m = np.array([drawn_roof_m, roofs.base_offset_m, roofs.overhang_m])
        self._weight = params.lines_weight * spacing_px
        sigma_m = params.own_roofs_m
        self._roof_sigma_m = max(sigma_m, _LEAST_SIGMA_M)
        self._roof_offsets_m = sigma_m * (_ROOF_OFFSET_GRID if sigma_m > 0 else _ROOF_OFFSET_GRID[:1])
        total = roofs.building_roof_offsets_m[self.buildings, None] + self._roof_offsets_m
        self._log_prior = -0.5 * (total / self._roof_sigma_m) ** 2 - scipy.special.logsumexp(
            -0.5 * (self._roof_offsets_m / self._roof_sigma_m) ** 2
        )
        self._strengths = self._best_strengths(vector)

    def __len__(self) -> int:
        return len(self._points.kinds)

    def __call__(self, vectors: Floats, temper: float = 1.0) -> Floats:
        """Returns the (N,) log-likelihood of state vectors (N, 10), up to a constant, nats.

        Eq. (R11) of docs/methods/region.md. Strengths of edges are those that fit best at the state vector
        at which lines were extracted.

        Args:
            vectors: the state vectors.
            temper: tempering exponent of the likelihood of each building's edges.
        """
        return self.submit(vectors, temper)()

    def submit(self, vectors: Floats, temper: float = 1.0) -> Callable[[], Floats]:
        """Starts a call on the threads of ``roofs``; returns a function that waits for the result, once."""

        def work(part: Floats) -> Floats:
            # The offsets first: sums along a short last axis take several times as long.
            by_offset = np.ascontiguousarray(np.moveaxis(self._of_buildings(part, temper), 2, 0))
            return np.asarray(np.logaddexp.reduce(by_offset, axis=0).sum(axis=1))

        if len(vectors) < _FEWEST_FOR_THREADS:
            return lambda: work(vectors)
        done = self._roofs.parallel_map(work, np.array_split(vectors, self._roofs.threads))
        return lambda: np.concatenate(list(done))

    def building_roof_offsets_m(self, vector: Floats) -> Floats:
        """Returns (B,) the expected offset of each roof of the map from all roofs, metres."""
        (logs,) = self._of_buildings(vector[None], 1.0)
        offsets_m = self._roofs.building_roof_offsets_m.copy()
        offsets_m[self.buildings] += scipy.special.softmax(logs, axis=1) @ self._roof_offsets_m
        return np.clip(offsets_m, -_MOST_SIGMAS * self._roof_sigma_m, _MOST_SIGMAS * self._roof_sigma_m)

    def sharpness(self, vector: Floats) -> float:
        """Returns which fraction of their contrast edges have lost 3 to 4 pixels beside the lines.

        Eq. (R14) of docs/methods/region.md: 1 for lines drawn by a pen, 0 or less where no edge stands out.
        """
        contrasts = []
        for offsets in (_ON, _NEAR, _FAR):
            counts = np.sum([self._counts(vector, np.zeros(1), px) for px in offsets], axis=(0, 1, 2, 3))
            contrasts.append(float(counts @ _RATIOS[-1]) / max(float(counts.sum()), 1.0))
        on, near, far = contrasts
        return (on - max(near, far)) / max(on - far, _LEAST_CONTRAST)

    def _best_strengths(self, vector: Floats) -> NDArray[np.int64]:
        """Returns (2,) the indices of the strengths of creases and occluding edges that fit (10,) best.

        Each is maximised given the other, twice.
        """
        # (S, B, D) each: sums of log-ratios by strength, building and offset of its roof.
        creases, occluding = np.moveaxis(self._counts(vector, self._roof_offsets_m) @ _RATIOS.T, -1, 1)
        best = np.full(2, len(_STRENGTHS) // 2)
        for _ in range(2):
            best[0] = self._likeliest(creases + occluding[best[1]])
            best[1] = self._likeliest(creases[best[0]] + occluding)
        return best

    def _likeliest(self, sums: Floats) -> int:
        """Returns the index of the likeliest of (S, B, D) sums of log-ratios."""
        return int(
            scipy.special.logsumexp(self._weight * sums + self._log_prior, axis=2).sum(axis=1).argmax()
        )

    def _of_buildings(self, vectors: Floats, temper: float) -> Floats:
        """Returns (N, B, D) the log of tempered likelihood times prior, by building and roof offset."""
        sums = np.zeros((len(vectors), len(self.buildings), len(self._roof_offsets_m)))
        view, ratios = (line_poses(*self._views(vectors)), self._intrinsics), _RATIOS[self._strengths]
        levels = self._levels.ravel(), self._levels.shape
        sum_along_lines(self._points, *view, *levels, self._roof_offsets_m, ratios, sums)
        return np.asarray(temper * self._weight * sums + self._log_prior)

    def _counts(self, vector: Floats, offsets_m: Floats, across_px: float = 0.0) -> NDArray[np.int64]:
        """Returns (2, B, D, 16) the numbers of points by kind, building, roof offset and edge level."""
        counts = np.zeros((2, len(self.buildings), len(offsets_m), EDGE_LEVELS), dtype=np.int64)
        view = line_poses(*self._views(vector[None])), self._intrinsics
        levels = self._levels.ravel(), self._levels.shape
        count_along_lines(self._points, *view, *levels, across_px, offsets_m, counts)
        return counts

    def _views(self, vectors: Floats) -> tuple[Floats, Floats, Floats]:
        """Returns rotations and centres of (N, 10), and (N, 3) the map's offsets beyond those drawn."""
        return *views_of(vectors), vectors[:, ALL_ROOFS:] - self._drawn_offsets_m


def points_on_lines(
    roofs: RaisedRoofs, roof_level: int, camera: Camera, vector: Floats, has_bases: bool = False
) -> tuple[LinePoints, float]:
    """Returns points evenly along the lines visible from a pose, (6,), and their distance, pixels.

    Lines at bases of walls are left out by default: hedges, cars and slopes hide them, and the ground is the
    least exact part of a map. On two real flights bases show 1 to 2.5 m above the map's (docs/adr/0012,
    point 6).
    """
    pose = pose_from_vector(vector)
    (edges,) = roofs.at(roof_level).edges(camera, pose.rotation[None], pose.center[None], _CREASE_DEG)
    lengths = np.linalg.norm(edges.pixels[:, 1] - edges.pixels[:, 0], axis=1)
    lines = np.flatnonzero(edges.is_visible & (lengths > _SHORTEST_PX))
    spacing_px = max(_SPACING_PX, float(lengths[lines].sum()) / _MOST_POINTS)
    # Stations run on from line to line: a short one has points in proportion to its length.
    ends = np.cumsum(lengths[lines])
    stations = (np.arange(int(ends[-1] / spacing_px) if len(lines) else 0) + 0.5) * spacing_px
    which = np.searchsorted(ends, stations)
    rows = lines[which]
    line_fractions = 1.0 - (ends[which] - stations) / lengths[rows]
    if not has_bases:
        middle, owners = edges.points[rows, :, 2].mean(axis=1), edges.building[rows]
        relative = roofs.relative_heights(middle, owners, roof_level)
        kept = (relative > _BASE_RELATIVE_HEIGHT) | ~roofs.is_tall[owners]
        rows, line_fractions = rows[kept], line_fractions[kept]
    starts, along = edges.points[rows, 0], edges.points[rows, 1] - edges.points[rows, 0]
    points = starts + line_fractions[:, None] * along
    # A second point halfway to the end of the line gives its direction.
    pairs = np.stack([points, points + 0.5 * (1.0 - line_fractions)[:, None] * along], axis=1)
    owners = edges.building[rows]
    heights = pairs[..., 2].T
    rises = np.stack([roofs.relative_heights(each, owners, roof_level) for each in heights], axis=1)
    lifts = np.stack([roofs.lifts(each, owners, roof_level) for each in heights], axis=1)
    first, last = edges.edge_fractions[rows].T
    outward = rises[:, :1] * roofs.outward(edges.corners[rows], first + line_fractions * (last - first))
    return LinePoints(pairs, rises, lifts, outward, edges.kind[rows].astype(np.int64), owners), spacing_px


# Width and blur of the photo for starts by lines, pixels: lines half a stride off still lie on its edges.
_WIDTH, _BLUR_PX = 320, 2.5
# Strides of their grid: metres horizontally and in height, and degrees.
_STRIDE_M, _STRIDE_Z_M, _STRIDE_YAW_DEG = 2.5, 6.0, 1.5
# The largest size of that grid; strides grow for it.
_MOST_POSES = 100_000
# Their lines are those visible from the grid's middle in a view this many times as wide.
_VIEW_FACTOR = 1.6
# The largest number of points of these lines that are compared.
_MOST_START_POINTS = 600
# The number of starts, and of generations by which each is refined.
_NUM_STARTS, _GENERATIONS = 20, 14


def line_starts(
    context: QueryContext, posterior: PosePosterior, params: RegionParams, streams: Streams
) -> list[Gaussian]:
    """Returns Gaussians of poses at which the map's lines lie along edges of the photo, best start first.

    Args:
        context: the query, its photo and the map.
        posterior: the posterior whose prior is used.
        params: the method's parameters.
        streams: random streams.
    """
    coarse, query, roofs = _with_strides(params), context.query, context.roofs
    levels = context.photo.levels(_BLUR_PX, _WIDTH)
    grid = coarse.grid()
    vectors = grid_poses(grid, query.prior)
    sums = _sums_at(vectors.reshape(-1, grid.z.count, 6), levels, query.camera, roofs)
    best = vectors[local_maxima(sums, grid, coarse.turns_around(), _NUM_STARTS)]
    # Half a stride of the grid, and the prior's deviation of tilt.
    half_m, half_z_m = 0.5 * coarse.stride_m, 0.5 * coarse.stride_z_m
    tilts_deg = params.prior_sigmas()[3:5]
    covariance = np.diag(np.square([half_m, half_m, half_z_m, *tilts_deg, 0.5 * coarse.stride_yaw_deg]))
    ends = []
    for k, start in enumerate(best):
        vector = np.append(start, np.zeros(NUM_AFTER_POSE))
        line_likelihood = LineLikelihood(levels, query, roofs, vector, coarse)
        if len(line_likelihood):
            value, first = _log_posterior(line_likelihood, posterior), Gaussian(start, covariance)
            ends.append(maximize(value, first, _GENERATIONS, params.population, streams("line start", k)))
    return ends


def _log_posterior(line_likelihood: LineLikelihood, posterior: PosePosterior) -> Callable[[Floats], Floats]:
    """Returns the log-posterior of poses (N, 6) by lines, roofs as in the map."""

    def value(vectors: Floats) -> Floats:
        states = np.column_stack([vectors, np.zeros((len(vectors), NUM_AFTER_POSE))])
        return line_likelihood(states) + posterior.prior.log_density(vectors)

    return value


def _with_strides(params: RegionParams) -> RegionParams:
    """Returns the parameters with the strides of the fine grid, longer where it would have too many poses."""
    fine = replace(params, stride_m=_STRIDE_M, stride_z_m=_STRIDE_Z_M, stride_yaw_deg=_STRIDE_YAW_DEG)
    longer = max(1.0, (len(fine.grid()) / _MOST_POSES) ** 0.25)
    return replace(
        fine,
        stride_m=longer * _STRIDE_M,
        stride_z_m=longer * _STRIDE_Z_M,
        stride_yaw_deg=longer * _STRIDE_YAW_DEG,
    )


def _sums_at(vectors: Floats, levels: Levels, photo_camera: Camera, roofs: RaisedRoofs) -> Floats:
    """Returns (N * Z,) the sums of log-ratios along lines, of poses (N, Z, 6) at Z heights."""
    camera = photo_camera.scaled(levels.shape[1], levels.shape[0])
    # (2, 16) of each level on lines of either kind, at the middle strength.
    ratios = np.asarray(_RATIOS[[len(_STRENGTHS) // 2] * 2])
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy

    def at(height: int) -> Floats:
        poses = np.ascontiguousarray(vectors[:, height])
        points, each_px = _some_points(roofs, camera, poses[len(poses) // 2])
        rotations, centers = rotations_from_euler(poses[:, 3:]), np.ascontiguousarray(poses[:, :3])
        view = line_poses(rotations, centers, np.zeros((len(poses), 3))), intrinsics
        sums = np.zeros((len(poses), 1, 1))
        sum_along_lines(points, *view, levels.ravel(), levels.shape, np.zeros(1), ratios, sums)
        return np.asarray(each_px * sums[:, 0, 0])

    return np.stack(list(roofs.parallel_map(at, range(vectors.shape[1]))), axis=1).ravel()


def line_poses(rotations: Floats, centers: Floats, offsets_m: Floats) -> LinePoses:
    """Returns poses in the layout of the kernels that sum along lines.

    Args:
        rotations: (N, 3, 3) cam_from_world.
        centers: (N, 3) metres.
        offsets_m: (N, 3) offsets of all roofs, bases and overhangs beyond those drawn, metres.
    """
    count = len(rotations)
    return LinePoses(
        *(tuple(np.ascontiguousarray(each.reshape(count, -1).T)) for each in (rotations, centers, offsets_m))
    )


def _some_points(roofs: RaisedRoofs, camera: Camera, vector: Floats) -> tuple[LinePoints, float]:
    """Returns some points of the lines in a wider view, and the length that each stands for, pixels."""
    margins = (round(0.5 * (_VIEW_FACTOR - 1.0) * size) for size in (camera.width, camera.height))
    points, spacing_px = points_on_lines(roofs, 0, camera.with_margins(*margins), vector)
    every = max(1, -(-len(points.kinds) // _MOST_START_POINTS))
    some = LinePoints._make(np.ascontiguousarray(each[::every]) for each in points)
    return some._replace(buildings=np.zeros(len(some.kinds), dtype=np.int64)), spacing_px * every
