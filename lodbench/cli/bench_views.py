"""`lodbench bench accuracy`: seeded views of a city."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from lodbench.bench import SEED, Report
from lodbench.bench.accuracy import measure_accuracy, measure_cities
from lodbench.datasets.inputs import Input
from lodbench.errors import ConfigError, DatasetError
from lodbench.execution import ProgressCallback
from lodbench.geometry.camera import CALIBRATED
from lodbench.methods import Method
from lodbench.methods.registry import make_method
from lodbench.synthesis.photo import look_ranges
from lodbench.synthesis.views_dataset import AREAS, CAMERA_SOURCES, Perturbation, ViewsParams

_WORLD = (
    "how the views differ from the map and the stated camera: shared_roofs and hidden_feet in metres, focal "
    "as a share, tilt as a factor on the stated one, center as a share of the width, k1"
)


def add_views(actions: Any) -> None:
    """Adds the parser."""
    accuracy = actions.add_parser("accuracy", help="recall of methods on synthetic views of a real model")
    accuracy.add_argument("--pictures", type=Path, help="folder for reliability and risk over coverage")
    add_methods(accuracy)


def add_methods(parser: argparse.ArgumentParser) -> None:
    """Adds the options that ``asked_methods`` and ``asked_views`` read."""
    parser.add_argument("--method", default="lodlocv2", help="methods, comma-separated (lodlocv2)")
    looked = "draw photos in this look: plain, varied or hard (none), for methods that look at photos"
    parser.add_argument("--look", help=looked)
    several = "city model, repeat for a table of several; the demo town"
    parser.add_argument("--city", type=Path, action="append", help=several)
    add_drawing(parser, 200)


def add_drawing(parser: argparse.ArgumentParser, num_views: int) -> None:
    """Adds the options of what is drawn, which ``views_of`` and ``seeds_of`` read."""
    add: Any = parser.add_argument
    add("--views", type=int, default=num_views, help=f"seeded views ({num_views})")
    add("--seed", type=int, default=0, help=f"{SEED} (0)")
    add("--seeds", type=seeds, help="seeds, comma-separated, each with views of its own; instead of --seed")
    add("--mask-iou", type=float, default=0.88, help="of the degraded masks (0.88)")
    tilt = "prior's tilt error, +- degrees (1.0)"
    add("--tilt-width", "--tilt-deg", type=float, default=1.0, help=tilt)
    add("--prior-range", type=float, help="prior's error along x, y and z, +- metres (10, 10, 30)")
    add("--prior-height", type=float, help="prior's error along z, +- metres")
    heights = "of the cameras above the ground, metres (100,160); lower over a village"
    add("--camera-height", type=_range, default=(100.0, 160.0), metavar="LOW,HIGH", help=heights)
    shares = "of buildings in a picture; other views are drawn again (0.1,0.8)"
    add("--building-share", type=_range, default=(0.1, 0.8), metavar="LOW,HIGH", help=shares)
    add("--area", choices=AREAS, help="half of the city to look at (all of it)")
    drawn = "level of detail that views and masks are drawn from, or finest (the map's)"
    add("--mask-lod", help=drawn)
    add("--map-lod", help="level of detail that is searched (the lowest)")
    add("--roof-height", metavar="RULE", help="derive an absent LoD1: median, max, p70 or eave")
    known = "how well the stated camera is known: calibration, maker or nominal (calibration)"
    add("--camera-source", choices=tuple(CAMERA_SOURCES), default=CALIBRATED.source, help=known)
    add(
        "--rtk",
        type=float,
        metavar="M",
        help="priors where an RTK receiver has them, to so many metres (none)",
    )
    add(
        "--laser",
        type=float,
        metavar="M",
        help="a laser's range to the photo's centre, to so many metres (none)",
    )
    add("--world", default="", metavar="NAME=VALUE,...", help=_WORLD)


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


def add_city(parser: argparse.ArgumentParser) -> None:
    """Adds the option that ``city_file`` reads."""
    parser.add_argument("--city", type=Path, help="city model; the demo town if not given")


def city_file(given: argparse.Namespace) -> Path:
    """Returns the city requested, or the demo town's.

    Raises:
        DatasetError: It is not there.
    """
    return _or_demo(given.city)


def _or_demo(city: Path | None) -> Path:
    if city is not None:
        if not city.exists():
            raise DatasetError(f"The city model {city} does not exist.", "Check the path after --city.")
        return city
    from lodbench.synthesis.demo import DemoParams, open_demo
    from lodbench.synthesis.town.build import CITY_FILE

    return open_demo(DemoParams()).root / CITY_FILE


def accuracy(given: argparse.Namespace, steps: ProgressCallback) -> Report:
    """Returns what methods find, of one city or of several."""
    methods, drawn = asked_methods(given), asked_views(given)
    if len(drawn) == 1:
        return measure_accuracy(drawn[0], seeds_of(given), methods, steps)
    return measure_cities(drawn, seeds_of(given), methods, steps)


def asked_methods(given: argparse.Namespace) -> list[Method]:
    """Returns the methods named.

    Raises:
        ConfigError: There is none of a name, or one looks at photos and none are drawn.
    """
    # One named twice would count its views twice.
    methods = [make_method(name) for name in dict.fromkeys(given.method.split(","))]
    blind = [method.name for method in methods if Input.IMAGE in method.requires]
    if blind and given.look is None:
        raise ConfigError(f"{blind[0]} looks at photos, and no photos are drawn.", "Add --look hard.")
    return methods


def asked_views(given: argparse.Namespace) -> list[ViewsParams]:
    """Returns what is drawn over each city named.

    Raises:
        LodbenchError: A city is not there, the look is not known, or an option is out of range.
    """
    if given.look is not None:
        look_ranges(given.look)  # not known: reported before any city is read
    return [replace(views_of(given, city), look=given.look) for city in dict.fromkeys(given.city or [None])]


def views_of(given: argparse.Namespace, city: Path | None) -> ViewsParams:
    """Returns what is drawn over a city, or the demo town.

    Raises:
        LodbenchError: The city is not there, or an option is out of range.
    """
    params = _params(given)  # before the demo town is made, which takes minutes
    return replace(params, city_model=str(_or_demo(city)))


def _params(given: argparse.Namespace) -> ViewsParams:
    return ViewsParams(
        city_model="",
        num_views=given.views,
        mask_iou=given.mask_iou,
        tilt_deg=given.tilt_width,
        range_m=given.prior_range,
        rtk_m=given.rtk,
        laser_m=given.laser,
        height_m=given.prior_height,
        camera_height_m=given.camera_height,
        building_share=given.building_share,
        area=given.area,
        lod=given.map_lod,
        mask_lod=given.mask_lod,
        roof_height=given.roof_height,
        world=_world(given.world),
        camera_source=given.camera_source,
    )


def seeds_of(given: argparse.Namespace) -> list[int]:
    """Returns the seeds of what is drawn."""
    return given.seeds or [given.seed]


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
    found = whole_numbers("Seeds", text, hint)
    if len(set(found)) < len(found):
        raise ConfigError(f"A seed is given twice: {text}.", hint)
    return found


def _range(text: str) -> tuple[float, float]:
    """Returns LOW,HIGH as typed, or in brackets as settings have them."""
    try:
        low, high = (float(part) for part in text.strip("[]").split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text} is not LOW,HIGH, as in 40,80") from None
    return low, high
