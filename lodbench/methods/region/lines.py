"""The model's visible lines, roof ridges and outlines alike, laid over the photo's edges.

Regions say roughly where the camera is; lines say exactly, where the map is exact. Whether it is shows in
the photo: beside the lines of an exact map the edges fall off within two or three pixels, beside those of a
coarse one over many.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.query import Query
from lodbench.geometry.angles import rotations_from_euler
from lodbench.methods.contour_alignment.pose_vector import pose_from_vector
from lodbench.methods.protocol import Streams
from lodbench.methods.region.evolution import Cloud, climb
from lodbench.methods.region.params import Params
from lodbench.methods.region.roofs import STEP_M, RaisedRoofs, RoofEvidence, step_of
from lodbench.methods.region.search import Surroundings
from lodbench.rendering.edge_levels import EDGE_LEVELS, count_levels, directed_edge_levels

Floats = NDArray[np.float64]

# Least angle between two faces to be a line, degrees; distance of points and least length of lines, pixels.
_CREASE_DEG, _SPACING_PX, _SHORTEST_PX = 25.0, 3.0, 2.0
# Most points: more say no more.
_MOST_POINTS = 1500
# The photo's blur in each round, pixels, and how far outlines lie apart as it begins, of the fine size.
_ROUNDS = ((3.0, 2.5), (1.5, 1.5), (1.0, 1.0))
_GENERATIONS = 14
# How far roofs lie apart as a round begins, metres.
_ROOFS_APART_M = 0.5
# How strongly edges may stand out along lines: 0 not at all, 1 as ``_RISE`` says.
_STRENGTHS = np.linspace(0.0, 0.97, 12)
# Beside a line: what is on it, what is near it and what is far from it, pixels.
_ON, _NEAR, _FAR = (-1.0, 0.0, 1.0), (-4.0, -3.0, 3.0, 4.0), (-10.0, -9.0, -8.0, 8.0, 9.0, 10.0)


def _log_ratios() -> Floats:
    """Returns (A, 16): by strength, how much likelier a level is on a line than anywhere, logarithm.

    Anywhere, levels are equally likely; on a line their density rises with the cube.
    """
    rise = ((np.arange(EDGE_LEVELS) + 0.5) / EDGE_LEVELS) ** 3
    excess = rise / rise.mean() - 1.0
    return np.asarray(np.log1p(_STRENGTHS[:, None] * excess / -excess.min()))


_RATIOS = _log_ratios()


class LineFit:
    """What the photo's edges say of poses near one: the lines visible from there, wherever they then fall.

    Args:
        photo: As of ``read_picture``.
        query: The query.
        roofs: The map, which says what lines are seen.
        vector: (7,) the pose that they are seen from, and how much higher all roofs then are.
        blur_px: Of the photo, pixels of the working size.
        params: The method's.
    """

    def __init__(
        self,
        photo: NDArray[Any],
        query: Query,
        roofs: RaisedRoofs,
        vector: Floats,
        blur_px: float,
        params: Params,
    ) -> None:
        width = min(params.lines_width, query.camera.width)
        size = width, max(1, round(width * query.camera.height / query.camera.width))
        camera = query.camera.scaled(*size)
        self._intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
        self._levels = directed_edge_levels(photo, size, blur_px)
        pose, step = pose_from_vector(vector[:6]), int(step_of(vector[6]))
        (seen,) = roofs.at(step).edges(camera, pose.rotation[None], pose.center[None], _CREASE_DEG)
        lengths = np.linalg.norm(seen.pixels[:, 1] - seen.pixels[:, 0], axis=1)
        lines = np.flatnonzero(seen.is_visible & (lengths > _SHORTEST_PX))
        self._spacing = max(_SPACING_PX, float(lengths[lines].sum()) / _MOST_POINTS)
        counts = np.maximum(1, np.rint(lengths[lines] / self._spacing).astype(np.int64))
        rows = np.repeat(lines, counts)
        first = np.repeat(np.cumsum(counts) - counts, counts)
        place = (np.arange(len(rows)) - first + 0.5) / np.repeat(counts, counts)
        starts, along = seen.points[rows, 0], seen.points[rows, 1] - seen.points[rows, 0]
        points = starts + place[:, None] * along
        # Halfway to the end of the line, its direction is the same.
        self._points = np.stack([points, points + 0.5 * (1.0 - place)[:, None] * along], axis=1)
        owners, heights = seen.building[rows], self._points[..., 2]
        self._rises = np.stack([roofs.shares(each, owners, step) for each in heights.T], axis=1)
        self._roofs_m = step * STEP_M
        self._kinds = seen.kind[rows].astype(np.int64)
        self._weight = params.lines_weight * self._spacing

    def __len__(self) -> int:
        return len(self._kinds)

    def __call__(self, vectors: Floats) -> Floats:
        """Returns the (N,) logarithm of the likelihood of poses and roofs (N, 7), up to a constant.

        How strongly edges stand out along outlines and along creases is taken as fits each pose best.
        """
        best = (self._counts(vectors) @ _RATIOS.T).max(axis=2)
        return np.asarray(self._weight * best.sum(axis=1))

    def sharpness(self, vector: Floats) -> float:
        """Returns which share of their height edges have lost 3 to 4 pixels beside the lines.

        1 beside lines drawn by a pen, 0 where nothing stands out.
        """
        heights = []
        for offsets in (_ON, _NEAR, _FAR):
            counts = sum(self._counts(vector[None], offset)[0] for offset in offsets)
            ratio = _RATIOS[-1]
            heights.append(float((counts @ ratio).sum() / max(np.sum(counts), 1)))
        on, near, far = heights
        return (on - near) / (on - far) if on > far else 0.0

    def _counts(self, vectors: Floats, offset_px: float = 0.0) -> NDArray[np.int64]:
        counts = np.zeros((len(vectors), 2, EDGE_LEVELS), dtype=np.int64)
        rotations = rotations_from_euler(vectors[:, 3:6])
        centers = np.ascontiguousarray(vectors[:, :3])
        view = rotations, centers, vectors[:, 6] - self._roofs_m, self._intrinsics
        count_levels(self._points, self._rises, self._kinds, *view, self._levels, offset_px, counts)
        return counts


class Aligned(NamedTuple):
    """A pose and a height of roofs that put the model's lines on the photo's edges.

    Attributes:
        vector: (7,) both.
        nats: (N, 7) such to the (N,) logarithm of the likelihood that they are best by.
        sharpness: As of ``LineFit``: whether the map is exact enough for it to count.
    """

    vector: Floats
    nats: Callable[[Floats], Floats]
    sharpness: float


def aligned_by_lines(
    photo: NDArray[Any],
    query: Query,
    roofs: RaisedRoofs,
    vector: Floats,
    evidence: RoofEvidence,
    around: Surroundings,
    params: Params,
    streams: Streams,
) -> Aligned | None:
    """Returns what is near (7,) and puts the model's lines on the photo's edges; None without lines in view.

    Lines alone lead in the first rounds; in the last the regions have their say too.
    """
    for number, (blur_px, spread_px) in enumerate(_ROUNDS):
        fit = LineFit(photo, query, roofs, vector, blur_px, params)
        nats = fit if number < len(_ROUNDS) - 1 else _joined(fit, evidence)
        cloud = around.cloud(vector[:6], evidence.at(vector[6]), spread_px)
        if not len(fit) or cloud is None:
            return None

        def posterior(vectors: Floats, nats: Callable[[Floats], Floats] = nats) -> Floats:
            return nats(vectors) + evidence.log_prior(vectors)

        start = Cloud(vector, evidence.widened(cloud.covariance, _ROOFS_APART_M))
        vector = climb(posterior, start, _GENERATIONS, params.population, streams("lines", number)).mean
    return Aligned(vector, nats, fit.sharpness(vector))


def _joined(fit: LineFit, evidence: RoofEvidence) -> Callable[[Floats], Floats]:
    return lambda vectors: fit(vectors) + evidence.nats(vectors)
