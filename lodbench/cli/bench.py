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
from lodbench.bench.maps import MapsOptions, measure_maps
from lodbench.bench.silhouettes import SilhouetteOptions, measure_silhouettes
from lodbench.bench.startup import StartupOptions, measure_startup
from lodbench.bench.training_data import TrainingDataOptions, measure_training_data
from lodbench.cli import bench_flights, bench_real, bench_segmentation, bench_views
from lodbench.cli.bench_views import add_city, city_file
from lodbench.cli.parser import Parser
from lodbench.errors import ConfigError
from lodbench.execution import ProgressCallback
from lodbench.storage import make_folder

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


MEASURES: dict[str, Measure] = {
    "silhouettes": _of_city(measure_silhouettes, SilhouetteOptions),
    "accuracy": bench_views.accuracy,
    "city": _of_city(measure_city, CityOptions),
    "evaluation": _plain(measure_evaluation, EvaluationOptions),
    "flights": bench_flights.measure,
    "maps": _plain(measure_maps, MapsOptions),
    "real": bench_real.measure,
    "segmentation": bench_segmentation.measure_segmentation,
    "startup": _startup,
    "tracking": bench_flights.measure_track,
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
    bench_flights.add_flights(actions)
    bench_flights.add_tracking(actions)
    bench_real.add_real(actions)
    bench_segmentation.add_segmentation(actions)
    add_city(add("training-data", TrainingDataOptions, "masks and photos per second; memory"))
    add("workers", WorkerOptions, "runs of the demo with masks over processes, by the clock")
    for action in actions.choices.values():
        action.add_argument("--json", action="store_true", help="one figure per line, for machines")
    return parser
