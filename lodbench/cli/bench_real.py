"""`lodbench bench real`: recall from the pixels of real photos, priors drawn anew."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from lodbench.bench import Report
from lodbench.bench.photo_masks import TracedOptions, open_traced_photos
from lodbench.bench.real_query import RealOptions, RealSet, measure_real
from lodbench.citymodel.scene import Scene
from lodbench.cli.parts import default_segmenter, option_pairs, segmenter_of
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.inputs import Input, declared_inputs
from lodbench.datasets.prior_sources import UniformPrior
from lodbench.datasets.query import Dataset
from lodbench.datasets.real_flights import city_beside, require_one_flight
from lodbench.errors import ConfigError, require_within
from lodbench.execution import ProgressCallback
from lodbench.harness.city import open_city
from lodbench.methods import Method
from lodbench.methods.protocol import SupportsFlights
from lodbench.methods.registry import configure_method

_MORE = """\
  lodbench bench real --query DIR --city CITY --priors 20
  lodbench bench real --query FLIGHT FLIGHT --method region,flight --method-option flight.single=region
  lodbench bench real --query FLIGHT --published-priors     over its own city.obj, from its own priors
  lodbench bench real --query DIR --city CITY --prior-range 50 --prior-yaw 30     the wide protocol
  lodbench bench real --query DIR --city CITY --method region,contour_alignment --segmenter compact
  lodbench bench real --photos DIR     DIR/PLACE/photos with traced DIR/PLACE/masks, which make the map
  lodbench bench real --photos DIR --method contour_alignment --segmenter masks     by the traced masks
"""
_OPTION = "setting of one of the methods, as flight.single=region"
_SHARED = "whether photos of a flight err together (yes where a method solves flights)"


def add_real(actions: Any) -> argparse.ArgumentParser:
    """Adds the command's options to ``lodbench bench`` and returns its parser."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "real", help="recall on posed real photos from redrawn priors", epilog=_MORE
    )
    add = parser.add_argument
    photos = parser.add_mutually_exclusive_group(required=True)
    photos.add_argument(
        "--query", type=Path, nargs="+", metavar="DIR", help="sets of photos and poses, as dataset=folder"
    )
    photos.add_argument(
        "--photos", type=Path, metavar="DIR", help="photos and traced masks, which make the map"
    )
    add("--city", type=Path, metavar="FILE", help="city model of every --query (its city.obj)")
    add("--map-error", type=float, metavar="M", help="of maps made of traced masks (0.5)")
    add("--lod", help="level of detail to localise against (the lowest)")
    add("--crs", help="of the city model, where its file says none")
    add("--method", default="region", help="methods, comma-separated (region)")
    add("--method-option", action="append", default=[], metavar="METHOD.KEY=VALUE", help=_OPTION)
    add("--segmenter", metavar="NAME", help="for methods that want a mask (as a run chooses)")
    add("--priors", type=int, default=20, help="drawn around each photo's truth (20)")
    add("--prior-range", type=float, default=10.0, metavar="M", help="+- east and north (10)")
    add("--prior-height", type=float, default=30.0, metavar="M", help="+- up (30)")
    add("--prior-yaw", type=float, default=7.5, metavar="DEG", help="+- (7.5)")
    add("--prior-tilt", type=float, default=1.0, metavar="DEG", help="+- pitch and roll (1)")
    add("--shared-priors", choices=("yes", "no"), help=_SHARED)
    add("--published-priors", action="store_true", help="the sets' own priors only")
    add("--bound", action="store_true", help="also where roof edges lead from the true poses")
    add("--pictures", type=Path, metavar="DIR", help="folder for a picture of the basins")
    add("--seed", type=int, default=0, help="random seed (default: 0)")
    return parser


def measure(options: argparse.Namespace, steps: ProgressCallback) -> Report:
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
        sets.append(RealSet(dataset, scene, segmenter))
    return measure_real(sets, methods, _asked(options, width, methods), steps)


def _methods(options: argparse.Namespace, width: UniformPrior) -> dict[str, Method]:
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
        settings[name] |= option_pairs([setting])
    return {
        " ".join([name, *(f"{key}={value}" for key, value in given.items())]): configure_method(
            {**given, "name": name}
        )
        .for_prior(width)
        .make()
        for name, given in settings.items()
    }


def _asked(options: argparse.Namespace, width: UniformPrior, methods: Mapping[str, Method]) -> RealOptions:
    """Returns which priors are measured."""
    if options.published_priors:
        if options.photos is not None or options.shared_priors is not None or width != UniformPrior():
            raise ConfigError(
                "--published-priors takes the sets' own priors: none of --photos, none drawn.",
                "Leave it out, or --photos, --shared-priors and --prior-* out.",
            )
        return RealOptions(
            options.priors, width, is_published_only=True, is_bounded=options.bound, seed=options.seed
        )
    solves_flights = any(isinstance(method, SupportsFlights) for method in methods.values())
    is_shared = options.shared_priors == "yes" if options.shared_priors else solves_flights
    # Priors of another kind than the dataset's own leave its own out; traced photos have none.
    has_own = options.photos is None and width == UniformPrior() and not is_shared
    return RealOptions(
        options.priors,
        width,
        is_shared,
        is_published_too=has_own,
        is_bounded=options.bound,
        seed=options.seed,
    )


def _photos_and_maps(options: argparse.Namespace) -> list[tuple[Dataset, Scene]]:
    if options.photos is not None:
        return [_traced_photos(options)]
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


def _open_set(options: argparse.Namespace, query: Path, name: str) -> tuple[Dataset, Scene]:
    if options.city is None:
        require_one_flight(query)
    city = city_beside(query) if options.city is None else str(options.city)
    dataset = open_folder(FolderParams(str(query), city, options.lod, options.crs, None, name))
    if dataset.city_model is None:
        raise ConfigError(f"--query {query} has no city.obj and needs a city model.", "Write --city FILE.")
    city_of = open_city(dataset.city_model, dataset.lod, dataset.city_options, dataset.roof_height)
    return dataset, city_of.scene


def _traced_photos(options: argparse.Namespace) -> tuple[Dataset, Scene]:
    if options.city is not None:
        raise ConfigError("--photos makes its own map.", "Leave out --city, or write --query DIR.")
    for name in ("lod", "crs"):
        if getattr(options, name) is not None:
            raise ConfigError(
                f"--{name} is of a --city, and --photos makes its own map.", f"Leave --{name} out."
            )
    wanted = TracedOptions(seed=options.seed)
    if options.map_error is not None:
        wanted = replace(wanted, map_error_m=options.map_error)
    return open_traced_photos(options.photos, wanted)
