"""Benches over what is drawn over a city: `lodbench bench accuracy`, `flights`, `tracking`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lodbench.bench import SEED, Report, tracking
from lodbench.bench.accuracy import measure_accuracy, measure_cities
from lodbench.bench.flights import measure_flights
from lodbench.cli.options import require_frames_looked_at, segmenter_of
from lodbench.datasets.inputs import Input
from lodbench.errors import ConfigError, DatasetError, require_within
from lodbench.execution import ProgressCallback
from lodbench.geometry.camera import CALIBRATED
from lodbench.methods import Method
from lodbench.methods.flight import FlightMethod, FlightParams
from lodbench.methods.flight.params import RELATIVE_POSES
from lodbench.methods.georeference import Georeference, GeoreferenceParams
from lodbench.methods.registry import make_method
from lodbench.params import flag, part
from lodbench.synthesis.camera_paths import FLIGHT_PATHS
from lodbench.synthesis.flights import FlightsParams
from lodbench.synthesis.photo import look_ranges
from lodbench.synthesis.views import FINE_SIZE, PHOTO_SIZE, RGB_CAMERA
from lodbench.synthesis.views_dataset import AREAS, CAMERA_SOURCES, Perturbation, ViewsParams

_WORLD = (
    "how the views differ from the map and the stated camera: shared_roofs and hidden_feet in metres, focal "
    "as a share, tilt as a factor on the stated one, center as a share of the width, k1"
)


def whole_numbers(what: str, text: str, hint: str) -> list[int]:
    """Returns the whole numbers of a comma-separated text.

    Raises:
        ConfigError: It holds another word.
    """
    try:
        return [int(word) for word in text.split(",")]
    except ValueError as error:
        raise ConfigError(f"{what} are whole numbers, not {text!r}.", hint) from error


def seeds(text: str) -> list[int]:
    """Returns seeds as typed.

    Raises:
        ConfigError: One is no whole number, or given twice: what it draws would count twice.
    """
    hint = "Write --seeds 0,1,2"
    numbers = whole_numbers("Seeds", text, hint)
    if len(set(numbers)) < len(numbers):
        raise ConfigError(f"A seed is given twice: {text}.", hint)
    return numbers


def _range(text: str) -> tuple[float, float]:
    """Returns LOW,HIGH as typed, or in brackets as settings have them."""
    try:
        low, high = (float(part) for part in text.strip("[]").split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text} is not LOW,HIGH, as in 40,80") from None
    return low, high


@dataclass(frozen=True, kw_only=True)
class DrawnOptions:
    """What is drawn over a city."""

    views: int = flag(200, "seeded views (200)", sets=("dataset.num_views",))
    seed: int = flag(0, SEED)
    seeds: tuple[int, ...] = flag(
        (),
        "seeds, comma-separated, each with views of its own; instead of --seed",
        type=seeds,
        action="store",
    )
    mask_iou: float = flag(0.88, "of the degraded masks (0.88)", sets=("dataset.mask_iou",))
    tilt_width: float = flag(
        1.0, "prior's tilt error, +- degrees (1.0)", "--tilt-width", "--tilt-deg", sets=("dataset.tilt_deg",)
    )
    prior_range: float | None = flag(
        None, "prior's error along x, y and z, +- metres (10, 10, 30)", sets=("dataset.range_m",)
    )
    prior_height: float | None = flag(None, "prior's error along z, +- metres", sets=("dataset.height_m",))
    camera_height: tuple[float, float] = flag(
        (100.0, 160.0),
        "of the cameras above the ground, metres (100,160); lower over a village",
        type=_range,
        nargs=None,
        metavar="LOW,HIGH",
        sets=("dataset.camera_height_m",),
    )
    building_share: tuple[float, float] = flag(
        (0.1, 0.8),
        "of buildings in a picture; other views are drawn again (0.1,0.8)",
        type=_range,
        nargs=None,
        metavar="LOW,HIGH",
        sets=("dataset.building_share",),
    )
    area: str | None = flag(None, "half of the city to look at (all of it)", choices=AREAS)
    mask_lod: str | None = flag(
        None, "level of detail that views and masks are drawn from, or finest (the map's)"
    )
    map_lod: str | None = flag(None, "level of detail that is searched (the lowest)", sets=("lod",))
    roof_height: str | None = flag(
        None, "derive an absent LoD1: median, max, p70 or eave", metavar="RULE", sets=("roof_height",)
    )
    camera_source: str = flag(
        CALIBRATED.source,
        "how well the stated camera is known: calibration, maker or nominal (calibration)",
        choices=tuple(CAMERA_SOURCES),
    )
    rtk: float | None = flag(
        None, "priors where an RTK receiver has them, to so many metres (none)", metavar="M"
    )
    laser: float | None = flag(
        None, "a laser's range to the photo's centre, to so many metres (none)", metavar="M"
    )
    world: str = flag("", _WORLD, metavar="NAME=VALUE,...")

    def each_seed(self) -> Sequence[int]:
        """Returns the seeds of what is drawn."""
        return self.seeds or [self.seed]

    def over(self, city: Path | None) -> ViewsParams:
        """Returns what is drawn over a city, or the demo town.

        Raises:
            LodbenchError: The city is not there, or an option is out of range.
        """
        params = ViewsParams(
            city_model="",
            num_views=self.views,
            mask_iou=self.mask_iou,
            tilt_deg=self.tilt_width,
            range_m=self.prior_range,
            rtk_m=self.rtk,
            laser_m=self.laser,
            height_m=self.prior_height,
            camera_height_m=self.camera_height,
            building_share=self.building_share,
            area=self.area,
            lod=self.map_lod,
            mask_lod=self.mask_lod,
            roof_height=self.roof_height,
            world=_world(self.world),
            camera_source=self.camera_source,
        )
        # After all options are checked: making the demo town takes minutes.
        return replace(params, city_model=str(city_file(city)))


@dataclass(frozen=True, kw_only=True)
class ViewedOptions:
    """Methods over views of cities."""

    method: str = flag("lodlocv2", "methods, comma-separated (lodlocv2)")
    look: str | None = flag(
        None, "draw photos in this look: plain, varied or hard (none), for methods that look at photos"
    )
    city: tuple[Path, ...] = flag((), "city model, repeat for a table of several; the demo town")
    drawn: DrawnOptions = part(DrawnOptions)

    def methods(self) -> list[Method]:
        """Returns the methods named.

        Raises:
            ConfigError: There is none of a name, or one looks at photos and none are drawn.
        """
        # One named twice would count its views twice.
        methods = [make_method(name) for name in dict.fromkeys(self.method.split(","))]
        blind = [method.name for method in methods if Input.IMAGE in method.requires]
        if blind and self.look is None:
            raise ConfigError(f"{blind[0]} looks at photos, and no photos are drawn.", "Add --look hard.")
        return methods

    def views(self) -> list[ViewsParams]:
        """Returns what is drawn over each city named.

        Raises:
            LodbenchError: A city is not there, the look is not known, or an option is out of range.
        """
        if self.look is not None:
            look_ranges(self.look)  # not known: reported before any city is read
        cities = dict.fromkeys(self.city or [None])
        return [replace(self.drawn.over(city), look=self.look) for city in cities]


@dataclass(frozen=True, kw_only=True)
class AccuracyWords:
    """What `bench accuracy` is given."""

    pictures: Path | None = flag(None, "folder for reliability and risk over coverage")
    viewed: ViewedOptions = part(ViewedOptions)


def _world(text: str) -> Perturbation:
    """Returns the world of ``--world``.

    Raises:
        ConfigError: There is none, in the words that were typed.
    """
    try:
        return Perturbation.parse(text)
    except ConfigError as fault:
        message, hint = (words.marked.replace("world.", "") for words in (fault.message, fault.hint))
        raise ConfigError(f"--world {text}: {message}", hint) from fault


def city_file(city: Path | None) -> Path:
    """Returns the city requested, or the demo town's.

    Raises:
        DatasetError: It is not there.
    """
    if city is not None:
        if not city.exists():
            raise DatasetError(f"The city model {city} does not exist.", "Check the path after --city.")
        return city
    from lodbench.synthesis.demo import DemoParams, open_demo
    from lodbench.synthesis.town.build import CITY_FILE

    return open_demo(DemoParams()).root / CITY_FILE


def accuracy(given: AccuracyWords, steps: ProgressCallback) -> Report:
    """Returns what methods find, of one city or of several."""
    methods, drawn, seeds = given.viewed.methods(), given.viewed.views(), given.viewed.drawn.each_seed()
    measure = measure_accuracy if len(drawn) == 1 else measure_cities
    return measure(drawn[0] if len(drawn) == 1 else drawn, seeds, methods, steps)  # type: ignore[arg-type]


def _counts(text: str) -> list[int]:
    return whole_numbers("Numbers of photos", text, "Write --joint 100,250,500")


def _share(what: str) -> Any:
    return flag(0.0, f"share of buildings that {what} (0)")


@dataclass(frozen=True, kw_only=True)
class FlightsWords:
    """What `bench flights` is given."""

    city: Path = flag(..., "city model")
    seeds: tuple[int, ...] = flag(
        (0,), "comma-separated, each with flights of its own (0)", type=seeds, action="store"
    )
    flights: int = flag(2, "of each seed (2)")
    photos: int = flag(20, "of each flight (20)")
    path: str | None = flag(None, "how they fly (all of them in turn)", choices=tuple(FLIGHT_PATHS))
    map_lod: str | None = flag(None, "level of detail that is searched (the lowest)", sets=("lod",))
    mask_lod: str | None = flag(None, "level of detail that photos show, or finest (the map's)")
    look: str | None = flag(None, "draw photos in this look: plain, varied or hard (none)")
    segmenter: str | None = flag(None, "masks of drawn photos by it (silhouettes, degraded)", metavar="NAME")
    photo_width: int = flag(PHOTO_SIZE[0], f"of drawn photos, pixels ({PHOTO_SIZE[0]})")
    reconstruct: bool = flag(False, "by COLMAP, from the photos (pycolmap)")
    method: str = flag("flight", "(flight)", choices=("flight", "georeference"))
    relative_poses: str = flag("auto", "(auto)", choices=RELATIVE_POSES)
    focal: float = flag(0.0, "focal lengths off by up to this share (0)")
    shared_height: float = flag(28.0, "heights off by up to, metres (28)")
    joint: tuple[int, ...] = flag(
        (), "time joint solves of so many photos, as 100,250", metavar="COUNTS", type=_counts, action="store"
    )
    memory: bool = flag(False, "of --joint too, which takes longer")
    wrong_heights: float = _share("are wrong by 1.5 to 5 m")
    missing: float = _share("lack")
    extra: float = _share("are extra")

    def __post_init__(self) -> None:
        require_within("--flights", self.flights, 1)
        require_within("--photos", self.photos, 1)
        require_within("--focal", self.focal, 0, 0.2)
        require_within("--shared-height", self.shared_height, 0)
        for name in ("wrong_heights", "missing", "extra"):
            require_within(f"--{name.replace('_', '-')}", getattr(self, name), 0, 0.5)
        require_within("--photo-width", self.photo_width, FINE_SIZE[0], RGB_CAMERA.width)


@dataclass(frozen=True, kw_only=True)
class TrackingWords:
    """What `bench tracking` is given."""

    measured: tracking.TrackingOptions = part(tracking.TrackingOptions)
    segmenter: str = flag("compact", "(compact)", metavar="NAME")
    city: Path = flag(..., "city model")
    seeds: tuple[int, ...] = flag((0,), "comma-separated (0)", type=seeds, action="store")


def measure_flight_recall(options: FlightsWords, steps: ProgressCallback) -> Report:
    """Returns what the command measures.

    Raises:
        LodbenchError: An option is out of range, or as ``measure_flights``.
    """
    _require_drawn(options)
    flights = FlightsParams(
        city_model=str(options.city),
        num_flights=options.flights,
        num_photos=options.photos,
        path=options.path,
        lod=options.map_lod,
        mask_lod=options.mask_lod,
        look=options.look,
        photo_width=options.photo_width,
        reconstruct=options.reconstruct,
        focal=options.focal,
        shared_height_m=options.shared_height,
        wrong_heights=options.wrong_heights,
        missing=options.missing,
        extra=options.extra,
    )
    method = FlightMethod(FlightParams(relative_poses=options.relative_poses))
    if not options.joint:
        segmenter = None if options.segmenter is None else segmenter_of(options.segmenter)
        if options.method == "georeference":
            inner = {"relative_poses": options.relative_poses}
            placed = Georeference(GeoreferenceParams(settings=inner))
            return measure_flights(flights, options.seeds, placed, steps, segmenter)
        return measure_flights(flights, options.seeds, method, steps, segmenter)
    flights = replace(flights, flights_seed=options.seeds[0], path=flights.path or "orbit")
    return tracking.measure_joint_solves(
        flights, options.joint, method, traces_memory=options.memory, progress=steps
    )


def _require_drawn(options: FlightsWords) -> None:
    """Refuses here what flights would refuse by names that are not typed."""
    city_file(options.city)
    if options.reconstruct and options.look is None:
        raise ConfigError("--reconstruct needs photos.", "Add --look plain.")
    if options.method == "georeference" and (options.joint or not options.reconstruct):
        raise ConfigError(
            "--method georeference needs a reconstruction.",
            "Add --reconstruct --look plain, and leave --joint out.",
        )
    if options.segmenter is not None and (options.look is None or options.joint):
        raise ConfigError("--segmenter needs drawn photos.", "Add --look varied, and leave --joint out.")
    if options.relative_poses == "reconstruction" and not options.reconstruct:
        raise ConfigError("--relative-poses reconstruction needs one.", "Add --reconstruct --look plain.")
    if options.relative_poses == "tracks" and options.look is None:
        raise ConfigError("--relative-poses tracks needs photos.", "Add --look plain.")


def measure_track(options: TrackingWords, steps: ProgressCallback) -> Report:
    """Returns how fast and how well frames are tracked.

    Raises:
        LodbenchError: An option is out of range, or as ``measure_tracking``.
    """
    city_file(options.city)
    # The first, which is searched for, does not count.
    require_within("--frames", options.measured.frames, 2)
    segmenter = segmenter_of(options.segmenter)
    require_frames_looked_at(segmenter, options.segmenter)
    return tracking.measure_tracking(options.city, options.seeds, segmenter, options.measured, steps)
