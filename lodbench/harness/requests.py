"""What requests to find photos in a city have in common; what is None is taken from the photos themselves."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from lodbench.citymodel.options import ReadOptions
from lodbench.errors import require_within
from lodbench.geometry import Camera, CameraSigmas
from lodbench.photos.pose import HeightOptions, RoughPlace
from lodbench.segmentation import Segmenter


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
