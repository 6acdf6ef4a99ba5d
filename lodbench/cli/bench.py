"""`lodbench bench WHAT`: measure this machine, beside other programs where there are some."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lodbench.bench import Report, add_options, options_of
from lodbench.bench.city import CityOptions, measure_city
from lodbench.bench.evaluation import EvaluationOptions, WorkerOptions, measure_evaluation, measure_workers
from lodbench.bench.flights import measure_flights
from lodbench.bench.maps import MapsOptions, measure_maps
from lodbench.bench.silhouettes import SilhouetteOptions, measure_silhouettes
from lodbench.bench.startup import StartupOptions, measure_startup
from lodbench.bench.tracking import TrackingOptions, measure_joint_solves, measure_tracking
from lodbench.bench.training_data import TrainingDataOptions, measure_training_data
from lodbench.cli import bench_real, bench_segmentation, bench_views
from lodbench.cli.bench_views import add_city, city_file, seeds, whole_numbers
from lodbench.cli.parser import Parser
from lodbench.cli.parts import require_frames_looked_at, segmenter_of
from lodbench.errors import ConfigError, require_within
from lodbench.execution import ProgressCallback
from lodbench.methods.flight import FlightMethod, FlightParams
from lodbench.methods.flight.params import RELATIVE_POSES
from lodbench.storage import make_folder
from lodbench.synthesis.camera_paths import FLIGHT_PATHS
from lodbench.synthesis.flights import FlightsParams
from lodbench.synthesis.view_photos import PHOTO_SIZE
from lodbench.synthesis.view_sampling import FINE_SIZE, RGB_CAMERA

Measure = Callable[[argparse.Namespace, ProgressCallback], Report]


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    options = _parser().parse_args(argv)
    measured(options, f"bench {options.what}", MEASURES[options.what])
    return 0


def measured(options: argparse.Namespace, name: str, measure: Measure) -> None:
    """Measures and prints, as text or by ``--json``, and writes the pictures that ``--pictures`` asks for.

    Raises:
        LodbenchError: As the measure, or there is no such folder of pictures.
    """
    pictures = getattr(options, "pictures", None)
    if pictures is not None:
        make_folder(pictures)  # a name of no folder is refused before the work
    with ProgressCallback(name) as steps:
        report = measure(options, steps)
    if pictures is not None:
        report.write_pictures(pictures)
    lines = [json.dumps(each.to_json()) for each in report.figures] if options.json else [report.text]
    sys.stdout.write("\n".join(lines) + "\n")


def _plain(measure: Callable[..., Report], kind: type) -> Measure:
    return lambda given, steps: measure(options_of(given, kind), steps)


def _of_city(measure: Callable[..., Report], kind: type) -> Measure:
    def of_city(given: argparse.Namespace, steps: ProgressCallback) -> Report:
        wanted: Any = options_of(given, kind)  # before the demo town is made, which takes minutes
        return measure(city_file(given), wanted, steps)

    return of_city


def _training_data(given: argparse.Namespace, steps: ProgressCallback) -> Report:
    wanted = options_of(given, TrainingDataOptions)
    if given.city is None and wanted.props is not None:
        raise ConfigError(
            "--props is not used with the demo town, which has a look of its own.", "Add --city FILE."
        )
    city = city_file(given)
    if given.city is None:
        wanted = replace(wanted, props=city.parent / "props.npz")  # the demo town's own look
    return measure_training_data(city, wanted, steps)


def _startup(given: argparse.Namespace, steps: ProgressCallback) -> Report:
    return measure_startup(replace(options_of(given, StartupOptions), is_cold=given.cold), steps)


def add_flights(actions: Any) -> argparse.ArgumentParser:
    """Adds the command's parser to others, and returns it."""
    what = "whole flights: recall, constants of the drone, errors of the map, calibration"
    parser: argparse.ArgumentParser = actions.add_parser(
        "flights", help=what, description=f"Measure {what}. Photos, priors and masks are drawn over a city."
    )
    add = parser.add_argument
    add("--city", type=Path, required=True, help="city model")
    add("--seeds", type=seeds, default="0", help="comma-separated, each with flights of its own (0)")
    add("--flights", type=int, default=2, help="of each seed (2)")
    add("--photos", type=int, default=20, help="of each flight (20)")
    add("--path", choices=tuple(FLIGHT_PATHS), help="how they fly (all of them in turn)")
    add("--map-lod", help="level of detail that is searched (the lowest)")
    add("--mask-lod", help="level of detail that photos show, or finest (the map's)")
    add("--look", help="draw photos in this look: plain, varied or hard (none)")
    add("--segmenter", metavar="NAME", help="masks of drawn photos by it (silhouettes, degraded)")
    add("--photo-width", type=int, default=PHOTO_SIZE[0], help=f"of drawn photos, pixels ({PHOTO_SIZE[0]})")
    add("--reconstruct", action="store_true", help="by COLMAP, from the photos (pycolmap)")
    add("--relative-poses", choices=RELATIVE_POSES, default="auto", help="(auto)")
    add("--focal", type=float, default=0.0, help="focal lengths off by up to this share (0)")
    add("--shared-height", type=float, default=28.0, help="heights off by up to, metres (28)")
    add("--joint", metavar="COUNTS", type=_counts, help="time joint solves of so many photos, as 100,250")
    add("--memory", action="store_true", help="of --joint too, which takes longer")
    for name, what in (
        ("wrong-heights", "are wrong by 1.5 to 5 m"),
        ("missing", "lack"),
        ("extra", "are extra"),
    ):
        add(f"--{name}", type=float, default=0.0, help=f"share of buildings that {what} (0)")
    return parser


def add_tracking(actions: Any) -> None:
    """Adds the parser of ``tracking``."""
    tracked = actions.add_parser("tracking", help="drawn frames from pixels to poses, and how many a second")
    add_options(tracked, TrackingOptions)
    tracked.add_argument("--segmenter", default="compact", metavar="NAME", help="(compact)")
    tracked.add_argument("--city", type=Path, required=True, help="city model")
    tracked.add_argument("--seeds", type=seeds, default="0", help="comma-separated (0)")


def measure_flight_recall(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    """Returns what the command measures.

    Raises:
        LodbenchError: An option is out of range, or as ``measure_flights``.
    """
    _require_sound(options)
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
    if options.joint is None:
        segmenter = None if options.segmenter is None else segmenter_of(options.segmenter)
        return measure_flights(flights, options.seeds, method, steps, segmenter)
    flights = replace(flights, flights_seed=options.seeds[0], path=flights.path or "orbit")
    return measure_joint_solves(flights, options.joint, method, traces_memory=options.memory, progress=steps)


def _require_sound(options: argparse.Namespace) -> None:
    """Refuses here what flights would refuse by names that are not typed."""
    city_file(options)
    require_within("--flights", options.flights, 1)
    require_within("--photos", options.photos, 1)
    require_within("--focal", options.focal, 0, 0.2)
    require_within("--shared-height", options.shared_height, 0)
    for name in ("wrong_heights", "missing", "extra"):
        require_within(f"--{name.replace('_', '-')}", getattr(options, name), 0, 0.5)
    require_within("--photo-width", options.photo_width, FINE_SIZE[0], RGB_CAMERA.width)
    if options.reconstruct and options.look is None:
        raise ConfigError("--reconstruct needs photos.", "Add --look plain.")
    if options.segmenter is not None and (options.look is None or options.joint is not None):
        raise ConfigError("--segmenter needs drawn photos.", "Add --look varied, and leave --joint out.")
    if options.relative_poses == "reconstruction" and not options.reconstruct:
        raise ConfigError("--relative-poses reconstruction needs one.", "Add --reconstruct --look plain.")
    if options.relative_poses == "tracks" and options.look is None:
        raise ConfigError("--relative-poses tracks needs photos.", "Add --look plain.")


def _counts(text: str) -> list[int]:
    return whole_numbers("Numbers of photos", text, "Write --joint 100,250,500")


def measure_track(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    """Returns how fast and how well frames are tracked.

    Raises:
        LodbenchError: An option is out of range, or as ``measure_tracking``.
    """
    city_file(options)
    given = options_of(options, TrackingOptions)
    # The first, which is searched for, does not count.
    require_within("--frames", given.frames, 2)
    segmenter = segmenter_of(options.segmenter)
    require_frames_looked_at(segmenter, options.segmenter)
    return measure_tracking(options.city, options.seeds, segmenter, given, steps)


MEASURES: dict[str, Measure] = {
    "silhouettes": _of_city(measure_silhouettes, SilhouetteOptions),
    "accuracy": bench_views.accuracy,
    "city": _of_city(measure_city, CityOptions),
    "evaluation": _plain(measure_evaluation, EvaluationOptions),
    "flights": measure_flight_recall,
    "maps": _plain(measure_maps, MapsOptions),
    "real": bench_real.measure,
    "segmentation": bench_segmentation.measure_segmentation,
    "startup": _startup,
    "tracking": measure_track,
    "training-data": _training_data,
    "workers": _plain(measure_workers, WorkerOptions),
}


def _parser() -> argparse.ArgumentParser:
    parser = Parser("lodbench bench", description="Measure speed and accuracy.")
    actions: Any = parser.add_subparsers(dest="what", required=True, metavar="|".join(MEASURES))

    def add(name: str, kind: type, meaning: str, pictures: str = "") -> Any:
        action = actions.add_parser(name, help=meaning)
        add_options(action, kind)
        if pictures:
            action.add_argument("--pictures", type=Path, help=f"folder for {pictures}")
        return action

    speed = "time per hypothesis, beside other renderers"
    add_city(add("silhouettes", SilhouetteOptions, speed, "pictures of how costs and ratios spread"))
    starting = "CPU time, time and memory of whole commands, beside another build's: what starting costs"
    startup = add("startup", StartupOptions, starting)
    cold = "localize over an empty kernel cache as well, which compiles"
    startup.add_argument("--cold", action="store_true", help=cold)
    bench_views.add_views(actions)
    kinds = "methods over LoD1 to 3, a surface model and an orthophoto of one place: which map gives what"
    add("maps", MapsOptions, kinds, "the picture")
    reading = "reading and meshing a city model, beside the naive way and cjio; memory on a large file"
    add_city(add("city", CityOptions, reading))
    add("evaluation", EvaluationOptions, "scoring many methods on many queries; a run's page")
    add_flights(actions)
    add_tracking(actions)
    bench_real.add_real(actions)
    bench_segmentation.add_segmentation(actions)
    add_city(add("training-data", TrainingDataOptions, "masks and photos per second; memory"))
    add("workers", WorkerOptions, "runs of the demo with masks over processes, by the clock")
    for action in actions.choices.values():
        action.add_argument("--json", action="store_true", help="one figure per line, for machines")
    return parser
