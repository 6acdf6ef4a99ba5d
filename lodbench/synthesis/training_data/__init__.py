"""Pictures, masks and poses to train on, of any city."""

from __future__ import annotations

import math
from dataclasses import Field, dataclass, field, fields
from typing import Any

from lodbench.errors import ConfigError, require_choice, require_within
from lodbench.geometry import Camera
from lodbench.synthesis.photo import LookRanges

# Camera paths: the keys of ``CAMERA_PATHS``.
SAMPLINGS = ("grid", "random", "anywhere", "trajectory", "priors")
# Views of one path before any is checked: each takes half a kilobyte, and a millisecond or more to check.
MOST_VIEWS = 2_000_000
# Camera paths that stand at heights; that point cameras at pitches; laid out evenly; drawn by chance.
_HIGH, _EVEN = ("grid", "random", "anywhere"), ("grid", "trajectory")
_POINTED, _DRAWN, _AROUND = (*_HIGH, "trajectory"), ("random", "anywhere", "priors"), ("priors",)
_MANY, _SHARE = (1, 10_000_000), (0.0, 0.9)


def _setting(
    default: Any,
    within: tuple[float, float] | None = None,
    *,
    among: tuple[str, ...] = (),
    paths: tuple[str, ...] = SAMPLINGS,
) -> Any:
    """Returns a field: its default, bounds or names, and the camera paths that do not leave it unheard."""
    stated = {"default": default, "within": within, "among": among, "paths": paths}
    if isinstance(default, list):
        return field(default_factory=lambda: list(default), metadata=stated)
    return field(default=default, metadata=stated)


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
    texture_up: str = _setting("auto", among=("auto", "y", "z"))
    props: str | None = None
    terrain: str | None = None
    renderer: str = _setting("raster", among=("raster", "pyrender"))
    sampling: str = _setting("grid", among=SAMPLINGS)
    pitch: list[float] = _setting([30.0, 60.0], (0.0, 90.0), paths=_POINTED)  # noqa: RUF009
    pitch_from: str = _setting("nadir", among=("nadir", "horizon"))
    height: list[float] = _setting([100.0, 150.0], (1.0, 5000.0), paths=_HIGH)  # noqa: RUF009
    yaw: list[float] | None = _setting(None, (-360.0, 360.0), paths=_EVEN)  # noqa: RUF009
    spacing_m: float | None = _setting(None, (0.1, 1e5), paths=_EVEN)
    count: int = _setting(1000, (1, MOST_VIEWS), paths=_DRAWN)
    poses: str | None = _setting(None, paths=("trajectory", "priors"))
    prior_m: tuple[float, float, float] = _setting((10.0, 10.0, 30.0), (0.0, 1e4), paths=_AROUND)
    prior_deg: tuple[float, float, float] = _setting((7.5, 1.0, 1.0), (0.0, 180.0), paths=_AROUND)
    limit: int | None = _setting(None, _MANY)
    size: tuple[int, int] = _setting((1024, 1024), (16, 4096))
    fov_deg: float = _setting(65.0, (1.0, 150.0))
    min_buildings: float = _setting(0.05, (0.0, 1.0))
    val_share: float = _setting(0.1, _SHARE)
    test_share: float = _setting(0.1, _SHARE)
    overlap: float = _setting(0.002, (0.0, 1.0))
    images: bool = True
    labels: bool = False
    classes: bool = False
    depth: bool = False
    occluders_in_mask: bool = False
    naming: str = _setting("index", among=("index", "pose"))
    format: str = _setting("jpg", among=("jpg", "png"))
    sheet: int = _setting(256, (16, 2048))
    workers: int | None = _setting(None, (1, 1024))
    seed: int = 0
    look: LookRanges = field(default_factory=LookRanges)

    def __post_init__(self) -> None:
        for entry in fields(self):
            if entry.metadata:
                self._require_sound(entry, getattr(self, entry.name))
        if self.sampling in ("trajectory", "priors") and self.poses is None:
            raise ConfigError(f"sampling={self.sampling} needs poses.", "Add `poses=FILE`.")
        if self.renderer == "pyrender" and self.texture_model is None:
            raise ConfigError(
                "renderer=pyrender pictures textured meshes only.",
                "Add `texture_model=FILE`, or leave renderer out.",
            )
        if self.val_share + self.test_share > 0.9:
            raise ConfigError(
                f"`val_share={self.val_share:g}` and `test_share={self.test_share:g}` leave "
                "little to train on."
            )
        if self.texture_model is not None and self.props is not None:
            raise ConfigError("props means nothing to texture_model.", "Leave one of them out.")
        if self.texture_model is None and self.texture_up != "auto":
            raise ConfigError("texture_up means nothing without texture_model.", "Add `texture_model=FILE`.")

    def _require_sound(self, entry: Field[Any], value: Any) -> None:
        """Makes sure that a setting is what it may be, and that the pictures follow it.

        Raises:
            ConfigError: It is not, or they do not.
        """
        name, stated = entry.name, entry.metadata
        if stated["among"]:
            require_choice(name, value, stated["among"])
        if value == []:
            raise ConfigError(f"{name} is empty.", f"Give it as a list: {name}='[{stated['within'][0]:g}]'.")
        if stated["within"]:
            require_within(name, value, *stated["within"])
        if self.sampling not in stated["paths"] and _plain(value) != _plain(stated["default"]):
            raise ConfigError(
                f"{name} means nothing to `sampling={self.sampling}`.",
                "limit=N takes N views of any sampling."
                if name == "count"
                else f"Leave it out, or set `sampling={' or '.join(stated['paths'])}`.",
            )

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
