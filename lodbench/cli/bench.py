"""`lodbench bench WHAT`: measure this machine, beside other programs where there are some."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from lodbench.bench.accuracy import measure_accuracy
from lodbench.bench.accuracy_causes import measure_causes
from lodbench.bench.accuracy_cities import measure_cities
from lodbench.bench.budget import measure_budget
from lodbench.bench.city import CityOptions, measure_city
from lodbench.bench.evaluation import EvaluationOptions, measure_evaluation
from lodbench.bench.figures import Report
from lodbench.bench.scale import ScaleOptions, measure_scale
from lodbench.bench.silhouettes import SilhouetteOptions, measure_silhouettes
from lodbench.bench.slopes import SlopeOptions, measure_slopes
from lodbench.bench.training_data import TrainingDataOptions, measure_training_data
from lodbench.bench.wide_priors import measure_wide_priors
from lodbench.bench.workers import WorkerOptions, measure_workers
from lodbench.cli import bench_flight_uses, bench_flights, bench_real
from lodbench.cli.bench_segmentation import add_segmentation, measure_segmentation
from lodbench.cli.parser import Parser
from lodbench.errors import ConfigError
from lodbench.execution import ProgressCallback
from lodbench.methods.registry import make_method
from lodbench.synthesis.map_and_camera_errors import World
from lodbench.synthesis.views_dataset import AREAS, ViewsParams


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    options = _parser().parse_args(argv)
    with ProgressCallback(f"bench {options.what}") as steps:
        report = MEASURES[options.what](options, steps)
    if getattr(options, "pictures", None) is not None:
        report.write_pictures(options.pictures)
    lines = [json.dumps(each.to_json()) for each in report.figures] if options.json else [report.text]
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


def _silhouettes(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    peers = tuple(options.peers.split(",")) if options.peers else ()
    asked = SilhouetteOptions(
        num_views=options.views,
        num_horizon=options.horizon_views,
        hypotheses=options.hypotheses,
        peers=peers,
        seed=options.seed,
    )
    return measure_silhouettes(_city_file(options), asked, steps)


def _scale(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    asked = ScaleOptions(
        buildings=options.buildings, num_views=options.views, hypotheses=options.hypotheses, seed=options.seed
    )
    return measure_scale(asked, steps)


def _views(options: argparse.Namespace) -> tuple[ViewsParams, list[int]]:
    """Returns what is drawn, and the seeds."""
    views = ViewsParams(
        city_model=str(_city_file(options)),
        num_views=options.views,
        mask_iou=options.mask_iou,
        tilt_deg=options.tilt_width,
        range_m=options.prior_range,
        height_m=options.prior_height,
        area=options.area,
        lod=options.map_lod,
        mask_lod=options.mask_lod,
        roof_height=options.roof_height,
        world=World.parse(options.world),
    )
    return views, [_whole(seed) for seed in (options.seeds or str(options.seed)).split(",")]


def _accuracy(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    methods = [make_method(name) for name in options.method.split(",")]
    cities = options.city or [None]
    drawn = [_views(argparse.Namespace(**{**vars(options), "city": city})) for city in cities]
    seeds = drawn[0][1]
    if options.causes:
        return measure_causes([views for views, _ in drawn], seeds, methods, steps)
    if len(drawn) == 1:
        return measure_accuracy(drawn[0][0], seeds, methods, steps)
    return measure_cities([views for views, _ in drawn], seeds, methods, steps)


def _budget(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    return measure_budget(*_views(options), steps)


def _wide_priors(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    return measure_wide_priors(*_views(options), steps)


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError as error:
        raise ConfigError(f"A seed is a whole number, not {text!r}.", "Write --seeds 0,1,2") from error


def _city(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    asked = CityOptions(options.lod, options.repeats, options.large_mb, options.tiles, options.workers)
    return measure_city(_city_file(options), asked, steps)


def _slopes(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    reach = options.hypotheses, options.buildings, options.tiled, options.queries, options.workers
    return measure_slopes(SlopeOptions(*reach, seed=options.seed), steps)


def _workers(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    asked = WorkerOptions(options.queries, options.workers, options.method, options.repeats)
    return measure_workers(asked, steps)


def _evaluation(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    asked = EvaluationOptions(options.queries, options.methods, options.seed)
    return measure_evaluation(asked, steps)


def _training_data(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    city = _city_file(options)
    props = options.props
    if options.city is None:
        props = city.parent / "props.npz"  # the demo town's own look
    asked = TrainingDataOptions(options.views, options.workers, props, options.seed)
    return measure_training_data(city, asked, steps)


MEASURES: dict[str, Callable[[argparse.Namespace, ProgressCallback], Report]] = {
    "silhouettes": _silhouettes,
    "scale": _scale,
    "accuracy": _accuracy,
    "budget": _budget,
    "city": _city,
    "evaluation": _evaluation,
    "flights": bench_flights.measure,
    "georeference": bench_flight_uses.measure_georeference,
    "real": bench_real.measure,
    "segmentation": measure_segmentation,
    "slopes": _slopes,
    "tracking": bench_flight_uses.measure_track,
    "training-data": _training_data,
    "wide-priors": _wide_priors,
    "workers": _workers,
}


def _parser() -> argparse.ArgumentParser:
    parser = Parser("lodbench bench", description="Measure speed and accuracy.")
    actions: Any = parser.add_subparsers(dest="what", required=True)
    speed = actions.add_parser("silhouettes", help="time per hypothesis, beside other renderers")
    speed.add_argument("--views", type=int, default=20, help="seeded views (20)")
    speed.add_argument("--hypotheses", type=int, default=2000, help="around each view (2000)")
    speed.add_argument(
        "--horizon-views", type=int, default=10, help="with pitch 60 to 75, reported apart (10)"
    )
    speed.add_argument(
        "--peers", default="pyrender,open3d", help="renderers to stand beside, comma-separated"
    )
    speed.add_argument("--pictures", type=Path, help="folder for pictures of how costs and ratios spread")
    scale = actions.add_parser(
        "scale", help="a city of a million buildings beside its core: cost per hypothesis, opening, memory"
    )
    scale.add_argument("--buildings", type=int, default=1_000_000, help="of the large city (1000000: 1.7 GB)")
    scale.add_argument("--views", type=int, default=10, help="seeded views of each kind (10)")
    scale.add_argument("--hypotheses", type=int, default=400, help="around each view (400)")
    slopes = actions.add_parser(
        "slopes", help="CPU time and memory over hypotheses, pixels, buildings, queries, workers"
    )
    slopes.add_argument("--hypotheses", type=int, default=100_000, help="most of a query (100000)")
    slopes.add_argument("--buildings", type=int, default=100_000, help="most of a city (100000)")
    slopes.add_argument("--tiled", type=int, default=10_000, help="most compiled from CityGML tiles (10000)")
    slopes.add_argument("--queries", type=int, default=10_000, help="most of a run (10000)")
    slopes.add_argument("--workers", type=int, default=4, help="most processes (4)")
    slopes.add_argument("--pictures", type=Path, help="folder for the picture")
    accuracy = actions.add_parser("accuracy", help="recall of methods on synthetic views of a real model")
    accuracy.add_argument("--views", type=int, default=200, help="seeded views (200)")
    accuracy.add_argument("--method", default="lodlocv2", help="methods, comma-separated (lodlocv2)")
    accuracy.add_argument("--pictures", type=Path, help="folder for reliability and risk over coverage")
    accuracy.add_argument(
        "--causes",
        action="store_true",
        help="why poses are not found: causes of errors taken away, one a column",
    )
    budget = actions.add_parser("budget", help="recall of both methods over the hypotheses they may render")
    budget.add_argument("--views", type=int, default=50, help="seeded views (50)")
    budget.add_argument("--pictures", type=Path, help="folder for the picture")
    wide = actions.add_parser(
        "wide-priors", help="basins beside the full grid, pose by pose: --prior-range 50 to 200"
    )
    wide.add_argument("--views", type=int, default=6, help="seeded views (6)")
    for action in (accuracy, budget, wide):
        action.add_argument("--mask-iou", type=float, default=0.88, help="of the degraded masks (0.88)")
        action.add_argument(
            "--tilt-width", "--tilt-deg", type=float, default=1.0, help="prior's tilt error, +- degrees (1.0)"
        )
        action.add_argument(
            "--prior-range", type=float, help="prior's error along x, y and z, +- metres (10, 10, 30)"
        )
        action.add_argument("--prior-height", type=float, help="prior's error along z, +- metres")
        action.add_argument("--area", choices=AREAS, help="half of the city to look at (all of it)")
        action.add_argument(
            "--seeds", help="seeds, comma-separated, each with views of its own; instead of --seed"
        )
        action.add_argument(
            "--mask-lod", help="level of detail that views and masks are drawn from, or finest (the map's)"
        )
        action.add_argument("--map-lod", help="level of detail that is searched (the lowest)")
        action.add_argument(
            "--roof-height", metavar="RULE", help="derive an absent LoD1: median, max, p70 or eave"
        )
        action.add_argument(
            "--world",
            default="",
            metavar="NAME=VALUE,...",
            help="how what is seen differs from the map: shared_roofs and hidden_feet in metres, focal as a "
            "share, tilt as a factor on the told one",
        )
    city = actions.add_parser(
        "city", help="reading and meshing a city model, beside the naive way and cjio; memory on a large file"
    )
    city.add_argument("--lod", help="level of detail, or finest (lowest with walls)")
    city.add_argument("--repeats", type=int, default=5, help="passes, the fastest counts (5)")
    city.add_argument(
        "--tiles",
        type=int,
        default=0,
        help="instead: make one scene of so many tiles of its buildings (none)",
    )
    city.add_argument("--workers", type=int, help="processes for the tiles (one per core)")
    city.add_argument("--large-mb", type=int, default=137, help="file made for the memory figure; 0 for none")
    evaluation = actions.add_parser("evaluation", help="scoring many methods on many queries; a run's page")
    evaluation.add_argument("--queries", type=int, default=2192, help="as the largest published split (2192)")
    evaluation.add_argument("--methods", type=int, default=100, help="scored on all of them (100)")
    flights = bench_flights.add_flights(actions)
    uses = bench_flight_uses.add_uses(actions)
    real = bench_real.add_real(actions)
    segmentation = add_segmentation(actions)
    training = actions.add_parser("training-data", help="masks and photos per second; memory")
    training.add_argument("--views", type=int, default=24, help="photos of each size; masks 10 x (24)")
    training.add_argument("--workers", type=int, help="processes (one per core)")
    training.add_argument("--props", type=Path, help="scene props to picture; made up if not given")
    workers = actions.add_parser("workers", help="runs of the demo with masks over processes, by the clock")
    workers.add_argument("--queries", type=int, default=200, help="of the demo (200)")
    workers.add_argument("--workers", type=int, default=2, help="processes of one thread each (2)")
    workers.add_argument("--method", default="lodlocv2", help="the method (lodlocv2)")
    workers.add_argument("--repeats", type=int, default=2, help="rounds, the fastest counts (2)")
    for action in (speed, scale, slopes, accuracy, budget, wide, evaluation, training):
        action.add_argument("--seed", type=int, default=0, help="of all that is drawn by chance (0)")
    accuracy.add_argument(
        "--city", type=Path, action="append", help="city model, repeat for a table of several; the demo town"
    )
    for action in (speed, budget, wide, city, training):
        action.add_argument("--city", type=Path, help="city model; the demo town if not given")
    measured = (speed, scale, slopes, accuracy, budget, wide, city, evaluation, flights, real, workers)
    every = (*measured, *uses, segmentation, training)
    for action in every:
        action.add_argument("--json", action="store_true", help="one figure per line, for machines")
    return parser


def _city_file(options: argparse.Namespace) -> Path:
    """Returns the city asked for, or the demo town's."""
    if options.city is not None:
        return Path(options.city)
    from lodbench.synthesis.demo import DemoParams, open_demo
    from lodbench.synthesis.town.build import CITY_FILE

    return open_demo(DemoParams()).root / CITY_FILE
