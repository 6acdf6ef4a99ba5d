"""Which views are taken: those that show buildings, from free air, of one region only."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.building_boxes import building_boxes
from lodbench.citymodel.scene import Scene
from lodbench.errors import ConfigError, DatasetError
from lodbench.geometry import Pose
from lodbench.rendering.raster import RasterRenderer
from lodbench.storage import random_stream
from lodbench.synthesis.camera_paths import CAMERA_PATHS, Place
from lodbench.synthesis.surroundings.ground import Ground
from lodbench.synthesis.training_data.params import MOST_VIEWS, GenerateParams

SPLITS = ("train", "val", "test")
# Views are judged on pictures this wide: a building of three pixels there has some 40 in full size.
_PREVIEW_WIDTH = 256
_CLEARANCE_M = 2.0

NO_BUILDINGS, IN_BUILDING = "too few buildings in view", "inside a building"
BELOW_GROUND, TWO_REGIONS = "below the ground", "two regions in view"


@dataclass(frozen=True, slots=True, eq=False)
class PlannedView:
    """One view to write."""

    split: str  # ``train``, ``val`` or ``test``
    name: str  # of its files, without ending
    pose: Pose  # in the scene's frame

    @property
    def key(self) -> str:
        """Returns ``split/name``, unique within a set."""
        return f"{self.split}/{self.name}"


class ViewPlan(NamedTuple):
    """What will be written."""

    views: tuple[PlannedView, ...]
    skipped: dict[str, int]
    candidates: int


def regions_of(bases: NDArray[np.float64], val_share: float, test_share: float) -> NDArray[np.int64]:
    """Returns the region of each building, 0 train, 1 validation, 2 test.

    The city is cut across its longer side into three strips that hold these shares of its buildings.
    """
    span = np.ptp(bases[:, :2], axis=0)
    along = bases[:, int(span[1] > span[0])]
    cuts = np.quantile(along, [1.0 - val_share - test_share, 1.0 - test_share])
    region = (along > cuts[0]).astype(np.int64) + (along > cuts[1])
    # A quantile of all buildings is the last one: a share of 0 leaves nobody beyond it.
    return region if val_share > 0 else np.where(region == 1, 0, region)


def plan_views(
    params: GenerateParams, scene: Scene, ground: Ground, progress: Callable[[], None] = lambda: None
) -> ViewPlan:
    """Returns the views to write; with a limit, a random choice of them.

    Raises:
        ConfigError: There are too many views to choose from.
        DatasetError: No view is left, or the file of poses cannot be read or is empty.
    """
    view_filter = _ViewFilter(params, scene, ground)
    place = Place(view_filter.boxes.bases, ground, scene.origin)
    poses = list(islice(CAMERA_PATHS[params.sampling](params, place), MOST_VIEWS + 1))
    if len(poses) > MOST_VIEWS:
        raise ConfigError(
            f"There are more than {MOST_VIEWS} views to choose from.",
            "A smaller `count=`, a larger `spacing_m=`, or fewer heights, pitches and poses make fewer.",
        )
    order = np.arange(len(poses))
    if params.limit is not None:
        order = random_stream(params.seed, "training", "choice").permutation(len(poses))
    taken: dict[int, str] = {}
    skipped: Counter[str] = Counter()
    for index in order.tolist():
        split = view_filter.split_or_reason(poses[index])
        if split in SPLITS:
            taken[index] = split
        else:
            skipped[split] += 1
        progress()
        if len(taken) == params.limit:
            break
    if not taken:
        counts = ", ".join(f"{count} {reason}" for reason, count in sorted(skipped.items()))
        raise DatasetError(
            f"None of {len(poses)} views can be taken: {counts or 'there is none'}.",
            "Other heights and pitches, a smaller min_buildings, or `val_share=0` `test_share=0` may help.",
        )
    names, used = [], Counter[str]()
    for index in sorted(taken):
        name = _name(params, scene, index, poses[index])
        used[name] += 1
        names.append(name if used[name] == 1 else f"{name}-{used[name]}")
    views = [PlannedView(taken[k], name, poses[k]) for k, name in zip(sorted(taken), names, strict=True)]
    return ViewPlan(tuple(views), dict(sorted(skipped.items())), len(poses))


class _ViewFilter:
    """Says which views are taken, of which split; its pictures are small."""

    def __init__(self, params: GenerateParams, scene: Scene, ground: Ground) -> None:
        self._params, self._ground, self.boxes = params, ground, building_boxes(scene)
        camera = params.camera
        width = min(_PREVIEW_WIDTH, camera.width)
        self._camera = camera.scaled_to_width(width)
        self._raster = RasterRenderer(scene, threads=1)
        self._region = np.zeros(scene.num_buildings, dtype=np.int64)
        self._region[self.boxes.building] = regions_of(self.boxes.bases, params.val_share, params.test_share)

    def split_or_reason(self, pose: Pose) -> str:
        """Returns the split of a view, or why it is not taken."""
        center = pose.center[None]
        if center[0, 2] < self._ground.at(center)[0] + _CLEARANCE_M:
            return BELOW_GROUND
        if not self.boxes.are_clear_of(pose.center, _CLEARANCE_M):
            return IN_BUILDING
        building = self._raster.draw(self._camera, pose).building
        seen = np.bincount(self._region[building[building >= 0]], minlength=len(SPLITS)) / building.size
        if self._params.min_buildings == 0 and not seen.any():
            nearest = np.linalg.norm(self.boxes.bases[:, :2] - pose.center[:2], axis=1).argmin()
            return SPLITS[self._region[self.boxes.building[nearest]]]
        if seen.sum() < max(self._params.min_buildings, 1.0 / building.size):
            return NO_BUILDINGS
        most = int(seen.argmax())
        return TWO_REGIONS if seen.sum() - seen[most] > self._params.overlap else SPLITS[most]


def _name(params: GenerateParams, scene: Scene, index: int, pose: Pose) -> str:
    """Returns a name for a pose: its number, or X@Y@Z@PITCH@YAW@ROLL in whole metres and degrees."""
    if params.naming == "index":
        return f"{index:06d}"
    pitch, roll, yaw = pose.euler
    # Cut, not rounded, as UAVD4L's are; a tiny negative zero is no angle.
    numbers = [*(pose.center + scene.origin), pitch, yaw, roll]
    return "@".join(str(int(value + 1e-6 * np.sign(value))) for value in numbers)
