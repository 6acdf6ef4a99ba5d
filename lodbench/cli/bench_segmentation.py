"""`lodbench bench segmentation`: masks of a network, or recall over the IoU of masks."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from lodbench.bench import Report
from lodbench.bench.iou_recall import measure_instances, measure_iou_recall
from lodbench.bench.mask_quality import MaskQualityOptions, measure_masks
from lodbench.bench.photo_masks import measure_photo_masks
from lodbench.cli.parts import segmenter_of
from lodbench.errors import ConfigError
from lodbench.execution import ProgressCallback
from lodbench.methods.registry import make_method
from lodbench.segmentation import Segmenter
from lodbench.segmentation.photo_segmenter import require_photo_segmenter
from lodbench.segmentation.registry import FOR_PHOTOS
from lodbench.synthesis.views_dataset import ViewsParams

_VIEWS_OF_TOWN, _VIEWS_OF_CITY = 80, 50
_MORE = """\
  lodbench bench segmentation                                the shipped network on an unseen town
  lodbench bench segmentation --segmenter-option weights=compact.onnx --pictures DIR
  lodbench bench segmentation --photos DIR --pictures OUT    real photos with masks traced by hand, by place
  lodbench bench segmentation --data SET --visible SET2      views of `lodbench generate-training-data`
  lodbench bench segmentation --data SET --instances         single buildings, of sets with labels=true
  lodbench bench segmentation --city CITY --pictures DIR     recall over the IoU of masks, no network at all
"""


def add_segmentation(actions: Any) -> argparse.ArgumentParser:
    """Adds the command's options to ``lodbench bench`` and returns its parser."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "segmentation",
        help="IoU and time of a network's masks; with --city, recall over the IoU of masks",
        epilog=_MORE,
    )
    add = parser.add_argument
    add("--segmenter", metavar="NAME", help="that looks at photos (compact; of --photos efficient_unet)")
    add("--segmenter-option", action="append", default=[], metavar="KEY=VALUE", help="may be repeated")
    add("--data", type=Path, metavar="SET", help="training set, or folder of sets; else a town")
    add("--photos", type=Path, metavar="DIR", help="real photos with traced masks: PLACE/photos, PLACE/masks")
    add("--instances", action="store_true", help="of --data: how well single buildings are separated")
    add("--visible", type=Path, metavar="SET", help="the same with occluders_in_mask=true")
    add("--town", help="test or train: views made on first use (test)")
    add("--city", type=Path, help="measure recall over the IoU of masks on views of it")
    add("--method", help="methods of --city, comma-separated (lodlocv2)")
    add("--views", type=int, help="of the town (80), or of the city (50)")
    add("--seed", type=int, help="of the views of --city (0)")
    add("--pictures", type=Path, metavar="DIR", help="folder for a picture")
    return parser


def measure_segmentation(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    """Returns what was requested."""
    if options.photos is not None:
        others = ("city", "data", "visible", "views")
        if options.instances or any(getattr(options, name) is not None for name in others):
            left_out = "Leave out --city, --data, --visible, --views and --instances."
            raise ConfigError("--photos are measured by themselves.", left_out)
        return _photos(options, steps)
    if options.instances:
        if options.data is None:
            raise ConfigError("--instances needs views with labels.", "Name their set: --data SET.")
        _require_read(options, "--instances", "data")
        segmenter = segmenter_of(options.segmenter or "compact_instances", options.segmenter_option)
        return measure_instances(segmenter, options.data, steps)
    if options.city is not None:
        return _curve(options, steps)
    if options.visible is not None and options.data is None:
        raise ConfigError("--visible is of no use without --data.", "Name the set that it is the same as.")
    return _masks(options, steps)


def _require_read(options: argparse.Namespace, asked_for: str, *read: str) -> None:
    """Makes sure that no option is given that what is requested does not read.

    Raises:
        ConfigError: One is: a figure would be taken for what it is not.
    """
    for name in ("city", "data", "visible", "views", "town", "method", "seed"):
        if name not in read and getattr(options, name) is not None:
            raise ConfigError(f"--{name} is not used with {asked_for}.", f"Leave --{name} out.")


def _photos(options: argparse.Namespace, steps: ProgressCallback) -> Report:
    _require_read(options, "--photos")
    report = measure_photo_masks(_segmenter(options, FOR_PHOTOS), options.photos, steps)
    if options.pictures is not None:
        report.write_pictures(options.pictures)
    return Report(report.to_text(), report.figures())


def _segmenter(options: argparse.Namespace, default: str) -> Segmenter:
    return require_photo_segmenter(segmenter_of(options.segmenter or default, options.segmenter_option))


def _curve(options: argparse.Namespace, steps: ProgressCallback) -> Report:
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
    return measure_iou_recall(views, methods, steps)


def _masks(options: argparse.Namespace, steps: ProgressCallback) -> Report:
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
    return measure_masks(segmenter, MaskQualityOptions(data, visible), steps)
