"""From a model's own frame to the map's: metres, upright, and on Earth where somebody says where."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from lodbench.datasets.exchange.posed import FoundPose
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry.similarity import Similarity
from lodbench.harness.georeference.start import rough_start
from lodbench.harness.tracing.tracing import Traced, TraceRequest
from lodbench.harness.tracing.views import View, triangulated
from lodbench.photos.map_frame import MapFrame
from lodbench.storage import random_stream

Floats = NDArray[np.float64]

# Fewer traced places on the ground span no plane.
_FEWEST_GROUND, _FEWEST_POINTS = 3, 100
# Planes tried through three points each; how near one a point is, as a share of the model's reach; refits.
_PLANES, _NEAR_SHARE, _REFITS = 500, 0.02, 5
# Share of the model's points below which its ground is put to 0.
_GROUND_SHARE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class PlacedModel:
    """Where a model is.

    Attributes:
        similarity: From its frame to the map's.
        crs: Of the map, or None for a frame of its own.
        notes: Where scale, level and place come from.
    """

    similarity: Similarity
    crs: str | None
    notes: tuple[str, ...]


def placed_model(
    request: TraceRequest,
    images: Sequence[FoundPose],
    points: Floats,
    traced: Sequence[Traced],
    views: Mapping[str, View],
) -> PlacedModel:
    """Returns the similarity that the request, or else what was traced, gives.

    Args:
        request: With a start, a reference system or a scale, or none of them.
        images: Of the model.
        points: (N, 3) of the model.
        traced: Known lengths and places on the ground are used where the request says nothing.
        views: The model's photos, in its own frame.

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
    """Returns metres per unit of the model, and where that is from."""
    if request.scale is not None:
        return request.scale, f"scale: {request.scale:g} m per unit, as given"
    known = [item for item in traced if item.kind == "length"]
    if not known:
        raise ConfigError(
            "Nothing says how large the model is.",
            "Trace a known length; or give --scale METRES_PER_UNIT, --start FILE, --crs CODE or --metric.",
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
            "Trace three places on the ground, far apart; or give --start FILE.",
        )
    ahead = np.mean([image.pose.rotation[2] for image in images], axis=0)
    up = axes[2] if axes[2] @ ahead < 0 else -axes[2]
    return scipy.spatial.transform.Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix(), words


def _flattest(points: Floats) -> Floats:
    """Returns the points near the plane that most are near: that of the ground, in photos from the air."""
    if len(points) < _FEWEST_POINTS:
        raise DatasetError(
            f"Which way is up is not known: the model has {len(points)} points.",
            "Trace three places on the ground, far apart; or give --start FILE.",
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
