"""``segmenter=map_instances``: a network finds buildings, map and photo's edges separate them."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input, masks_of_labels
from lodbench.datasets.query import Entry
from lodbench.errors import QueryFault, require_numbers, require_within
from lodbench.geometry import Pose, rotations_at_yaws
from lodbench.rendering import IouFit
from lodbench.segmentation.compact import Compact, CompactParams
from lodbench.segmentation.map_guided import search_grid
from lodbench.segmentation.masks import read_photo
from lodbench.segmentation.probability import resized_photo
from lodbench.segmentation.protocol import BUILDING_THRESHOLD
from lodbench.storage import digest_of
from lodbench.synthesis.mask_degradation import filled

Mask = NDArray[np.bool_]

# Strides of the grid that the map is looked for on: metres in the plane, metres in height, degrees.
_STRIDES = (5.0, 10.0, 3.0)
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
        centers, yaws = search_grid(ranges, _STRIDES).around(pose)
        rotations = rotations_at_yaws(pose.euler.pitch_deg, pose.euler.roll_deg, yaws)
        best = int(np.argmax(city_map.fit(camera, rotations, centers, IouFit(mask))))
        (seen,) = city_map.buildings(camera, rotations[best : best + 1], centers[best : best + 1])
        if not (seen >= 0).any():
            raise QueryFault("no building of the map is in view of the prior")
        photo = resized_photo(read_photo(entry.image), width, height)
        return masks_of_labels(parted(photo, mask, seen))

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


def parted(photo: NDArray[np.uint8], mask: Mask, seen: NDArray[np.int32]) -> NDArray[np.uint16]:
    """Returns (H, W) labels that fill a mask, 0 outside it: buildings of a map that lies nearly right.

    Args:
        photo: (H, W, 3) RGB.
        mask: (H, W), where the photo shows buildings.
        seen: (H, W), which building the map has there, -1 for none.
    """
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _CORE_PX + 1, 2 * _CORE_PX + 1))
    markers = np.zeros(mask.shape, np.int32)
    # The watershed's first basin is what is no building.
    markers[cv2.dilate(mask.astype(np.uint8), disc) == 0] = 1
    for number, building in enumerate(np.unique(seen[(seen >= 0) & mask]), start=2):
        inside = ((seen == building) & mask).astype(np.uint8)
        core = cv2.erode(inside, disc, borderValue=1)
        markers[(core if core.any() else inside) > 0] = number
    basins = cv2.watershed(np.ascontiguousarray(photo[..., ::-1]), markers)
    return filled(np.where(mask & (basins > 1), basins, -1).astype(np.int32), mask)
