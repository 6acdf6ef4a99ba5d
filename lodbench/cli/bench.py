"""`lodbench bench WHAT`: measure this machine, beside other programs where there are some."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from lodbench.bench import (
    Report,
    commands,
    iou_recall,
    maps,
    mask_quality,
    photo_masks,
    real_query,
    silhouettes,
    throughput,
)
from lodbench.bench.city import CityOptions, measure_city
from lodbench.citymodel.scene import Scene
from lodbench.cli import bench_views
from lodbench.cli.options import default_segmenter, segmenter_of, setting_pairs
from lodbench.cli.parser import Parser
from lodbench.datasets.folder import FolderParams, city_beside, open_folder, require_one_flight
from lodbench.datasets.inputs import Input, declared_inputs
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError, require_within
from lodbench.execution import ProgressCallback
from lodbench.harness.city import open_city
from lodbench.methods import Method
from lodbench.methods.protocol import SupportsFlights
from lodbench.methods.registry import configure_method, make_method
from lodbench.params import add_options, flag, options_of, part
from lodbench.segmentation import Segmenter
from lodbench.segmentation.photo_segmenter import require_photo_segmenter
from lodbench.segmentation.protocol import FOR_PHOTOS
from lodbench.storage import make_folder
from lodbench.synthesis.views_dataset import ViewsParams

_CITY = "city model; the demo town if not given"
REAL_EXAMPLES = """\
  lodbench bench real --query DIR --city CITY --priors 20
  lodbench bench real --query FLIGHT FLIGHT --method region,flight --method-option flight.single=region
  lodbench bench real --query FLIGHT --published-priors     over its own city.obj, from its own priors
  lodbench bench real --query DIR --city CITY --prior-range 50 --prior-yaw 30     the wide protocol
  lodbench bench real --query DIR --city CITY --method region,contour_alignment --segmenter compact
  lodbench bench real --photos DIR     DIR/PLACE/photos with traced DIR/PLACE/masks, which make the map
  lodbench bench real --photos DIR --method contour_alignment --segmenter masks     by the traced masks
"""
_VIEWS_OF_TOWN, _VIEWS_OF_CITY = 80, 50
SEGMENTATION_EXAMPLES = """\
  lodbench bench segmentation                                the shipped network on an unseen town
  lodbench bench segmentation --segmenter-option weights=compact.onnx --pictures DIR
  lodbench bench segmentation --photos DIR --pictures OUT    real photos with masks traced by hand, by place
  lodbench bench segmentation --data SET --visible SET2      views of `lodbench generate-training-data`
  lodbench bench segmentation --data SET --instances         single buildings, of sets with labels=true
  lodbench bench segmentation --city CITY --pictures DIR     recall over the IoU of masks, no network at all
"""
_FLIGHTS = "whole flights: recall, constants of the drone, errors of the map, calibration"


class Bench(NamedTuple):
    """A bench: its options, what measures by them, and its help."""

    options: type
    measure: Callable[[Any, ProgressCallback], Report]
    help: str
    description: str | None = None
    epilog: str | None = None


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    parser = Parser("lodbench bench", description="Measure speed and accuracy.")
    order = sorted(BENCHES, key=lambda name: (name != "silhouettes", name))
    actions = parser.add_subparsers(dest="what", required=True, metavar="|".join(order))
    for name, bench in BENCHES.items():
        action = actions.add_parser(name, help=bench.help, description=bench.description, epilog=bench.epilog)
        add_options(action, bench.options)
        add_options(action, PrintOptions)
    given = parser.parse_args(argv)
    bench = BENCHES[given.what]
    options: Any = options_of(given, bench.options)
    is_json = options_of(given, PrintOptions).json
    measured(options, f"bench {given.what}", bench.measure, getattr(options, "pictures", None), is_json)
    return 0


def measured(
    options: Any,
    name: str,
    measure: Callable[[Any, ProgressCallback], Report],
    pictures: Path | None,
    is_json: bool,
) -> None:
    """Measures and prints, as text or figures, and writes pictures into a folder, if one is named.

    Raises:
        LodbenchError: As the measure, or there is no such folder of pictures.
    """
    if pictures is not None:
        make_folder(pictures)  # a name of no folder is refused before the work
    with ProgressCallback(name) as steps:
        report = measure(options, steps)
    if pictures is not None:
        report.write_pictures(pictures)
    lines = [json.dumps(each.to_json()) for each in report.figures] if is_json else [report.text]
    sys.stdout.write("\n".join(lines) + "\n")


@dataclass(frozen=True, kw_only=True)
class PrintOptions:
    """How figures are printed."""

    json: bool = flag(False, "one figure per line, for machines")


@dataclass(frozen=True, kw_only=True)
class SilhouetteWords:
    """What `bench silhouettes` is given."""

    measured: silhouettes.SilhouetteOptions = part(silhouettes.SilhouetteOptions)
    pictures: Path | None = flag(None, "folder for pictures of how costs and ratios spread")
    city: Path | None = flag(None, _CITY)


@dataclass(frozen=True, kw_only=True)
class CityWords:
    """What `bench city` is given."""

    measured: CityOptions = part(CityOptions)
    city: Path | None = flag(None, _CITY)


@dataclass(frozen=True, kw_only=True)
class MapsWords:
    """What `bench maps` is given."""

    measured: maps.MapsOptions = part(maps.MapsOptions)
    pictures: Path | None = flag(None, "folder for the picture")


@dataclass(frozen=True, kw_only=True)
class TrainingDataWords:
    """What `bench training-data` is given."""

    measured: throughput.TrainingDataOptions = part(throughput.TrainingDataOptions)
    city: Path | None = flag(None, _CITY)


def _of_city(measure: Callable[..., Report]) -> Callable[[Any, ProgressCallback], Report]:
    return lambda given, steps: measure(bench_views.city_file(given.city), given.measured, steps)


def _training_data(given: TrainingDataWords, steps: ProgressCallback) -> Report:
    wanted = given.measured
    if given.city is None and wanted.props is not None:
        raise ConfigError(
            "--props is not used with the demo town, which has a look of its own.", "Add --city FILE."
        )
    city = bench_views.city_file(given.city)
    if given.city is None:
        wanted = replace(wanted, props=city.parent / "props.npz")  # the demo town's own look
    return throughput.measure_training_data(city, wanted, steps)


@dataclass(frozen=True, kw_only=True)
class RealWords:
    """What `bench real` is given."""

    query: tuple[Path, ...] = flag(
        ...,
        "sets of photos and poses, as dataset=folder",
        nargs="+",
        action="store",
        metavar="DIR",
        either="photos",
        sets=("dataset.root",),
    )
    photos: Path | None = flag(
        None, "photos and traced masks, which make the map", metavar="DIR", either="photos"
    )
    city: Path | None = flag(None, "city model of every --query (its city.obj)", metavar="FILE")
    map_error: float | None = flag(None, "of maps made of traced masks (0.5)", metavar="M")
    lod: str | None = flag(None, "level of detail to localise against (the lowest)")
    crs: str | None = flag(None, "of the city model, where its file says none")
    method: str = flag("region", "methods, comma-separated (region)")
    method_option: tuple[str, ...] = flag(
        (), "setting of one of the methods, as flight.single=region", metavar="METHOD.KEY=VALUE"
    )
    segmenter: str | None = flag(None, "for methods that want a mask (as a run chooses)", metavar="NAME")
    priors: int = flag(20, "drawn around each photo's truth (20)")
    prior_range: float = flag(10.0, "+- east and north (10)", metavar="M")
    prior_height: float = flag(30.0, "+- up (30)", metavar="M")
    prior_yaw: float = flag(7.5, "+- (7.5)", metavar="DEG")
    prior_tilt: float = flag(1.0, "+- pitch and roll (1)", metavar="DEG")
    shared_priors: str | None = flag(
        None,
        "whether photos of a flight err together (yes where a method solves flights)",
        choices=("yes", "no"),
    )
    published_priors: bool = flag(False, "the sets' own priors only")
    bound: bool = flag(False, "also where roof edges lead from the true poses")
    pictures: Path | None = flag(None, "folder for a picture of the basins", metavar="DIR")
    seed: int = flag(0, "random seed (default: 0)")


def measure_real_words(options: RealWords, steps: ProgressCallback) -> Report:
    """Returns what was requested."""
    for name in ("range", "height", "yaw", "tilt"):
        require_within(f"--prior-{name}", getattr(options, f"prior_{name}"), 0)
    width = UniformPrior(
        x_m=options.prior_range,
        y_m=options.prior_range,
        z_m=options.prior_height,
        yaw_deg=options.prior_yaw,
        pitch_deg=options.prior_tilt,
        roll_deg=options.prior_tilt,
    )
    methods = _methods(options, width)
    sets = []
    for dataset, scene in _photos_and_maps(options):
        if options.segmenter is not None:
            segmenter = segmenter_of(options.segmenter)
        elif any(Input.MASK in declared_inputs(method, "requires") for method in methods.values()):
            segmenter = default_segmenter(dataset)[0]
        else:
            segmenter = segmenter_of("none")
        sets.append(real_query.RealSet(dataset, scene, segmenter))
    return real_query.measure_real(sets, methods, _wanted(options, width, methods), steps)


def _methods(options: RealWords, width: UniformPrior) -> dict[str, Method]:
    """Returns the methods by what tables call them."""
    settings: dict[str, dict[str, Any]] = {name: {} for name in options.method.split(",")}
    for word in options.method_option:
        name, dot, setting = word.partition(".")
        if not dot or name not in settings:
            named = ", ".join(settings)
            raise ConfigError(
                f"--method-option {word} names none of the methods {named}.",
                f"Write --method-option {next(iter(settings))}.KEY=VALUE.",
            )
        settings[name] |= setting_pairs([setting])
    return {
        " ".join([name, *(f"{key}={value}" for key, value in given.items())]): configure_method(
            {**given, "name": name}
        )
        .for_prior(width)
        .make()
        for name, given in settings.items()
    }


def _wanted(options: RealWords, width: UniformPrior, methods: Mapping[str, Method]) -> real_query.RealOptions:
    """Returns which priors are measured."""
    if options.published_priors:
        if options.photos is not None or options.shared_priors is not None or width != UniformPrior():
            raise ConfigError(
                "--published-priors takes the sets' own priors: none of --photos, none drawn.",
                "Leave it out, or --photos, --shared-priors and --prior-* out.",
            )
        return real_query.RealOptions(
            options.priors, width, is_published_only=True, is_bounded=options.bound, seed=options.seed
        )
    solves_flights = any(isinstance(method, SupportsFlights) for method in methods.values())
    is_shared = options.shared_priors == "yes" if options.shared_priors else solves_flights
    # Priors of another kind than the dataset's own leave its own out; traced photos have none.
    has_own = options.photos is None and width == UniformPrior() and not is_shared
    return real_query.RealOptions(
        options.priors,
        width,
        is_shared,
        is_published_too=has_own,
        is_bounded=options.bound,
        seed=options.seed,
    )


def _photos_and_maps(options: RealWords) -> list[tuple[Dataset, Scene]]:
    if options.photos is not None:
        return [_traced_photos(options.photos, options)]
    if options.map_error is not None:
        raise ConfigError(
            "--map-error is of maps that --photos makes, not of --city.", "Leave --map-error out."
        )
    if options.city is not None and not options.city.exists():
        raise ConfigError(f"{options.city} does not exist.", "Write --city FILE.")
    # Two sets may have folders of one name.
    names = Counter(query.resolve().name for query in options.query)
    return [
        _open_set(options, query, query.resolve().name if names[query.resolve().name] == 1 else str(query))
        for query in options.query
    ]


def _open_set(options: RealWords, query: Path, name: str) -> tuple[Dataset, Scene]:
    if options.city is None:
        require_one_flight(query)
    city = city_beside(query) if options.city is None else str(options.city)
    dataset = open_folder(FolderParams(str(query), city, options.lod, options.crs, None, name))
    if dataset.city_model is None:
        raise ConfigError(f"--query {query} has no city.obj and needs a city model.", "Write --city FILE.")
    city_of = open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height)
    return dataset, city_of.scene


def _traced_photos(photos: Path, options: RealWords) -> tuple[Dataset, Scene]:
    if options.city is not None:
        raise ConfigError("--photos makes its own map.", "Leave out --city, or write --query DIR.")
    for name in ("lod", "crs"):
        if getattr(options, name) is not None:
            raise ConfigError(
                f"--{name} is of a --city, and --photos makes its own map.", f"Leave --{name} out."
            )
    wanted = photo_masks.TracedOptions(seed=options.seed)
    if options.map_error is not None:
        wanted = replace(wanted, map_error_m=options.map_error)
    return photo_masks.open_traced_photos(photos, wanted)


@dataclass(frozen=True, kw_only=True)
class SegmentationWords:
    """What `bench segmentation` is given."""

    segmenter: str | None = flag(
        None, "that looks at photos (compact; of --photos efficient_unet)", metavar="NAME"
    )
    segmenter_option: tuple[str, ...] = flag((), "may be repeated", metavar="KEY=VALUE")
    data: Path | None = flag(None, "training set, or folder of sets; else a town", metavar="SET")
    photos: Path | None = flag(
        None, "real photos with traced masks: PLACE/photos, PLACE/masks", metavar="DIR"
    )
    instances: bool = flag(False, "of --data: how well single buildings are separated")
    visible: Path | None = flag(None, "the same with occluders_in_mask=true", metavar="SET")
    town: str | None = flag(None, "test or train: views made on first use (test)")
    city: Path | None = flag(None, "measure recall over the IoU of masks on views of it")
    method: str | None = flag(None, "methods of --city, comma-separated (lodlocv2)")
    views: int | None = flag(None, "of the town (80), or of the city (50)")
    seed: int | None = flag(None, "of the views of --city (0)")
    pictures: Path | None = flag(None, "folder for a picture", metavar="DIR")


def measure_segmentation(options: SegmentationWords, steps: ProgressCallback) -> Report:
    """Returns what was requested."""
    if options.photos is not None:
        others = ("city", "data", "visible", "views")
        if options.instances or any(getattr(options, name) is not None for name in others):
            left_out = "Leave out --city, --data, --visible, --views and --instances."
            raise ConfigError("--photos are measured by themselves.", left_out)
        return _photos(options.photos, options, steps)
    if options.instances:
        if options.data is None:
            raise ConfigError("--instances needs views with labels.", "Name their set: --data SET.")
        _require_read(options, "--instances", "data")
        segmenter = segmenter_of(options.segmenter or "compact_instances", options.segmenter_option)
        return iou_recall.measure_instances(segmenter, options.data, steps)
    if options.city is not None:
        return _curve(options, steps)
    if options.visible is not None and options.data is None:
        raise ConfigError("--visible is of no use without --data.", "Name the set that it is the same as.")
    return _masks_of_views(options, steps)


def _require_read(options: SegmentationWords, wanted: str, *read: str) -> None:
    """Makes sure that no option is given that what is requested does not read.

    Raises:
        ConfigError: One is: a figure would be taken for what it is not.
    """
    for name in ("city", "data", "visible", "views", "town", "method", "seed"):
        if name not in read and getattr(options, name) is not None:
            raise ConfigError(f"--{name} is not used with {wanted}.", f"Leave --{name} out.")


def _photos(photos: Path, options: SegmentationWords, steps: ProgressCallback) -> Report:
    _require_read(options, "--photos")
    report = photo_masks.measure_photo_masks(_segmenter(options, FOR_PHOTOS), photos, steps)
    if options.pictures is not None:
        report.write_pictures(options.pictures)
    return Report(report.to_text(), report.figures())


def _segmenter(options: SegmentationWords, default: str) -> Segmenter:
    return require_photo_segmenter(segmenter_of(options.segmenter or default, options.segmenter_option))


def _curve(options: SegmentationWords, steps: ProgressCallback) -> Report:
    others = ("data", "visible", "segmenter")
    if options.segmenter_option or any(getattr(options, name) is not None for name in others):
        raise ConfigError(
            "--city draws masks of its own.",
            "Leave out --data, --visible, --segmenter and --segmenter-option, or --city.",
        )
    _require_read(options, "--city", "city", "method", "views", "seed")
    count = _VIEWS_OF_CITY if options.views is None else options.views
    views = ViewsParams(str(options.city), count, views_seed=options.seed or 0)
    methods = [make_method(name) for name in (options.method or "lodlocv2").split(",")]
    return iou_recall.measure_iou_recall(views, methods, steps)


def _masks_of_views(options: SegmentationWords, steps: ProgressCallback) -> Report:
    from lodbench.bench.mask_quality import town_sets

    segmenter = _segmenter(options, "compact")
    data, visible = options.data, options.visible
    if data is not None and options.views is not None:
        raise ConfigError("--views is for a town or a city.", "All views of --data count.")
    if data is None:
        _require_read(options, "a town", "town", "views")
        views = _VIEWS_OF_TOWN if options.views is None else options.views
        data, visible = town_sets(options.town or "test", views)
    else:
        _require_read(options, "--data", "data", "visible")
    return mask_quality.measure_masks(segmenter, mask_quality.MaskQualityOptions(data, visible), steps)


BENCHES = {
    "silhouettes": Bench(
        SilhouetteWords,
        _of_city(silhouettes.measure_silhouettes),
        "time per hypothesis, beside other renderers",
    ),
    "startup": Bench(
        commands.StartupOptions,
        commands.measure_startup,
        "CPU time, time and memory of whole commands, beside another build's: what starting costs",
    ),
    "accuracy": Bench(
        bench_views.AccuracyWords,
        bench_views.accuracy,
        "recall of methods on synthetic views of a real model",
    ),
    "maps": Bench(
        MapsWords,
        lambda given, steps: maps.measure_maps(given.measured, steps),
        "methods over LoD1 to 3, a surface model and an orthophoto of one place: which map gives what",
    ),
    "city": Bench(
        CityWords,
        _of_city(measure_city),
        "reading and meshing a city model, beside the naive way and cjio; memory on a large file",
    ),
    "evaluation": Bench(
        throughput.EvaluationOptions,
        throughput.measure_evaluation,
        "scoring many methods on many queries; a run's page",
    ),
    "flights": Bench(
        bench_views.FlightsWords,
        bench_views.measure_flight_recall,
        _FLIGHTS,
        f"Measure {_FLIGHTS}. Photos, priors and masks are drawn over a city.",
    ),
    "tracking": Bench(
        bench_views.TrackingWords,
        bench_views.measure_track,
        "drawn frames from pixels to poses, and how many a second",
    ),
    "real": Bench(
        RealWords, measure_real_words, "recall on posed real photos from redrawn priors", epilog=REAL_EXAMPLES
    ),
    "segmentation": Bench(
        SegmentationWords,
        measure_segmentation,
        "IoU and time of a network's masks; with --city, recall over the IoU of masks",
        epilog=SEGMENTATION_EXAMPLES,
    ),
    "training-data": Bench(TrainingDataWords, _training_data, "masks and photos per second; memory"),
    "workers": Bench(
        commands.WorkerOptions,
        commands.measure_workers,
        "runs of the demo with masks over processes, by the clock",
    ),
}
OPTIONS = {f"bench {name}": bench.options for name, bench in BENCHES.items()}
