"""Buildings that stand in the map only: what masks of several photos do not show.

Building by building, how much of what a photo should show of it its mask holds: next to nothing in all photos
is gone. Networks miss small buildings for reasons of their own, so it counts how often this flight's masks
miss other buildings as small as that.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.query import Query
from lodbench.estimation.lens import LensErrors
from lodbench.geometry import Camera, Pose
from lodbench.methods.flight.witnesses import APART_DEG, apart_deg, roof_middles
from lodbench.segmentation import binary_mask

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Less of a building than this says nothing, pixels; a mask that holds less of one than this misses it.
_LEAST_PX, _MISSED = 25, 0.3
# How often a mask shows nothing of a building that is gone: not where neighbours or false patches grow over.
_MISSED_IF_GONE = 0.93
# Share of buildings that are gone beforehand, how many photos of a flight are worth one, and what is told.
_GONE, _HEAT, _SURE = 0.03, 2.0, 0.9
_FEWEST_PHOTOS = 3
# Buildings are as large as each other within a factor of two, told apart by steps of this, octaves of pixels.
_SIZE_STEP = 0.25


# Photos are compared at this width, pixels.
_VIEW_WIDTH = 301


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A photo of a flight, where it was found to be taken.

    Attributes:
        name: Of the photo.
        camera: The lens it was found to have, of the working size.
        pose: Scene frame.
        mask: (H, W) what it shows of buildings.
    """

    name: str
    camera: Camera
    pose: Pose
    mask: NDArray[np.bool_]


def views_of(queries: Sequence[Query], poses: Sequence[Pose], focal: float) -> list[View]:
    """Returns photos to be compared with the map.

    Args:
        queries: The photos.
        poses: Where they were found to be taken.
        focal: By which share the focal length is longer than told.
    """
    views = []
    for query, pose in zip(queries, poses, strict=True):
        whole = query.camera
        small = whole.scaled_to_width(_VIEW_WIDTH)
        camera = LensErrors(focal).pinhole(small)
        views.append(View(query.name, camera, pose, binary_mask(query.mask, small.width, small.height)))
    return views


def gone_buildings(views: Sequence[View], city_map: CityMap) -> list[dict[str, Any]]:
    """Returns the map's buildings that photos do not show, the surest first.

    Eq. (F23) of docs/methods/flight.md.

    Each with ``id``, ``probability``, the ``photos`` that should show it and do not, and ``apart_deg``
    between the directions that they look from: photos from one side err alike.
    """
    seen = [shares_held(view, city_map) for view in views]
    rows = [(building, k, pixels, held) for k, one in enumerate(seen) for building, pixels, held in one]
    if not rows:
        return []
    building, photo, pixels, held = (np.array(column) for column in zip(*rows, strict=True))
    missed, size = held < _MISSED, np.round(np.log2(pixels) / _SIZE_STEP).astype(np.int64)
    shares = {step: _shares_missed(building, missed, size, step) for step in np.unique(size).tolist()}
    centers, places = np.array([view.pose.center for view in views]), roof_middles(city_map.scene)
    found = []
    for each in np.unique(building):
        mine = building == each
        apart = apart_deg(places[int(each)], centers[photo[missed & mine]])
        if np.count_nonzero(missed & mine) < _FEWEST_PHOTOS or apart < APART_DEG:
            continue
        # Other buildings about as large, each counted once however many photos show it.
        odds = 0.0
        for (step, is_missed), times in Counter(zip(size[mine], missed[mine], strict=True)).items():
            names, of_names = shares[int(step)]
            rate = _rate(of_names[names != each])
            gone, there = (_MISSED_IF_GONE, rate) if is_missed else (1.0 - _MISSED_IF_GONE, 1.0 - rate)
            odds += times * np.log(gone / there)
        odds = odds / _HEAT + np.log(_GONE / (1.0 - _GONE))
        probability = float(1.0 / (1.0 + np.exp(-odds)))
        if probability > _SURE:
            photos = [views[k].name for k in photo[mine & missed]]
            name = city_map.scene.building_ids[each]
            found.append(
                {
                    "kind": "demolished",
                    "id": name,
                    "probability": probability,
                    "photos": photos,
                    "apart_deg": apart,
                }
            )
    return sorted(found, key=lambda change: -change["probability"])


def shares_held(view: View, city_map: CityMap) -> list[tuple[int, int, float]]:
    """Returns of each building in view its row, the pixels only it covers, and which share the mask holds."""
    (instances,) = city_map.instances(view.camera, view.pose.rotation[None], view.pose.center[None])
    covers = np.zeros(view.mask.shape, dtype=np.int32)
    crops = [instances.crop(k) for k in range(len(instances))]
    for shape, top, left in crops:
        covers[top : top + shape.shape[0], left : left + shape.shape[1]] += shape
    found = []
    for row, (shape, top, left) in zip(instances.buildings, crops, strict=True):
        window = slice(top, top + shape.shape[0]), slice(left, left + shape.shape[1])
        alone = shape & (covers[window] == 1)
        count = int(np.count_nonzero(alone))
        if count >= _LEAST_PX:
            found.append((int(row), count, float(np.count_nonzero(alone & view.mask[window])) / count))
    return found


def _shares_missed(
    building: NDArray[np.int64], missed: Mask, size: NDArray[np.int64], step: int
) -> tuple[NDArray[np.int64], Floats]:
    """Returns the buildings seen about as large, and in which share of these photos each is missed."""
    like = np.abs(size - step) < 1.0 / _SIZE_STEP
    names, index, counts = np.unique(building[like], return_inverse=True, return_counts=True)
    return names, np.bincount(index, weights=missed[like], minlength=len(names)) / counts


def _rate(shares: Floats) -> float:
    """Returns how often masks miss buildings, given each one's share of photos; never 0 or 1."""
    if len(shares) == 0:
        return 0.2
    # Those that no photo shows may be gone themselves.
    standing = shares[shares < _MISSED_IF_GONE - 0.05] if (shares < 0.5).any() else shares
    return float((0.2 + standing.sum()) / (1.0 + len(standing)))
