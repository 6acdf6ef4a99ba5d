"""One's own photos: localised one by one, checked, and made into datasets."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodbench.citymodel.options import ReadOptions
from lodbench.datasets.pose_text import format_camera
from lodbench.errors import DatasetError, require_within
from lodbench.evaluation import PoseError
from lodbench.geometry import Camera, CameraSigmas, Pose
from lodbench.methods import Method
from lodbench.photos.map_frame import GeoPose
from lodbench.photos.measurements import Measurements, measured_of
from lodbench.photos.metadata import PhotoMetadata
from lodbench.photos.pose import HeightOptions, RoughPlace
from lodbench.reporting.answers import UNTRUSTED, trust_word
from lodbench.segmentation import Segmenter
from lodbench.storage.json_text import finite

_SIGMA_NAMES = ("x_m", "y_m", "z_m", "pitch_deg", "roll_deg", "yaw_deg")


@dataclass(frozen=True, slots=True, kw_only=True)
class CityRequest:
    """A city model, how it is read, and how photos are laid on it.

    Attributes:
        city: City model.
        out: Folder to write.
        segmenter: Makes masks where there are none.
        heights: How the drone's heights become the city's.
        lod: Level of detail, or None for the lowest.
        options: How to read the city.
        roof_height: Rule by which an absent level 1 is derived, or None.
    """

    city: Path
    out: Path
    segmenter: Segmenter | None = None
    heights: HeightOptions = field(default_factory=HeightOptions)
    lod: str | None = None
    options: ReadOptions = field(default_factory=ReadOptions)
    roof_height: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RoughRequest(CityRequest):
    """Besides, what is known of a photo before what it states.

    Attributes:
        camera: Intrinsics of the photo as stored, lens distortion included.
        camera_sigmas: How well these are known, None for exactly.
        given: Rough place and angles.
        center: Rough place in the city's coordinates (east, north, up, metres); goes before all others.

    Raises:
        ConfigError: A coordinate of ``center`` is not finite.
    """

    camera: Camera | None = None
    camera_sigmas: CameraSigmas | None = None
    given: RoughPlace = field(default_factory=RoughPlace)
    center: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        require_within("--center", self.center, -math.inf)


@dataclass(frozen=True, slots=True, eq=False)
class RoughPoses:
    """What a file says of photos.

    Attributes:
        source: The file.
        poses: By the photo's file, in the city's coordinates.
        notes: What the reader should know of them.
    """

    source: Path
    poses: Mapping[Path, Pose]
    notes: tuple[str, ...] = ()

    def of(self, photo: Path) -> Pose:
        """Returns the rough pose of a photo.

        Raises:
            DatasetError: The file has none.
        """
        if photo not in self.poses:
            raise DatasetError(
                f"{self.source} has no pose of {photo.name}.", "`--start` needs one of each photo."
            )
        return self.poses[photo]


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoRequest(RoughRequest):
    """What to localise, and how.

    Attributes:
        photo: The photo.
        mask: Building mask of the photo as it is stored, white = building; goes before the segmenter.
        method: How to localise; LoD-Loc v2 by default.
        seed: Seed of the search.
        start: Rough poses of photos, which go before all else that is known of these; None without any.
        has_prior_range: Whether a person said how far off rough poses may be: photos are not asked then.
        workers: Processes that several photos are shared out to; 1 for this one.
    """

    photo: Path
    mask: Path | None = None
    method: Method | None = None
    seed: int = 0
    start: RoughPoses | None = None
    has_prior_range: bool = False
    workers: int = 1

    def measured_of(self, stated: PhotoMetadata) -> Measurements | None:
        """Returns what was measured beside a photo, deviations of those numbers that are its own among it."""
        if self.start is not None or self.has_prior_range:
            return measured_of(stated, self.heights, range(6))
        given = self.given
        place = given.latitude_deg if self.center is None else self.center
        height = given.height_m if self.center is None else self.center
        others = (place, place, height, given.pitch_deg, given.roll_deg, given.heading_deg)
        return measured_of(stated, self.heights, [k for k, v in enumerate(others) if v is not None])

    @property
    def threads(self) -> int | None:
        """Returns the renderer's threads: one beside other workers, else one per core."""
        return None if self.workers == 1 else 1

    @property
    def has_height(self) -> bool:
        """Returns whether the rough pose's height is in the city's heights, and not what a drone states."""
        return self.start is not None or self.center is not None or self.given.height_m is not None


@dataclass(frozen=True, slots=True, eq=False)
class LocalizedPhoto:
    """The answer.

    Attributes:
        photo: File name.
        crs: Reference system of ``pose``, or None for a local frame.
        lod: Level of detail localised against.
        pose: In the city's coordinates.
        prior: Likewise.
        moved: How far the estimate lies from the prior.
        score: Of the method: the overlap (IoU) of mask and model for LoD-Loc v2; NaN where it has none.
        probability: That the pose is within 2 m and 2 degrees, where the method knows it.
        covariance: (6, 6) of the error in x, y, z (metres), pitch, roll and yaw (degrees), where it knows it.
        sigmas: Standard deviations of x, y, z (metres), pitch, roll and yaw (degrees), where it knows them.
        alternatives: Other poses that fit nearly as well, in the city's coordinates, best first.
        alternative_probabilities: Of each, where the method knows them; else empty.
        is_trusted: Whether the pose is more likely right than wrong, as far as can be known.
        place: Where on Earth, or None without a reference system.
        camera: Pinhole that was localised.
        stored_camera: Of the photo as stored, lens included.
        camera_source: Where its numbers came from.
        lens_percent: Standard deviation of its focal length, percent; None for one that was calibrated.
        camera_sigmas: Standard deviations of all of the camera's numbers.
        overlay: Picture written.
        geojson: Map written, or None without a reference system.
        notes: What the reader should know.
        is_laser_used: Whether pose and covariance include a laser's range.
        method_notes: Those of them that the method gives to this very answer.
        features: Of the map.
        thumbnail: A small JPEG of the photo as the pinhole sees it; None where it cannot be decoded.
    """

    photo: str
    crs: str | None
    lod: str
    pose: Pose
    prior: Pose
    moved: PoseError
    score: float
    probability: float | None
    covariance: NDArray[np.float64] | None
    sigmas: tuple[float, ...] | None
    alternatives: tuple[Pose, ...]
    alternative_probabilities: tuple[float, ...]
    is_trusted: bool
    place: GeoPose | None
    camera: Camera
    stored_camera: Camera
    camera_source: str
    lens_percent: float | None
    camera_sigmas: CameraSigmas
    overlay: Path
    geojson: Path | None
    notes: tuple[str, ...]
    is_laser_used: bool = False
    method_notes: tuple[str, ...] = ()
    features: tuple[dict[str, Any], ...] = ()
    thumbnail: bytes | None = None

    @property
    def trust(self) -> str:
        """Returns how far it may be trusted, in a word; "-" where nothing tells."""
        if not self.is_trusted:
            return UNTRUSTED
        return "-" if self.probability is None else trust_word(self.probability)

    @property
    def view(self) -> Path:
        """Returns the file that shows it over the city in three dimensions, where that was written."""
        return self.overlay.with_name(f"{self.overlay.stem.removesuffix('_overlay')}_3d.html")

    def to_json(self) -> dict[str, Any]:
        """Returns plain values for JSON, units in the names; None for a number that is none."""
        values = {
            "photo": self.photo,
            "place": None if self.place is None else self.place._asdict(),
            "crs": self.crs,
            "lod": self.lod,
            "pose": _pose_values(self.pose),
            "prior": _pose_values(self.prior),
            "moved_m": self.moved.translation_m,
            "turned_deg": self.moved.rotation_deg,
            "score": self.score,
            "probability": self.probability,
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "sigmas": None if self.sigmas is None else dict(zip(_SIGMA_NAMES, self.sigmas, strict=True)),
            "alternatives": [
                _pose_values(pose) | {"probability": probability}
                for pose, probability in zip_longest(self.alternatives, self.alternative_probabilities)
            ],
            "trusted": self.is_trusted,
            "trust": self.trust,
            "camera": {
                "colmap": [*self.camera.to_colmap()],
                "as_stored": format_camera("", self.stored_camera).strip(),
                "source": self.camera_source,
                "lens_percent": self.lens_percent,
                "sigmas": asdict(self.camera_sigmas),
            },
            "overlay": str(self.overlay),
            "geojson": None if self.geojson is None else str(self.geojson),
            "notes": list(self.notes),
            **({"laser_used": True} if self.is_laser_used else {}),
        }
        plain: dict[str, Any] = finite(values)
        return plain


def _pose_values(pose: Pose) -> dict[str, Any]:
    return {
        "center_m": [float(v) for v in pose.center],
        **pose.euler._asdict(),
        "quat_wxyz": list(pose.quat_wxyz),
        "translation_m": [float(v) for v in pose.translation],
    }
