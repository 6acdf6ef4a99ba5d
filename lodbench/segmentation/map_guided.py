"""``segmenter=map_guided``, ``map_instances``: the map says what shape the buildings have.

``map_guided`` cuts a mask from a silhouette that is nearly right: what lies inside looks alike, and outlines
follow edges. ``map_instances`` has a network find buildings; the map and the photo's edges separate them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input, masks_of_labels
from lodbench.datasets.query import Entry
from lodbench.errors import QueryFault, require_numbers, require_within
from lodbench.geometry import AxisRange, Camera, Pose, PoseGrid, rotations_at_yaws
from lodbench.kernels import minimise_total_variation
from lodbench.rendering import ContourFit, IouFit, RegionFit, appearance_bins, edge_bins
from lodbench.rendering.masks import pack_mask, signed_distance
from lodbench.segmentation.masks import read_photo
from lodbench.segmentation.packaged import Compact, CompactParams
from lodbench.segmentation.probability import resized_photo, working_size
from lodbench.segmentation.protocol import BUILDING_THRESHOLD
from lodbench.storage import digest_of
from lodbench.storage.digest import content_digest
from lodbench.synthesis.mask_degradation import filled

Mask = NDArray[np.bool_]
FloatArray = NDArray[np.float64]

# Samples of the search: every so many pixels, this many turns, this many starts of a climb, masks at a time.
_STEP_PX, _TURNS, _STARTS, _CHUNK = 4.0, 7, 4, 128
# First steps of a climb: pixels, pixels, degrees, logarithm of the scale.
_FIRST_STEPS = np.array([2.5, 2.5, 1.2, 0.01])
_EVALUATIONS = 140
# Weight of edges along the outline beside regions, and their blur.
_EDGE_WEIGHT, _EDGE_BLUR_PX = 2.0, 1.0
# Silhouettes that are enlarged are penalised: nats per pixel at one standard deviation of the logarithm.
_SCALE_SIGMA, _SCALE_PENALTY = 0.02, 5e-4
# Alignments nearer to each other than this are the same: pixels, degrees.
_SAME = np.array([3.0, 3.0, 1.5])


class Alignment(NamedTuple):
    """A silhouette laid over a photo."""

    mask: Mask  # (H, W) where it lies
    fit: float  # nats per pixel that it explains of the photo; see ``RegionFit``
    motion: FloatArray  # (4,) pixels to the right and down, degrees counter-clockwise, logarithm of the scale


def aligned(
    photo: NDArray[np.uint8], guide: Mask, reach_px: float, turn_deg: float, count: int
) -> list[Alignment]:
    """Returns how a silhouette may lie in a photo, best first; none twice.

    A grid of shifts and turns is tried by the code length that the photo's colours save when those inside
    and outside are coded apart. From the best, Nelder and Mead's simplex refines, the
    photo's edges along the outline counted as well.

    Args:
        photo: (H, W, 3) BGR, at the size to work at.
        guide: (H + 2 M, W + 2 M) the silhouette, with a margin M on all sides from which it is moved in.
        reach_px: Longest shift.
        turn_deg: Largest turn.
        count: At most so many.
    """
    height, width = photo.shape[:2]
    colours = RegionFit(*appearance_bins(photo, (width, height), has_texture=False))
    edges = ContourFit(*edge_bins(photo, (width, height), _EDGE_BLUR_PX))

    def value(motion: FloatArray) -> float:
        words = pack_mask(moved(guide, motion, (width, height)))[None]
        penalty = _SCALE_PENALTY * (motion[3] / _SCALE_SIGMA) ** 2
        return float(colours(words)[0] + _EDGE_WEIGHT * edges(words)[0] - penalty)

    grid = _grid(reach_px, turn_deg)
    fits = np.concatenate(
        [
            colours(np.stack([pack_mask(moved(guide, m, (width, height))) for m in grid[k : k + _CHUNK]]))
            for k in range(0, len(grid), _CHUNK)
        ]
    )
    modes = []
    for start in _apart(grid, fits, np.array([1.5 * _STEP_PX, 1.5 * _STEP_PX, turn_deg / 2.0]), _STARTS):
        simplex = np.vstack([start, start + np.diag(_FIRST_STEPS)])
        options = {"initial_simplex": simplex, "maxfev": _EVALUATIONS, "xatol": 0.02, "fatol": 1e-6}
        optimum = scipy.optimize.minimize(lambda m: -value(m), start, method="Nelder-Mead", options=options)
        modes.append(np.asarray(optimum.x, np.float64))
    values = np.array([value(mode) for mode in modes])
    return [
        Alignment(moved(guide, motion, (width, height)), value(motion), motion)
        for motion in _apart(np.array(modes), values, _SAME, count)
    ]


def moved(guide: Mask, motion: FloatArray, size: tuple[int, int]) -> Mask:
    """Returns the (H, W) part of a guide that lies over the photo after a motion about its centre."""
    right, down, turn, log_scale = (float(v) for v in motion)
    height, width = guide.shape
    centre = (0.5 * (width - 1), 0.5 * (height - 1))
    matrix = cv2.getRotationMatrix2D(centre, turn, math.exp(log_scale))
    matrix[:, 2] += (right - 0.5 * (width - size[0]), down - 0.5 * (height - size[1]))
    drawn = cv2.warpAffine(guide.astype(np.uint8) * 255, matrix, size, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(drawn >= 128)


def _grid(reach_px: float, turn_deg: float) -> FloatArray:
    steps = math.ceil(reach_px / _STEP_PX)
    shifts = np.linspace(-reach_px, reach_px, 2 * steps + 1)
    turns = np.linspace(-turn_deg, turn_deg, _TURNS)
    grid = np.stack(np.meshgrid(turns, shifts, shifts, indexing="ij"), axis=-1).reshape(-1, 3)[:, [1, 2, 0]]
    grid = grid[np.hypot(grid[:, 0], grid[:, 1]) <= reach_px * 1.05]
    return np.column_stack([grid, np.zeros(len(grid))])


def _apart(points: FloatArray, values: FloatArray, least: FloatArray, count: int) -> list[FloatArray]:
    """Returns the best points, none within ``least`` of a better one in every number."""
    chosen: list[FloatArray] = []
    for i in np.argsort(-values, kind="stable"):
        if all((np.abs(points[i] - other)[:3] > least).any() for other in chosen):
            chosen.append(points[i])
        if len(chosen) == count:
            break
    return chosen


Floats = NDArray[np.float32]

_VERSION = 1
# Poses of the grid from whose silhouettes alignments start, and its strides: metres, metres, degrees.
_POSES, _STRIDES = 2, (5.0, 15.0, 5.0)


@dataclass(frozen=True, slots=True)
class MapGuidedParams:
    """Settings of ``segmenter=map_guided``.

    Attributes:
        name: Name to report.
        size: Long side that photos are worked on at, pixels.
        range_m: Full width of the prior's error in x and in y that is searched, metres; 0 for none.
        range_z_m: The same in height.
        range_yaw_deg: The same in yaw, degrees.
        reach: How far silhouettes are then moved over the photo, share of its long side.
        turn_deg: How far they are turned.

    Raises:
        ConfigError: A setting is out of range.
    """

    name: str = "map_guided"
    size: int = 300
    range_m: float = 60.0
    range_z_m: float = 60.0
    range_yaw_deg: float = 30.0
    reach: float = 0.1
    turn_deg: float = 6.0

    def __post_init__(self) -> None:
        require_within("segmenter.size", self.size, 64, 2048)
        require_numbers(self, "segmenter", ("range_m", "range_z_m"), 0, 1e4)
        require_within("segmenter.range_yaw_deg", self.range_yaw_deg, 0, 360)
        require_within("segmenter.turn_deg", self.turn_deg, 0, 180)
        require_within("segmenter.reach", self.reach, 0, 0.5, "(]")


class GuidedMask(NamedTuple):
    """A mask made of a photo and silhouettes that are nearly right."""

    probability: Floats  # (h, w) float32 of building, at the working size
    second: Floats | None  # the same of the next best place of the silhouette; None where there is no other
    # Nats per pixel that the photo's looks tell of the best silhouette's sides, each half of the photo
    # measured by the other: 0 or less where the silhouette has nothing to do with the photo
    evidence: float
    ahead: float  # by how much its fit is better than the second's, nats per pixel; 0 without one


class MapGuided:
    """Lays the map's silhouette over the photo, then cuts the photo along its own edges nearby."""

    params_type = MapGuidedParams
    requires = frozenset({Input.IMAGE, Input.MAP})
    provides = frozenset({Input.MASK})

    def __init__(self, params: MapGuidedParams) -> None:
        self.params = params
        self.name = params.name

    def segment(self, entry: Entry) -> Floats:
        """Raises that there is no map here; see ``segment_from``.

        Raises:
            QueryFault: Always.
        """
        raise QueryFault(f"segmenter {self.name} needs a map and a pose")

    def segment_from(self, entry: Entry, pose: Pose, city_map: CityMap) -> Floats:
        """Returns the (h, w) float32 probability of building, in [0, 1], at the working size.

        Raises:
            QueryFault: There is no photo or camera, or no building of the map is in view.
        """
        if entry.image is None or entry.camera is None:
            raise QueryFault("no photo to segment" if entry.image is None else "no camera")
        photo = read_photo(entry.image)
        guides = self._silhouettes(photo, entry.camera, pose, city_map)
        return guided_mask(photo, guides, self.params).probability

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns a digest of the photos' contents and the settings."""
        photos = [[entry.key, content_digest(entry.image)] for entry in entries]
        return digest_of([_VERSION, asdict(self.params), photos])

    def notes(self) -> tuple[str, ...]:
        """Returns a note that such a mask is no independent witness."""
        return ("masks guided by the map are biased towards it: probabilities are overconfident",)

    def _silhouettes(
        self, photo: NDArray[np.uint8], camera: Camera, pose: Pose, city_map: CityMap
    ) -> list[Mask]:
        """Returns the silhouettes, with a margin, of the poses around one that part the photo best."""
        width, height = working_size(camera.width, camera.height, self.params.size)
        small = np.ascontiguousarray(resized_photo(photo, width, height)[..., ::-1])
        ranges = (self.params.range_m, self.params.range_z_m, self.params.range_yaw_deg)
        centers, yaws = search_grid(ranges, _STRIDES).around(pose)
        rotations = rotations_at_yaws(pose.euler.pitch_deg, pose.euler.roll_deg, yaws)
        fits = city_map.fit(
            camera.scaled(width, height),
            rotations,
            centers,
            RegionFit(*appearance_bins(small, (width, height))),
        )
        order = [int(i) for i in np.argsort(-fits, kind="stable")[:_POSES]]
        margin = margin_px(self.params, width, height)
        wide = camera.scaled(width, height).with_margins(margin, margin)
        guides = [city_map.render(wide, Pose.from_center(rotations[i], centers[i])) for i in order]
        guides = [guide for guide in guides if guide.any()]
        if not guides:
            raise QueryFault("no building of the map is in view of the prior")
        return guides


def search_grid(ranges: Sequence[float], strides: Sequence[float]) -> PoseGrid:
    """Returns the grid of poses over full widths and strides, x and y, z (metres), yaw (degrees)."""
    place, height, yaw = (
        AxisRange(width, int(np.ceil(width / stride - 1e-9)) + 1)
        for width, stride in zip(ranges, strides, strict=True)
    )
    return PoseGrid(place, place, height, yaw)


def margin_px(params: MapGuidedParams, width: int, height: int) -> int:
    """Returns how far silhouettes reach beyond a photo's borders, so that what is moved in is known."""
    return int(np.ceil(1.5 * params.reach * max(width, height)))


def guided_mask(photo: NDArray[np.uint8], guides: list[Mask], params: MapGuidedParams) -> GuidedMask:
    """Returns the mask of a photo whose buildings look nearly like some silhouettes.

    Args:
        photo: (H, W, 3) RGB, of any size.
        guides: At the working size, each with ``margin_px`` more on all sides.
        params: How far off they may be.
    """
    height, width = photo.shape[:2]
    width, height = working_size(width, height, params.size)
    small = np.ascontiguousarray(resized_photo(photo, width, height)[..., ::-1])
    reach = params.reach * max(width, height)
    alignments: list[Alignment] = []
    for guide in guides:
        alignments += aligned(small, guide, reach, params.turn_deg, count=2)
    first, *others = sorted(alignments, key=lambda alignment: -alignment.fit)
    probability, evidence = cut(small, first.mask), held_out_evidence(small, first.mask)
    if not others:
        return GuidedMask(probability, None, evidence, 0.0)
    return GuidedMask(probability, cut(small, others[0].mask), evidence, first.fit - others[0].fit)


def without_map(mask: Mask, photo: NDArray[np.uint8], params: MapGuidedParams) -> Mask:
    """Returns a mask of a photo's size as a guide: at the working size, its border carried on outwards."""
    width, height = working_size(photo.shape[1], photo.shape[0], params.size)
    small = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) >= 0.5
    return np.pad(small, margin_px(params, width, height), mode="edge")


# Halves of a chequerboard of this side, pixels, are measured by what the other half looks like.
_BLOCK_PX = 16
# Of what a pixel looks like against the silhouette, and the largest that it may say: nats.
_COLOUR_WEIGHT, _COLOUR_LIMIT = 0.5, 2.5
# The silhouette: nats far inside or outside, and the distance from its outline that reaches them, pixels:
# from one to the other as the outline's exactness goes from the first to the second; see ``exactness``.
_SHAPE_NATS, _SHAPE_PX, _EXACTNESS = 6.0, (8.0, 2.0), (1.1, 1.5)
# How far from an outline its change is looked at, and what still lies on it, pixels.
_ACROSS_PX, _ON_PX = 5, 1
# Cost of an outline per pixel where the photo is flat; at its edges this share of it is left.
_OUTLINE_NATS, _EDGE_SHARE = 1.5, 0.08
# Pixels near the outline say less of their side: full weight from here on, and the least.
_SURE_PX, _LEAST_WEIGHT = 2.0, 0.1
_ITERATIONS = 150


def cut(photo: NDArray[np.uint8], silhouette: Mask, looks: NDArray[np.floating] | None = None) -> Floats:
    """Returns the (H, W) probability of building: 0 or 1 nearly everywhere.

    The global minimum of: nats of each pixel's colour and texture against the silhouette's two histograms,
    plus nats of its distance to the outline, plus the length of the new outline, which is cheap along edges
    of the photo (weighted total variation: Chan, Esedoglu and Nikolova 2006, Bresson et al. 2007; solved as
    Chambolle and Pock 2011). A pixel's histograms are those of other parts of the photo, so that what the
    silhouette covers wrongly does not vouch for itself.

    Args:
        photo: (H, W, 3) BGR, at the size to work at.
        silhouette: (H, W).
        looks: (H, W) nats by which each pixel looks like the inside, where more than this photo tells them.
    """
    stated = cross_fitted(photo, silhouette) if looks is None else looks
    colours = np.clip(stated, -_COLOUR_LIMIT, _COLOUR_LIMIT)
    reach_px = float(np.interp(exactness(photo, silhouette), _EXACTNESS, _SHAPE_PX))
    shape = np.clip(signed_distance(silhouette) / reach_px, -1.0, 1.0)
    costs = -(_COLOUR_WEIGHT * colours + _SHAPE_NATS * shape)
    column_costs, row_costs = _outline_costs(photo)
    return np.asarray(
        minimise_total_variation(costs.astype(np.float32), column_costs, row_costs, _ITERATIONS), np.float32
    )


def cross_fitted(photo: NDArray[np.uint8], silhouette: Mask) -> Floats:
    """Returns (H, W) nats by which a pixel looks like the inside rather than the outside, by other pixels."""
    height, width = silhouette.shape
    bins, num_bins = appearance_bins(photo, (width, height))
    distance = signed_distance(silhouette)
    weight = np.clip(np.abs(distance) / _SURE_PX, _LEAST_WEIGHT, 1.0)
    rows, columns = np.arange(height)[:, None] // _BLOCK_PX, np.arange(width) // _BLOCK_PX
    half = (rows + columns) % 2
    nats = np.zeros((height, width), np.float32)
    for held_out in (0, 1):
        others = half != held_out
        logs = []
        for side in (silhouette & others, ~silhouette & others):
            counts = np.bincount(bins[side], weight[side], num_bins) + 0.5
            logs.append(np.log(counts / counts.sum()))
        nats[~others] = (logs[0] - logs[1])[bins[~others]]
    return np.asarray(cv2.GaussianBlur(nats, (0, 0), 1.0), np.float32)


def held_out_evidence(photo: NDArray[np.uint8], silhouette: Mask) -> float:
    """Returns nats per pixel that a photo's looks tell of a silhouette's sides, measured by other pixels."""
    nats = cross_fitted(photo, silhouette).astype(np.float64)
    share = min(max(float(silhouette.mean()), 1e-6), 1.0 - 1e-6)
    inside, outside = np.log(share), np.log(1.0 - share)
    stated = np.where(silhouette, inside + nats, outside) - np.logaddexp(inside + nats, outside)
    return float(stated.mean() - share * inside - (1.0 - share) * outside)


def exactness(photo: NDArray[np.uint8], silhouette: Mask) -> float:
    """Returns how much more a photo changes across an outline on it than beside it; 1 for no more.

    A silhouette that shows buildings as they are has the photo's edges on its outline, a rough one beside it.
    """
    lab = cv2.cvtColor(photo.astype(np.float32) / np.float32(255), cv2.COLOR_BGR2LAB)
    lab = np.asarray(cv2.GaussianBlur(lab, (0, 0), 0.8), np.float32)
    distance = signed_distance(silhouette)
    normal_x, normal_y = _gradient(np.asarray(cv2.GaussianBlur(distance, (0, 0), 1.5), np.float32))
    steepness = np.hypot(normal_x, normal_y) + np.float32(1e-6)
    normal_x, normal_y = normal_x / steepness, normal_y / steepness
    by_column, by_row = _gradient(np.asarray(lab, np.float32))
    change = np.abs(by_column * normal_x[..., None] + by_row * normal_y[..., None]).sum(axis=2)
    rows, columns = np.nonzero(np.abs(distance) < 1.0)
    across = np.arange(-_ACROSS_PX, _ACROSS_PX + 1, dtype=np.float32)[:, None]
    x = columns + across * normal_x[rows, columns]
    y = rows + across * normal_y[rows, columns]
    profile = cv2.remap(change, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    shares = profile / (profile.sum(axis=0) + np.float32(1e-6))
    on = np.abs(across[:, 0]) <= _ON_PX
    return float(shares[on].mean() * len(across)) if len(rows) else 1.0


def _gradient(picture: Floats) -> tuple[Floats, Floats]:
    """Returns the change of a picture from left to right and from top to bottom."""
    along_x, along_y = (cv2.Sobel(picture, cv2.CV_32F, *axis) for axis in ((1, 0), (0, 1)))
    return np.asarray(along_x, np.float32), np.asarray(along_y, np.float32)


def _outline_costs(photo: NDArray[np.uint8]) -> tuple[Floats, Floats]:
    """Returns what an outline costs between each pixel and its right and its lower neighbour."""
    smooth = cv2.GaussianBlur(photo.astype(np.float32), (0, 0), 0.7)
    along_x, along_y = np.zeros(photo.shape[:2], np.float32), np.zeros(photo.shape[:2], np.float32)
    along_x[:, :-1] = np.abs(np.diff(smooth, axis=1)).max(axis=2)
    along_y[:-1] = np.abs(np.diff(smooth, axis=0)).max(axis=2)
    usual = float((along_x**2).mean() + (along_y**2).mean()) + 1e-6
    costs = (
        _OUTLINE_NATS * (_EDGE_SHARE + (1 - _EDGE_SHARE) * np.exp(-(c**2) / usual))
        for c in (along_x, along_y)
    )
    first, second = costs
    return first.astype(np.float32), second.astype(np.float32)


# Strides of the grid that the map is looked for on: metres in the plane, metres in height, degrees.
_INSTANCE_STRIDES = (5.0, 10.0, 3.0)
# How far within its outline on the map a building is sure, pixels: half a stride moves it that much.
_CORE_PX = 6


@dataclass(frozen=True, slots=True)
class MapInstancesParams:
    """Settings of ``segmenter=map_instances``.

    Attributes:
        name: Name to report.
        size: Long side that photos are brought to, pixels.
        range_m: Full width of the prior's error in x and in y that is searched, metres; 0 for none.
        range_z_m: The same in height.
        range_yaw_deg: The same in yaw, degrees.
        weights: As for ``segmenter=compact``, which says where buildings are.

    Raises:
        ConfigError: A setting is out of range.
    """

    name: str = "map_instances"
    size: int = 512
    range_m: float = 20.0
    range_z_m: float = 60.0
    range_yaw_deg: float = 15.0
    weights: str | None = None

    def __post_init__(self) -> None:
        require_numbers(self, "segmenter", ("range_m", "range_z_m"), 0, 1e3)
        require_within("segmenter.range_yaw_deg", self.range_yaw_deg, 0, 360)


class MapInstances:
    """The mask of ``compact``, parted into buildings where the photo's edges and the map agree best.

    The map is laid over the mask from the pose whose silhouette fits it best. What lies well within a
    building there is that building's; the rest is shared out by a watershed on the photo (Meyer 1992).
    """

    params_type = MapInstancesParams
    requires = frozenset({Input.IMAGE, Input.MAP})
    provides = frozenset({Input.MASK, Input.INSTANCES})

    def __init__(self, params: MapInstancesParams) -> None:
        self.params = params
        self.name = params.name
        self._compact = Compact(CompactParams(size=params.size, weights=params.weights))

    def segment(self, entry: Entry) -> NDArray[np.float32]:
        """Returns the mask of ``compact``, for which the map is not looked at."""
        return self._compact.segment(entry)

    def segment_from(self, entry: Entry, pose: Pose, city_map: CityMap) -> NDArray[np.float32]:
        """Returns the mask of ``compact``."""
        return self.segment(entry)

    def segment_instances(self, entry: Entry) -> Mask:
        """Raises that there is no map here; see ``segment_instances_from``.

        Raises:
            QueryFault: Always.
        """
        raise QueryFault(f"segmenter {self.name} needs a map and a pose")

    def segment_instances_from(self, entry: Entry, pose: Pose, city_map: CityMap) -> Mask:
        """Returns (N, h, w) bool, a mask of each building, at the working size.

        Raises:
            QueryFault: There is no photo or camera, or nothing of the map is in view.
        """
        if entry.image is None or entry.camera is None:
            raise QueryFault("no photo to segment" if entry.image is None else "no camera")
        mask = self.segment(entry) >= BUILDING_THRESHOLD
        height, width = mask.shape
        camera = entry.camera.scaled(width, height)
        ranges = (self.params.range_m, self.params.range_z_m, self.params.range_yaw_deg)
        centers, yaws = search_grid(ranges, _INSTANCE_STRIDES).around(pose)
        rotations = rotations_at_yaws(pose.euler.pitch_deg, pose.euler.roll_deg, yaws)
        best = int(np.argmax(city_map.fit(camera, rotations, centers, IouFit(mask))))
        (buildings,) = city_map.buildings(camera, rotations[best : best + 1], centers[best : best + 1])
        if not (buildings >= 0).any():
            raise QueryFault("no building of the map is in view of the prior")
        photo = resized_photo(read_photo(entry.image), width, height)
        return masks_of_labels(parted(photo, mask, buildings))

    def fingerprint(self, entries: tuple[Entry, ...]) -> str:
        """Returns a digest of the photos' contents, the settings and the weights."""
        settings = {key: value for key, value in asdict(self.params).items() if key != "weights"}
        return digest_of([settings, self._compact.fingerprint(entries)])

    def notes(self) -> tuple[str, ...]:
        """Returns the network's notes, and that such buildings are no independent witness."""
        return (
            *self._compact.notes(),
            "instances separated with the map are biased towards it: probabilities are overconfident",
        )


def parted(photo: NDArray[np.uint8], mask: Mask, buildings: NDArray[np.int32]) -> NDArray[np.uint16]:
    """Returns (H, W) labels that fill a mask, 0 outside it: buildings of a map that lies nearly right.

    Args:
        photo: (H, W, 3) RGB.
        mask: (H, W), where the photo shows buildings.
        buildings: (H, W), which building the map has there, -1 for none.
    """
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _CORE_PX + 1, 2 * _CORE_PX + 1))
    markers = np.zeros(mask.shape, np.int32)
    # The watershed's first basin is what is no building.
    markers[cv2.dilate(mask.astype(np.uint8), disc) == 0] = 1
    for number, building in enumerate(np.unique(buildings[(buildings >= 0) & mask]), start=2):
        inside = ((buildings == building) & mask).astype(np.uint8)
        core = cv2.erode(inside, disc, borderValue=1)
        markers[(core if core.any() else inside) > 0] = number
    basins = cv2.watershed(np.ascontiguousarray(photo[..., ::-1]), markers)
    return filled(np.where(mask & (basins > 1), basins, -1).astype(np.int32), mask)
