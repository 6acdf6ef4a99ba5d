"""`lodbench bench WHAT`: measure this machine, beside other programs where there are some."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from lodbench.bench.city import CityOptions, measure_city
from lodbench.bench.commands import StartupOptions, WorkerOptions, measure_startup, measure_workers
from lodbench.bench.maps import MapsOptions, measure_maps
from lodbench.bench.report import Report
from lodbench.bench.silhouettes import SilhouetteOptions, measure_silhouettes
from lodbench.bench.throughput import (
    EvaluationOptions,
    TrainingDataOptions,
    measure_evaluation,
    measure_training_data,
)
from lodbench.cli.bench_photos import (
    REAL_EXAMPLES,
    SEGMENTATION_EXAMPLES,
    RealWords,
    SegmentationWords,
    measure_real_words,
    measure_segmentation,
)
from lodbench.cli.bench_views import (
    AccuracyWords,
    FlightsWords,
    TrackingWords,
    accuracy,
    city_file,
    measure_flight_recall,
    measure_track,
)
from lodbench.cli.parser import Parser
from lodbench.errors import ConfigError
from lodbench.execution import ProgressCallback
from lodbench.params import add_options, flag, options_of, part
from lodbench.storage import make_folder


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


_CITY = "city model; the demo town if not given"


@dataclass(frozen=True, kw_only=True)
class SilhouetteWords:
    """What `bench silhouettes` is given."""

    measured: SilhouetteOptions = part(SilhouetteOptions)
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

    measured: MapsOptions = part(MapsOptions)
    pictures: Path | None = flag(None, "folder for the picture")


@dataclass(frozen=True, kw_only=True)
class TrainingDataWords:
    """What `bench training-data` is given."""

    measured: TrainingDataOptions = part(TrainingDataOptions)
    city: Path | None = flag(None, _CITY)


def _of_city(measure: Callable[..., Report]) -> Callable[[Any, ProgressCallback], Report]:
    return lambda given, steps: measure(city_file(given.city), given.measured, steps)


def _training_data(given: TrainingDataWords, steps: ProgressCallback) -> Report:
    wanted = given.measured
    if given.city is None and wanted.props is not None:
        raise ConfigError(
            "--props is not used with the demo town, which has a look of its own.", "Add --city FILE."
        )
    city = city_file(given.city)
    if given.city is None:
        wanted = replace(wanted, props=city.parent / "props.npz")  # the demo town's own look
    return measure_training_data(city, wanted, steps)


_FLIGHTS = "whole flights: recall, constants of the drone, errors of the map, calibration"
BENCHES = {
    "silhouettes": Bench(
        SilhouetteWords, _of_city(measure_silhouettes), "time per hypothesis, beside other renderers"
    ),
    "startup": Bench(
        StartupOptions,
        measure_startup,
        "CPU time, time and memory of whole commands, beside another build's: what starting costs",
    ),
    "accuracy": Bench(AccuracyWords, accuracy, "recall of methods on synthetic views of a real model"),
    "maps": Bench(
        MapsWords,
        lambda given, steps: measure_maps(given.measured, steps),
        "methods over LoD1 to 3, a surface model and an orthophoto of one place: which map gives what",
    ),
    "city": Bench(
        CityWords,
        _of_city(measure_city),
        "reading and meshing a city model, beside the naive way and cjio; memory on a large file",
    ),
    "evaluation": Bench(
        EvaluationOptions, measure_evaluation, "scoring many methods on many queries; a run's page"
    ),
    "flights": Bench(
        FlightsWords,
        measure_flight_recall,
        _FLIGHTS,
        f"Measure {_FLIGHTS}. Photos, priors and masks are drawn over a city.",
    ),
    "tracking": Bench(
        TrackingWords, measure_track, "drawn frames from pixels to poses, and how many a second"
    ),
    "real": Bench(
        RealWords,
        measure_real_words,
        "recall on posed real photos from redrawn priors",
        epilog=REAL_EXAMPLES,
    ),
    "segmentation": Bench(
        SegmentationWords,
        measure_segmentation,
        "IoU and time of a network's masks; with --city, recall over the IoU of masks",
        epilog=SEGMENTATION_EXAMPLES,
    ),
    "training-data": Bench(TrainingDataWords, _training_data, "masks and photos per second; memory"),
    "workers": Bench(
        WorkerOptions, measure_workers, "runs of the demo with masks over processes, by the clock"
    ),
}
OPTIONS = {f"bench {name}": bench.options for name, bench in BENCHES.items()}
