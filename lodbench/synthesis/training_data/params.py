"""Settings of ``lodbench generate-training-data``."""

from __future__ import annotations

import math
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

from lodbench.errors import ConfigError, require_choice, require_within
from lodbench.geometry import Camera
from lodbench.synthesis.camera_paths import CAMERA_PATHS
from lodbench.synthesis.photo import LookRanges

_CHOICES = {
    "sampling": tuple(CAMERA_PATHS),
    "renderer": ("raster", "pyrender"),
    "pitch_from": ("nadir", "horizon"),
    "naming": ("index", "pose"),
    "format": ("jpg", "png"),
    "texture_up": ("auto", "y", "z"),
}
_BOUNDS = {
    "pitch": (0.0, 90.0),
    "height": (1.0, 5000.0),
    "yaw": (-360.0, 360.0),
    "size": (16, 4096),
    "spacing_m": (0.1, 1e5),
    "count": (1, 10_000_000),
    "limit": (1, 10_000_000),
    "sheet": (16, 2048),
    "workers": (1, 1024),
    "fov_deg": (1.0, 150.0),
    "min_buildings": (0.0, 1.0),
    "val_share": (0.0, 0.9),
    "test_share": (0.0, 0.9),
    "overlap": (0.0, 1.0),
    "prior_m": (0.0, 1e4),
    "prior_deg": (0.0, 180.0),
}
# Which camera paths take a setting; the others would leave it unheard.
_PATHS_WITH = {
    "pitch": ("grid", "random", "anywhere", "trajectory"),
    "height": ("grid", "random", "anywhere", "trajectory"),
    "yaw": ("grid", "trajectory"),
    "spacing_m": ("grid", "trajectory"),
    "count": ("random", "anywhere", "priors"),
    "poses": ("trajectory", "priors"),
    "prior_m": ("priors",),
    "prior_deg": ("priors",),
}


@dataclass(frozen=True, slots=True)
class GenerateParams:
    """What to generate, setting by setting as ``conf/generate-training-data.yaml`` says.

    Raises:
        ConfigError: A value is out of range; the message names it.
    """

    city: str
    out: str
    lod: str | None = None
    picture_lod: str | None = None
    crs: str | None = None
    roof_height: str | None = None
    texture_model: str | None = None
    texture_up: str = "auto"
    props: str | None = None
    terrain: str | None = None
    renderer: str = "raster"
    sampling: str = "grid"
    pitch: list[float] = field(default_factory=lambda: [30.0, 60.0])
    pitch_from: str = "nadir"
    height: list[float] = field(default_factory=lambda: [100.0, 150.0])
    yaw: list[float] | None = None
    spacing_m: float | None = None
    count: int = 1000
    poses: str | None = None
    prior_m: tuple[float, float, float] = (10.0, 10.0, 30.0)
    prior_deg: tuple[float, float, float] = (7.5, 1.0, 1.0)
    limit: int | None = None
    size: tuple[int, int] = (1024, 1024)
    fov_deg: float = 65.0
    min_buildings: float = 0.05
    val_share: float = 0.1
    test_share: float = 0.1
    overlap: float = 0.002
    images: bool = True
    labels: bool = False
    depth: bool = False
    occluders_in_mask: bool = False
    naming: str = "index"
    format: str = "jpg"
    sheet: int = 256
    workers: int | None = None
    seed: int = 0
    look: LookRanges = field(default_factory=LookRanges)

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            require_choice(name, getattr(self, name), choices)
        for name in ("pitch", "height", "yaw"):
            if getattr(self, name) == []:
                raise ConfigError(f"{name} is empty.", f"Give it as a list: {name}='[{_BOUNDS[name][0]:g}]'.")
        for name, (low, high) in _BOUNDS.items():
            require_within(name, getattr(self, name), low, high)
        self._require_heard()
        if self.sampling in ("trajectory", "priors") and self.poses is None:
            raise ConfigError(f"sampling={self.sampling} needs poses.", "Add poses=FILE.")
        if self.renderer == "pyrender" and self.texture_model is None:
            raise ConfigError(
                "renderer=pyrender pictures textured meshes only.",
                "Add texture_model=FILE, or leave renderer out.",
            )
        if self.val_share + self.test_share > 0.9:
            raise ConfigError(
                f"val_share={self.val_share:g} and test_share={self.test_share:g} leave little to train on."
            )

    def _require_heard(self) -> None:
        """Makes sure that nothing is set that the pictures would not follow.

        Raises:
            ConfigError: Something is.
        """
        for name, paths in _PATHS_WITH.items():
            if self.sampling not in paths and _plain(getattr(self, name)) != _plain(_DEFAULTS[name]):
                raise ConfigError(
                    f"{name} means nothing to sampling={self.sampling}.",
                    "limit=N takes N views of any sampling."
                    if name == "count"
                    else f"Leave it out, or set sampling={' or '.join(paths)}.",
                )
        if self.texture_model is not None and self.props is not None:
            raise ConfigError("props means nothing to texture_model.", "Leave one of them out.")
        if self.texture_model is None and self.texture_up != "auto":
            raise ConfigError("texture_up means nothing without texture_model.", "Add texture_model=FILE.")

    def pitches_from_nadir(self) -> list[float]:
        """Returns the pitches as the poses have them: 0 straight down, 90 at the horizon."""
        return [90.0 - pitch if self.pitch_from == "horizon" else pitch for pitch in self.pitch]

    @property
    def camera(self) -> Camera:
        """Returns the camera of the pictures: square pixels, principal point in the middle."""
        width, height = self.size
        focal = 0.5 * width / math.tan(math.radians(0.5 * self.fov_deg))
        return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height)


def _plain(value: Any) -> Any:
    """Returns a value to be compared: YAML has lists where there are tuples here."""
    return list(value) if isinstance(value, list | tuple) else value


def _defaults() -> dict[str, Any]:
    made = {
        entry.name: entry.default if entry.default_factory is MISSING else entry.default_factory()
        for entry in fields(GenerateParams)
    }
    return {name: value for name, value in made.items() if value is not MISSING}


_DEFAULTS = _defaults()
