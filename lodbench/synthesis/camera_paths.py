"""What pictures to generate, and where cameras are put: one function per path, one line in a table.

``CAMERA_PATHS`` are those of training pictures. ``FLIGHT_PATHS`` are those of flights: poses in the order
they are flown, more than are wanted, for what shows too few buildings, or stands among them, is passed over.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import Field, dataclass, field, fields
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodbench.datasets.pose_text import read_poses
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.errors import ConfigError, DatasetError, require_choice, require_within
from lodbench.geometry import Camera, EulerAngles, Pose
from lodbench.geometry.angles import rotation_from_euler
from lodbench.storage import random_stream
from lodbench.synthesis.land_cover import Ground
from lodbench.synthesis.photo import LookRanges
from lodbench.synthesis.views import target_near, view_of

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
        """Makes sure that a setting is what it may be, and that the pictures follow it."""
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


Floats = NDArray[np.float64]
# Spacings to advise.
_STEPS_M = range(1, 100_000)
Pair = tuple[float, float]


class SurveyArea(NamedTuple):
    """What a path is laid out over, in the frame of a scene."""

    bases: Floats  # (B, 3) middle of each building's base, local metres
    ground: Ground  # ground heights
    origin: Floats  # (3,) of the frame, coordinates of the city's CRS


def _on_grid(params: GenerateParams, area: SurveyArea) -> Iterator[Pose]:
    """Yields the poses of a grid over the buildings, its spacing half the height, as UAVD4L has it."""
    low, high = area.bases[:, :2].min(axis=0), area.bases[:, :2].max(axis=0)
    yaws = params.yaw if params.yaw is not None else range(0, 360, 45)
    spacings = [params.spacing_m or max(1.0, height // 2) for height in params.height]
    _require_laid_out(low, high, spacings, len(yaws) * len(params.pitch))
    for height, spacing in zip(params.height, spacings, strict=True):
        axes = [_steps(low[k], high[k], spacing) for k in (0, 1)]
        spots = np.stack([axis.ravel() for axis in np.meshgrid(*axes)], axis=1)
        centers = np.column_stack([spots, area.ground.at(spots) + height])
        for pitch, center, yaw in product(params.pitches_from_nadir(), centers, yaws):
            yield Pose.from_euler(EulerAngles(pitch, 0.0, float(yaw)), center)


def _require_laid_out(low: Floats, high: Floats, spacings: Sequence[float], views_per_place: int) -> None:
    """Makes sure that the views of a grid at each height can be held, before any are laid out."""

    def views(spacings: Iterable[float]) -> int:
        sides = ([_number(low[k], high[k], spacing) for k in (0, 1)] for spacing in spacings)
        return views_per_place * sum(map(math.prod, sides))

    count = views(spacings)
    if count > MOST_VIEWS:
        few = next((m for m in _STEPS_M if views([m] * len(spacings)) <= MOST_VIEWS), None)
        raise ConfigError(
            f"A grid every {min(spacings):g} m over {high[0] - low[0]:.0f} x {high[1] - low[1]:.0f} m has "
            f"{count:.2g} views, more than {MOST_VIEWS}.",
            f"`spacing_m={few}` makes fewer; so does `sampling=random`."
            if few
            else "Take fewer yaws and pitches.",
        )


def _number(low: float, high: float, spacing: float) -> int:
    return max(1, round((high - low) / spacing))


def _steps(low: float, high: float, spacing: float) -> Floats:
    """Returns places from end to end, about a spacing apart; the middle if there is room for one."""
    number = _number(low, high, spacing)
    return np.linspace(low, high, number) if number > 1 else np.array([0.5 * (low + high)])


def _at_random(params: GenerateParams, area: SurveyArea) -> Iterator[Pose]:
    """Yields poses that look at places near buildings, from any side."""
    for index in range(params.count):
        generator = random_stream(params.seed, "training", "camera", index)
        yield _looking_at(target_near(area.bases, generator), params, generator)


def _looking_at(target: Floats, params: GenerateParams, generator: np.random.Generator) -> Pose:
    """Returns a pose from any side whose axis meets a target, (3,), at one of the pitches and heights."""
    pitches = params.pitches_from_nadir()
    # A camera that looks at the horizon sees its target from no height: keep the axis finite.
    pitch = min(85.0, pitches[int(generator.integers(len(pitches)))])
    height = params.height[int(generator.integers(len(params.height)))]
    return view_of(target, height, EulerAngles(pitch, 0.0, float(generator.uniform(-180.0, 180.0))))


def _anywhere(params: GenerateParams, area: SurveyArea) -> Iterator[Pose]:
    """Yields poses that look at any place of the land, buildings or none: negatives with min_buildings=0."""
    rows, columns = area.ground.heights_m.shape
    size = np.array([columns - 1, rows - 1]) * area.ground.cell_m
    for index in range(params.count):
        generator = random_stream(params.seed, "training", "anywhere", index)
        spot = np.array([area.ground.west, area.ground.south]) + generator.uniform(0.0, size)
        target = np.append(spot, area.ground.at(spot[None])[0])
        yield _looking_at(target, params, generator)


def _near_priors(params: GenerateParams, area: SurveyArea) -> Iterator[Pose]:
    """Yields draws around each given pose."""
    errors = UniformPrior(*params.prior_m, *params.prior_deg)
    for number, pose in enumerate(_given(params, area)):
        for draw in range(params.count):
            yield errors.draw(pose, random_stream(params.seed, "training", "prior", number, draw))


def _along_trajectory(params: GenerateParams, area: SurveyArea) -> Iterator[Pose]:
    """Yields poses along the straight lines between given centres, looking ahead; half their height apart."""
    yaws = params.yaw if params.yaw is not None else (0.0,)
    for start, end in pairwise(pose.center for pose in _given(params, area)):
        way = end - start
        length = float(np.hypot(way[0], way[1]))
        if length == 0.0:
            continue
        ahead = math.degrees(math.atan2(-way[0], way[1]))
        height_m = float(start[2] - area.ground.at(start[None])[0])
        spacing = params.spacing_m or max(1.0, height_m // 2)
        shares = np.arange(0.0, 1.0, min(1.0, spacing / length))
        for share, pitch, yaw in product(shares, params.pitches_from_nadir(), yaws):
            yield Pose.from_euler(EulerAngles(pitch, 0.0, ahead + yaw), start + share * way)


def _given(params: GenerateParams, area: SurveyArea) -> list[Pose]:
    """Returns the poses of ``params.poses``, in the scene's frame."""
    given = [pose.shifted(-area.origin) for pose in read_poses(params.poses or "").values()]
    if not given:
        raise DatasetError(f"{params.poses} has no poses.", "Each line reads: name qw qx qy qz tx ty tz")
    return given


# Each yields poses in the scene's frame, before any is checked.
CAMERA_PATHS: dict[str, Callable[[GenerateParams, SurveyArea], Iterator[Pose]]] = {
    "grid": _on_grid,
    "random": _at_random,
    "anywhere": _anywhere,
    "trajectory": _along_trajectory,
    "priors": _near_priors,
}

# How far a pilot or a gust moves the drone off its path (m), and turns it (deg), standard deviations.
_DRIFT_M, _DRIFT_YAW_DEG, _DRIFT_TILT_DEG = 1.0, 1.5, 0.3


def _grid_flight(target: Floats, generator: np.random.Generator, count: int) -> Iterator[Pose]:
    """Yields poses of parallel lines there and back, the camera looking ahead and down."""
    height_m, pitch_deg = generator.uniform(100.0, 160.0), generator.uniform(20.0, 45.0)
    heading_deg = generator.uniform(-180.0, 180.0)
    lines = max(2, round(math.sqrt(count)))
    steps = 2 * math.ceil(count / lines)
    for line in range(2 * lines):
        turned, back = (180.0, -1) if line % 2 else (0.0, 1)
        for step in range(steps)[::back]:
            ahead = (step - 0.5 * (steps - 1)) * 0.2 * height_m
            aside = (line - (lines - 0.5)) * 0.3 * height_m
            spot = target + _turned(ahead, aside, heading_deg)
            yield _drifting(spot, height_m, pitch_deg, heading_deg + turned, generator)


def _orbit(target: Floats, generator: np.random.Generator, count: int) -> Iterator[Pose]:
    """Yields poses of two circles around a place, which all look at it."""
    height_m, pitch_deg = generator.uniform(100.0, 160.0), generator.uniform(30.0, 60.0)
    first_deg = generator.uniform(-180.0, 180.0)
    for k in range(2 * count):
        yield _drifting(target, height_m, pitch_deg, first_deg + 360.0 * k / count, generator)
        if k == count - 1:
            height_m *= 1.2


def _facade(target: Floats, generator: np.random.Generator, count: int) -> Iterator[Pose]:
    """Yields poses of a strip past a row of buildings, which look at them from the side."""
    return _straight(target, generator, count, (45.0, 80.0), (55.0, 70.0), (0.0, 0.1))


def _corridor(target: Floats, generator: np.random.Generator, count: int) -> Iterator[Pose]:
    """Yields poses along a straight line, the camera looking ahead and down."""
    return _straight(target, generator, count, (70.0, 120.0), (40.0, 60.0), (0.15, 0.0))


# Each yields poses around a target, (3,) metres, given how many are wanted.
FLIGHT_PATHS: dict[str, Callable[[Floats, np.random.Generator, int], Iterator[Pose]]] = {
    "grid": _grid_flight,
    "orbit": _orbit,
    "facade": _facade,
    "corridor": _corridor,
}


def _straight(
    target: Floats, generator: np.random.Generator, count: int, height_m: Pair, pitch_deg: Pair, step: Pair
) -> Iterator[Pose]:
    """Yields poses over a place on a line, each so many heights ahead of the last and to its right."""
    height, pitch = generator.uniform(*height_m), generator.uniform(*pitch_deg)
    heading = generator.uniform(-180.0, 180.0)
    for k in range(2 * count):
        ahead, aside = ((k - 0.5 * (2 * count - 1)) * share * height for share in step)
        spot = target + _turned(ahead, aside, heading)
        yield _drifting(spot, height, pitch, heading, generator)


def _turned(ahead_m: float, aside_m: float, heading_deg: float) -> Floats:
    """Returns (3,) metres east, north and up of a place ahead and to the right of a heading."""
    # The heading counts from north, counter-clockwise, as yaw does.
    turn = math.radians(heading_deg)
    ahead = np.array([-math.sin(turn), math.cos(turn), 0.0])
    return np.asarray(ahead_m * ahead + aside_m * np.array([ahead[1], -ahead[0], 0.0]))


def _drifting(
    target: Floats, height_m: float, pitch_deg: float, yaw_deg: float, generator: np.random.Generator
) -> Pose:
    """Returns the pose that looks at a place from a height above it, but for what a pilot or a gust does."""
    aimed = view_of(target, height_m, EulerAngles(pitch_deg, 0.0, yaw_deg))
    angles = np.array([pitch_deg, 0.0, yaw_deg])
    angles += generator.normal(0.0, [_DRIFT_TILT_DEG, _DRIFT_TILT_DEG, _DRIFT_YAW_DEG])
    center = aimed.center + generator.normal(0.0, _DRIFT_M, size=3)
    return Pose.from_center(rotation_from_euler(EulerAngles(*map(float, angles))), center)
