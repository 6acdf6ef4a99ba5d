"""What commands there are, and the help above them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import cast

# Command -> (module with `main(argv) -> int`, or module:function; one line of help).
COMMANDS = {
    "localize": (
        "lodbench.cli.localize",
        "localise your photos: pose, overlay, map, reliability",
    ),
    "locate": (
        "lodbench.cli.locate",
        "map coordinates of pixels, or mask regions, of a localised photo",
    ),
    "track": (
        "lodbench.cli.track_georeference:main_track",
        "localise each frame of a video or of a folder of frames",
    ),
    "georeference": (
        "lodbench.cli.track_georeference:main_georeference",
        "georeference a COLMAP model by its buildings, without ground control points",
    ),
    "mask": (
        "lodbench.cli.mask_trace:main_mask",
        "make or correct a photo's building mask by hand; LabelMe, COCO, QGIS",
    ),
    "trace": (
        "lodbench.cli.mask_trace:main_trace",
        "trace a map of roofs in the photos of a COLMAP model; make a benchmark",
    ),
    "run": ("lodbench.cli.run", "localise the photos of a dataset with one method, and score the poses"),
    "basin": ("lodbench.cli.run:main_basin", "measure recall over the error of the prior"),
    "evaluate": ("lodbench.cli.evaluate", "score poses made by another program: COLMAP, TUM, ..."),
    "compare": ("lodbench.cli.compare", "put runs into one table, and test whether they differ"),
    "report": (
        "lodbench.cli.stored_runs:main_report",
        "write an HTML page of a run: tables, figures, every photo",
    ),
    "export": (
        "lodbench.cli.stored_runs:main_export",
        "write a run's poses for other programs: COLMAP, Metashape, GeoJSON, ...",
    ),
    "status": ("lodbench.cli.stored_runs:main_status", "show the progress of runs"),
    "verify": ("lodbench.cli.verify", "recompute a run's numbers from its stored poses; fail if they differ"),
    "leaderboard": ("lodbench.cli.leaderboard", "add a verified run; build tables and pages"),
    "bench": ("lodbench.cli.bench", "measure speed and accuracy, beside other programs"),
    "city": ("lodbench.cli.city", "inspect, check or convert a city model"),
    "dataset": (
        "lodbench.cli.commands:dataset",
        "list, check, download or import datasets; make one of your photos (init)",
    ),
    "render": (
        "lodbench.cli.training:main_render",
        "draw a city from given poses: silhouette, depth, label, colour, overlay",
    ),
    "generate-training-data": (
        "lodbench.cli.training:main_generate",
        "render images, masks and poses of a city",
    ),
    "train": (
        "lodbench.cli.training:main_train",
        "train a segmentation network, or a method, on such images",
    ),
    "doctor": (
        "lodbench.cli.doctor:main_doctor",
        "check this installation, and say what to install for optional features",
    ),
    "check-method": ("lodbench.cli.doctor:main_method", "check that a method conforms to the protocol"),
    "check-plugin": (
        "lodbench.cli.doctor:main_plugin",
        "check any other plug-in likewise: see docs/plugins.md",
    ),
    "completion": (
        "lodbench.cli.shell:main_completion",
        "print a script that completes commands in bash or zsh",
    ),
}

# Action of `lodbench dataset` -> (as of ``COMMANDS``; the words begin with the action; one line of help).
ACTIONS = {
    "list": ("lodbench.cli.dataset_list", "what is there, what is missing, where to get it"),
    "check": ("lodbench.cli.dataset_check", "is it sound: files, counts, poses, priors, photos, city model"),
    "download": (
        "lodbench.cli.dataset_list:main_download",
        "fetch what has a stable address; say how to get the rest",
    ),
    "card": (
        "lodbench.cli.dataset_list:main_card",
        "its card: licence, provenance, truth, splits, known issues",
    ),
    "prior": (
        "lodbench.cli.dataset_check:main_prior",
        "write a dataset's priors to a file: drawn, or the photos' own",
    ),
    "init": ("lodbench.cli.dataset_own", "a dataset from your photos and a city model"),
    "import": ("lodbench.cli.dataset_own", "a dataset from another program's poses"),
    "make-demo": (
        "lodbench.cli.dataset_list:main_demo",
        "write the demo town, its queries and masks to a folder",
    ),
}

# The first command of each group -> what stands above the group in the help.
HEADINGS = {
    "localize": "Your photos",
    "run": "Methods and their results",
    "city": "City models and datasets",
    "generate-training-data": "Training",
    "doctor": "This machine, and plug-ins",
}

USAGE = """\
lodbench localises aerial photos in a 3D city model, and benchmarks methods that do so.

Usage: lodbench COMMAND [...]
       lodbench COMMAND --help

Start here:
  lodbench run method=region dataset=demo          # try it: 40 photos of a built-in town
  lodbench city info FILE                          # is your city model read correctly?
  lodbench localize PHOTO ... --city FILE          # where were your photos taken?
  lodbench run dataset=folder dataset.root=DIR city=FILE   # a method over a dataset of your own
{commands}

`lodbench doctor` lists plug-ins, their commands too.
"""


def load_command(place: str) -> Callable[[Sequence[str]], int]:
    """Returns the function of a command, as ``COMMANDS`` places it: from words to an exit code."""
    module, _, name = place.partition(":")
    return cast("Callable[[Sequence[str]], int]", getattr(import_module(module), name or "main"))


def _dataset_usage() -> str:
    """Returns the help of `lodbench dataset --help`."""
    width = max(map(len, ACTIONS))
    head = "usage: lodbench dataset ACTION [...]        lodbench dataset ACTION --help"
    lines = [f"  {name.ljust(width)}  {help_}" for name, (_, help_) in ACTIONS.items()]
    return "\n".join([head, "", *lines, ""])


def dataset(argv: Sequence[str]) -> int:
    """Runs `lodbench dataset ACTION`; returns the exit code.

    Raises:
        ConfigError: There is no such action.
    """
    if not argv or argv[0] in ("-h", "--help"):
        sys.stdout.write(_dataset_usage())
        return 0 if argv else 2
    if argv[0] not in ACTIONS:
        from lodbench.errors import ConfigError, nearest_names

        raise ConfigError(f"There is no `lodbench dataset {argv[0]}`.", nearest_names(argv[0], ACTIONS))
    return load_command(ACTIONS[argv[0]][0])(argv)
