"""``segmenter=map_guided``: the map says what shape the buildings have, the photo what they look like."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lodbench.citymap import CityMap
from lodbench.datasets.inputs import Input
from lodbench.datasets.query import Entry
from lodbench.errors import QueryFault, require_numbers, require_within
from lodbench.geometry import AxisRange, Camera, Pose, PoseGrid
from lodbench.geometry.angles import rotations_at_yaws
from lodbench.rendering import RegionFit, appearance_bins
from lodbench.segmentation.photos import read_photo
from lodbench.segmentation.region_cut import cut, held_out_evidence
from lodbench.segmentation.silhouette_alignment import Alignment, aligned
from lodbench.segmentation.working_size import resized_photo, working_size
from lodbench.storage import digest_of
from lodbench.storage.digest import content_digest

Mask = NDArray[np.bool_]
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
    """A mask made of a photo and silhouettes that are nearly right.

    Attributes:
        probability: (h, w) float32 of building, at the working size.
        second: The same of the next best place of the silhouette; None where there is no other.
        evidence: Nats per pixel that the photo's looks tell of the best silhouette's sides, each half of the
            photo judged by the other: 0 or less where the silhouette has nothing to do with the photo.
        ahead: By how much its fit is better than the second's, nats per pixel; 0 without one.
    """

    probability: Floats
    second: Floats | None
    evidence: float
    ahead: float


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
        """Returns that such a mask is no independent witness."""
        return ("masks guided by the map are biased towards it: probabilities are overconfident",)

    def _silhouettes(
        self, photo: NDArray[np.uint8], camera: Camera, pose: Pose, city_map: CityMap
    ) -> list[Mask]:
        """Returns the silhouettes, with a margin, of the poses around one that part the photo best."""
        width, height = working_size(camera.width, camera.height, self.params.size)
        small = np.ascontiguousarray(resized_photo(photo, width, height)[..., ::-1])
        grid = self._grid()
        centers, yaws = grid.around(pose)
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

    def _grid(self) -> PoseGrid:
        stride, stride_z, stride_yaw = _STRIDES
        place = _axis(self.params.range_m, stride)
        return PoseGrid(
            place, place, _axis(self.params.range_z_m, stride_z), _axis(self.params.range_yaw_deg, stride_yaw)
        )


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
    found: list[Alignment] = []
    for guide in guides:
        found += aligned(small, guide, reach, params.turn_deg, count=2)
    first, *others = sorted(found, key=lambda alignment: -alignment.fit)
    probability, evidence = cut(small, first.mask), held_out_evidence(small, first.mask)
    if not others:
        return GuidedMask(probability, None, evidence, 0.0)
    return GuidedMask(probability, cut(small, others[0].mask), evidence, first.fit - others[0].fit)


def without_map(mask: Mask, photo: NDArray[np.uint8], params: MapGuidedParams) -> Mask:
    """Returns a mask of a photo's size as a guide: at the working size, its border carried on outwards."""
    width, height = working_size(photo.shape[1], photo.shape[0], params.size)
    small = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) >= 0.5
    return np.pad(small, margin_px(params, width, height), mode="edge")


def _axis(width: float, stride: float) -> AxisRange:
    return AxisRange(width, int(np.ceil(width / stride - 1e-9)) + 1)
