"""`lodbench bench real`: recall from the pixels of real photos, priors drawn anew."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from lodbench.bench.figures import Report
from lodbench.bench.real_query import RealOptions, measure_real
from lodbench.bench.traced_photos import TracedOptions, open_traced_photos
from lodbench.citymodel.scene import Scene
from lodbench.cli.segmenters import default_segmenter, segmenter_of
from lodbench.datasets.folder import FolderParams, open_folder
from lodbench.datasets.inputs import Input, declared_inputs
from lodbench.datasets.priors import UniformPrior
from lodbench.datasets.query import Dataset
from lodbench.errors import ConfigError, require_within
from lodbench.execution import ProgressCallback
from lodbench.harness.city import open_city
from lodbench.methods.registry import configure_method

_MORE = """\
  lodbench bench real --query DIR --city CITY --priors 20
  lodbench bench real --query DIR --city CITY --prior-range 50 --prior-yaw 30     the wide protocol
  lodbench bench real --query DIR --city CITY --method region,contour_alignment --segmenter compact
  lodbench bench real --photos DIR     DIR/PLACE/photos with traced DIR/PLACE/masks, which make the map
  lodbench bench real --photos DIR --method contour_alignment --segmenter masks     by the traced masks
"""


def add_real(actions: Any) -> argparse.ArgumentParser:
    """Adds the command's options to ``lodbench bench`` and returns its parser."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "real", help="recall on posed real photos from redrawn priors", epilog=_MORE
    )
    add = parser.add_argument
    photos = parser.add_mutually_exclusive_group(required=True)
    photos.add_argument("--query", type=Path, metavar="DIR", help="photos and poses, as dataset=folder")
    photos.add_argument(
        "--photos", type=Path, metavar="DIR", help="photos and traced masks, which make the map"
    )
    add("--city", type=Path, metavar="FILE", help="city model; needed with --query")
    add("--map-error", type=float, metavar="M", help="of maps made of traced masks (0.5)")
    add("--lod", help="level of detail to localise against (the lowest)")
    add("--crs", help="of the city model, where its file says none")
    add("--method", default="region", help="methods, comma-separated (region)")
    add("--segmenter", metavar="NAME", help="for methods that want a mask (as a run chooses)")
    add("--priors", type=int, default=20, help="drawn around each photo's truth (20)")
    add("--prior-range", type=float, default=10.0, metavar="M", help="+- east and north (10)")
    add("--prior-height", type=float, default=30.0, metavar="M", help="+- up (30)")
    add("--prior-yaw", type=float, default=7.5, metavar="DEG", help="+- (7.5)")
    add("--prior-tilt", type=float, default=1.0, metavar="DEG", help="+- pitch and roll (1)")
    add("--pictures", type=Path, metavar="DIR", help="folder for a picture of the basins")
    add("--seed", type=int, default=0, help="random seed (default: 0)")
    return parser


def measure(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    """Returns what was asked for."""
    for name in ("range", "height", "yaw", "tilt"):
        require_within(f"--prior-{name}", getattr(options, f"prior_{name}"), 0)
    dataset, scene = _photos_and_map(options)
    width = UniformPrior(
        x_m=options.prior_range,
        y_m=options.prior_range,
        z_m=options.prior_height,
        yaw_deg=options.prior_yaw,
        pitch_deg=options.prior_tilt,
        roll_deg=options.prior_tilt,
    )
    methods = [configure_method({"name": n}).for_prior(width).make() for n in options.method.split(",")]
    needs_mask = any(Input.MASK in declared_inputs(method, "requires") for method in methods)
    if options.segmenter is not None:
        segmenter = segmenter_of(options.segmenter)
    else:
        segmenter = default_segmenter(dataset)[0] if needs_mask else segmenter_of("none")
    # Priors of another width than the dataset's own leave its own out; traced photos have none.
    has_own = options.photos is None and width == UniformPrior()
    asked = RealOptions(options.priors, width, is_published_too=has_own, seed=options.seed)
    return measure_real(dataset, scene, segmenter, methods, asked, steps)


def _photos_and_map(options: argparse.Namespace) -> tuple[Dataset, Scene]:
    if options.photos is not None:
        if options.city is not None:
            raise ConfigError("--photos makes its own map.", "Leave out --city, or write --query DIR.")
        for name in ("lod", "crs"):
            if getattr(options, name) is not None:
                raise ConfigError(
                    f"--{name} is of a --city, and --photos makes its own map.", f"Leave --{name} out."
                )
        asked = TracedOptions(seed=options.seed)
        if options.map_error is not None:
            asked = replace(asked, map_error_m=options.map_error)
        return open_traced_photos(options.photos, asked)
    if options.map_error is not None:
        raise ConfigError(
            "--map-error is of maps that --photos makes, not of --city.", "Leave --map-error out."
        )
    if options.city is None or not options.city.exists():
        what = "--query needs a city model." if options.city is None else f"{options.city} does not exist."
        raise ConfigError(what, "Write --city FILE.")
    dataset = open_folder(
        FolderParams(
            str(options.query), str(options.city), options.lod, options.crs, None, options.query.name
        )
    )
    city = open_city(options.city, dataset.lod, dataset.city_options, dataset.roof_height)
    return dataset, city.scene
