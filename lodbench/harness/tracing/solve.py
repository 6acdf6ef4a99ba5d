"""From what was traced in the photos of a model to buildings in the map's frame: roofs and ground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray
from shapely import Polygon, contains_xy

from lodbench.datasets.exchange.colmap import read_colmap, read_colmap_points
from lodbench.datasets.own import find_photo
from lodbench.datasets.pose_text import FoundPose
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry.similarity import Similarity
from lodbench.harness.photo.flight_inputs import rough_start
from lodbench.harness.tracing.roofs import Roof, Traced, View, snapped_roof, traced_roof, triangulated
from lodbench.photos.map_frame import MapFrame
from lodbench.photos.pose import HeightOptions
from lodbench.storage import random_stream

Floats = NDArray[np.float64]
# Points this near a wall are on it; they are taken from this far around, then from further, metres.
_WALL_M, _REACHES_M, _FEWEST_POINTS = 1.0, (10.0, 20.0, 40.0, 80.0), 60
# Ground is even to so much; so many points, and this share of those at the height with most, are a peak.
_BAND_M, _PEAK_POINTS, _PEAK_SHARE, _POINT_M = 0.8, 4.0, 0.15, 0.1
# Fewer traced places on the ground span no plane.
_FEWEST_GROUND, _FEWEST_GROUND_POINTS = 3, 100
# Planes tried through three points each; how near one a point is, as a share of the model's reach; refits.
_PLANES, _NEAR_SHARE, _REFITS = 500, 0.02, 5
# Share of the model's points below which its ground is put to 0.
_GROUND_SHARE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class TraceRequest:
    """A reconstruction, and how its frame becomes the map's."""

    model: Path  # folder of a COLMAP model
    images: Path  # folder that its names are relative to
    # Rough poses in the map's coordinates, or a similarity of ``lodbench georeference``; or None.
    start: Path | None = None
    # The map's reference system; with no ``start``, the photos' own positions place the model in it.
    crs: str | None = None
    scale: float | None = None  # metres per unit of the model, or None
    is_metric: bool = False  # whether the model is in the map's coordinates already
    heights: HeightOptions = field(default_factory=HeightOptions)  # how the drone's heights become the map's
    # Patterns of names of photos that the map must not use, as they are the benchmark's queries; empty for
    # every second one that nothing is traced in; None where there is no benchmark.
    queries: tuple[str, ...] | None = None


def posed_views(images: Sequence[FoundPose], photos: Path, similarity: Similarity) -> dict[str, View]:
    """Returns the model's photos in the frame that a similarity leads to, by name.

    Those without a file, or a camera that is known here, are left out.

    Raises:
        DatasetError: No image has both.
    """
    views = {}
    for image in images:
        file = find_photo(photos, image.name)
        if image.camera is not None and file is not None:
            views[image.name] = View(image.name, image.camera, similarity.pose(image.pose), file)
    if all(image.camera is None for image in images):
        raise DatasetError(f"No image of the model can be used; {images[0].name}: {images[0].no_camera}")
    if not views:
        raise DatasetError(
            f"{photos} holds no photo of the model; the first is looked for as {images[0].name}.",
            "`--images` is the folder of the model's photos.",
        )
    return views


@dataclass(frozen=True, slots=True)
class Building:
    """A building of the map."""

    roof: Roof  # snapped
    traced: Roof  # the roof as it was traced
    ground: float  # height of the ground around it
    ground_sigma: float  # standard deviation of that

    @property
    def footprint(self) -> Polygon:
        """Returns its plan."""
        return Polygon(self.roof.corners)

    @property
    def moved(self) -> tuple[float, float]:
        """Returns how far snapping moved it: corners in plan, root mean square; the roof, upwards."""
        gaps = self.roof.corners - self.traced.corners
        plan = float(np.sqrt(np.mean(np.sum(gaps**2, axis=1))))
        return plan, self.roof.height - self.traced.height


@dataclass(frozen=True, slots=True, eq=False)
class TracedMap:
    """A traced map."""

    buildings: tuple[Building, ...]  # of it
    placed: PlacedModel  # where the model is
    images: tuple[FoundPose, ...]  # of the model, in the map's coordinates
    queries: tuple[str, ...]  # names of photos not used for the map


class Model:
    """A COLMAP model and its photos, read once.

    Raises:
        DatasetError: The model cannot be read, or none of its photos is there.
    """

    def __init__(self, request: TraceRequest) -> None:
        self.request = request
        self.images = tuple(read_colmap(request.model))
        if not self.images:
            raise DatasetError(f"{request.model} holds no posed image.", "Name another model: sparse/1, ...")
        self.notes = tuple(f"{i.name} is left out: {i.no_camera}" for i in self.images if i.camera is None)
        self.points = read_colmap_points(request.model)
        self.views = posed_views(self.images, request.images, Similarity(1.0, np.eye(3), np.zeros(3)))

    def solved(self, traced: Sequence[Traced]) -> TracedMap:
        """Returns the map of what was traced.

        Raises:
            LodbenchError: There is no roof, the model's scale is not known, a query was traced in, or the
                corners of a roof do not fit each other.
        """
        roofs = [item for item in traced if item.kind == "roof"]
        if not roofs:
            raise DatasetError("No roof is traced.", "Outline one in two photos.")
        queries = self._queries(traced)
        placed = placed_model(self.request, self.images, self.points, traced, self.views)
        placed = replace(placed, notes=(*placed.notes, *self.notes))
        views = {
            name: View(name, view.camera, placed.similarity.pose(view.pose), view.photo, view.kept)
            for name, view in self.views.items()
        }
        used = [view for name, view in views.items() if name not in queries]
        pairs = [(traced_roof(item, views), item) for item in roofs]
        snapped = [(snapped_roof(roof, used), roof) for roof, _ in pairs]
        points = placed.similarity.points(self.points)
        plans = [Polygon(roof.corners) for roof, _ in snapped]
        buildings = [
            Building(roof, start, *ground_height(points, plan, plans, roof.height))
            for (roof, start), plan in zip(snapped, plans, strict=True)
        ]
        images = tuple(image._replace(pose=placed.similarity.pose(image.pose)) for image in self.images)
        return TracedMap(tuple(buildings), placed, images, queries)

    def _queries(self, traced: Sequence[Traced]) -> tuple[str, ...]:
        patterns = self.request.queries
        if patterns is None:
            return ()
        used = {name for item in traced for name in item.pixels}
        if not patterns:
            return tuple(name for name in self.views if name not in used)[1::2]
        chosen = tuple(name for name in self.views if any(fnmatch(name, pattern) for pattern in patterns))
        both = used.intersection(chosen)
        if both:
            raise ConfigError(
                f"{min(both)} is traced in, so the map is not independent of it.",
                "Leave it out of `--queries`.",
            )
        if not chosen:
            raise ConfigError(f"`--queries {' '.join(patterns)}` fits no photo.", "A pattern: 'img_30*'.")
        return chosen


def ground_height(
    points: Floats, plan: Polygon, plans: Sequence[Polygon], roof: float
) -> tuple[float, float]:
    """Returns the height of the ground around a footprint, and its standard deviation.

    Of the sparse points around it and around no other building, those below its roof: the lowest height about
    which many lie is the ground. Trees, cars and walls are above; a few points below are mismatches.

    Args:
        points: (P, 3) of the model, in the map.
        plan: Its footprint.
        plans: All of the map's.
        roof: Height of its roof.

    Raises:
        DatasetError: There are too few points.
    """
    low = points[points[:, 2] < roof - 2.0]
    for other in plans:
        low = low[~contains_xy(other.buffer(_WALL_M), low[:, 0], low[:, 1])]
    for reach_m in _REACHES_M:
        heights = np.sort(low[contains_xy(plan.buffer(reach_m), low[:, 0], low[:, 1]), 2])
        if len(heights) >= _FEWEST_POINTS:
            break
    else:
        raise DatasetError(
            f"{len(heights)} points of the model are around a building, too few for its ground.",
            "The model's points3D file belongs beside its images.",
        )
    grid = np.arange(heights[0], heights[-1] + 2.0 * _BAND_M, 0.1 * _BAND_M)
    many = np.exp(-0.5 * ((grid[:, None] - heights) / (0.5 * _BAND_M)) ** 2).sum(axis=1)
    is_peak = np.r_[True, many[1:] >= many[:-1]] & np.r_[many[:-1] >= many[1:], True]
    is_peak &= many >= max(_PEAK_POINTS, _PEAK_SHARE * many.max())
    middle = grid[np.argmax(is_peak)] if is_peak.any() else heights[0]
    band = heights[np.abs(heights - middle) <= _BAND_M]
    sigma = float(np.hypot(band.std(), _POINT_M))
    return float(np.median(band)), sigma


@dataclass(frozen=True, slots=True, eq=False)
class PlacedModel:
    """Where a model is."""

    similarity: Similarity  # from its frame to the map's
    crs: str | None  # of the map, or None for a frame of its own
    notes: tuple[str, ...]  # where scale, level and place come from


def placed_model(
    request: TraceRequest,
    images: Sequence[FoundPose],
    points: Floats,
    traced: Sequence[Traced],
    views: Mapping[str, View],
) -> PlacedModel:
    """Returns the similarity that the request, or else what was traced, gives.

    Raises:
        LodbenchError: Nothing gives the scale, or rough poses cannot be read or are too few.
    """
    if request.is_metric:
        placed = Similarity(1.0, np.eye(3), np.zeros(3))
        return PlacedModel(placed, request.crs, ("scale, level and place are the model's own",))
    if request.start is not None or request.crs is not None:
        frame = None if request.crs is None else MapFrame(request.crs)
        start = rough_start(request, images, frame)
        source = f"scale, level and place by {start.source}"
        return PlacedModel(start.similarity, request.crs, (source, *start.notes))
    scale, scale_words = _scale(request, traced, views)
    level, level_words = _level(images, points, traced, views)
    middle = np.median([image.pose.center for image in images], axis=0)
    turned = scale * (points - middle) @ level.T
    ground = float(np.quantile(turned[:, 2], _GROUND_SHARE)) if len(turned) else 0.0
    shift = -scale * level @ middle - [0.0, 0.0, ground]
    words = (scale_words, level_words, "north is not known: the map's axes are the model's, made level")
    return PlacedModel(Similarity(scale, level, shift), None, words)


def _scale(request: TraceRequest, traced: Sequence[Traced], views: Mapping[str, View]) -> tuple[float, str]:
    if request.scale is not None:
        return request.scale, f"scale: {request.scale:g} m per unit, as given"
    known = [item for item in traced if item.kind == "length"]
    if not known:
        raise ConfigError(
            "Nothing says how large the model is.",
            "Trace a known length; or give `--scale METRES_PER_UNIT`, `--start FILE`, `--crs CODE` or "
            "`--metric`.",
        )
    ends = [triangulated(item.pixels, views) for item in known]
    ratios = [
        (item.metres or 0.0) / float(np.linalg.norm(b - a)) for item, (a, b) in zip(known, ends, strict=True)
    ]
    scale = float(np.median(ratios))
    spread = f", within {100 * (max(ratios) / min(ratios) - 1):.1f} % of one another" if known[1:] else ""
    count = f"{len(known)} known length{'s' * (len(known) > 1)}"
    return scale, f"scale: {scale:.6g} m per unit by {count}{spread}"


def _level(
    images: Sequence[FoundPose], points: Floats, traced: Sequence[Traced], views: Mapping[str, View]
) -> tuple[Floats, str]:
    """Returns the least turn that makes the model upright, and what it goes by."""
    places = [triangulated(item.pixels, views) for item in traced if item.kind == "ground"]
    ground = np.concatenate([np.zeros((0, 3)), *places])
    words = f"level: {len(ground)} traced places on the ground"
    if len(ground) < _FEWEST_GROUND:
        ground, words = _flattest(points), "level: the plane that most of the model's points are near"
    _, lengths, axes = np.linalg.svd(ground - ground.mean(axis=0), full_matrices=False)
    if len(ground) < _FEWEST_GROUND or lengths[1] < 0.05 * lengths[0]:
        raise DatasetError(
            "Which way is up is not known: what the ground goes by is along one line.",
            "Trace three places on the ground, far apart; or give `--start FILE`.",
        )
    ahead = np.mean([image.pose.rotation[2] for image in images], axis=0)
    up = axes[2] if axes[2] @ ahead < 0 else -axes[2]
    return scipy.spatial.transform.Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix(), words


def _flattest(points: Floats) -> Floats:
    """Returns the points near the plane that most are near: that of the ground, in photos from the air."""
    if len(points) < _FEWEST_GROUND_POINTS:
        raise DatasetError(
            f"Which way is up is not known: the model has {len(points)} points.",
            "Trace three places on the ground, far apart; or give `--start FILE`.",
        )
    generator = random_stream(0, "trace", "level")
    near = _NEAR_SHARE * float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
    corners = points[generator.integers(len(points), size=(_PLANES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    away = (np.abs((points - c[0]) @ normal) for c, normal in zip(corners, normals, strict=True))
    best = max((each < near for each in away), key=np.sum)
    for _ in range(_REFITS):
        middle = points[best].mean(axis=0)
        normal = np.linalg.svd(points[best] - middle, full_matrices=False)[2][2]
        best = np.abs((points - middle) @ normal) < near
    return np.asarray(points[best])
