"""`lodbench dataset init` and `lodbench dataset import`: one's own photos and poses into a dataset folder."""

from __future__ import annotations

import argparse
import json
import math
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.cli.parser import Parser
from lodbench.cli.place_options import (
    add_camera_option,
    add_city_options,
    add_height_options,
    city_flags,
    given_camera,
    height_flags,
    height_options,
)
from lodbench.cli.source_profiles import load_profile
from lodbench.errors import ConfigError, nearest_names, require_within
from lodbench.plugins import plugin_names

if TYPE_CHECKING:
    from lodbench.harness.photo.own_dataset import OwnDataset

_INIT_EPILOG = """\
Photos state where they were taken (EXIF, XMP): that becomes the rough pose. With --colmap the model's
poses become the truth; it must be in the city's coordinates, less an --offset. Lens distortion is undone.

examples:
  lodbench dataset init town --images flight1 --city LoD2_32_280_5657_1_NW.gml --masks masks
  lodbench dataset init town --images flight1 --city city.gml --colmap sparse/0 --offset 280000 5657000 0
"""
_IMPORT_EPILOG = """\
FORMAT: colmap (text or binary), kapture, nerfstudio, tum, lines (visuallocalization.net), c2w; Metashape's
exported reference (metashape), Pix4D's calibrated external camera parameters (pix4d), ODM's geo.txt (odm),
all three in projected coordinates, the city's or those that the file declares; a CSV with the head
name,latitude,longitude,height,heading,pitch or easting,northing (table); or auto.
The poses become the truth; kapture's and COLMAP's images without a pose are not part of it.

examples:
  lodbench dataset import colmap sparse/0 town --images images
  lodbench dataset import tum poses.tum town --camera 'PINHOLE 4000 3000 2900 2900 2000 1500'
"""


def main(argv: Sequence[str]) -> int:
    """Runs ``init`` or ``import``, whichever the first word is; returns the exit code."""
    parser = Parser("lodbench dataset")
    _add_actions(parser.add_subparsers(dest="action", required=True))
    given = parser.parse_args(argv)
    code: int = given.make(given)
    return code


def _add_actions(actions: Any) -> None:
    init = actions.add_parser(
        "init",
        help="a dataset from your photos and a city model",
        description="Make a dataset of your photos and a city model, as dataset=folder of a run takes it.",
        epilog=_INIT_EPILOG,
    )
    init.add_argument("folder", type=Path, metavar="DIR", help="new folder")
    init.add_argument(
        "--images", type=Path, required=True, metavar="DIR", help="photos, as the drone stored them"
    )
    init.add_argument("--city", type=Path, required=True, metavar="FILE", help="city model")
    init.add_argument("--colmap", type=Path, metavar="MODEL", help="folder of a COLMAP model: the truth")
    init.add_argument(
        "--no-common-view",
        type=float,
        nargs="?",
        const=300.0,
        metavar="METRES",
        help="keep only photos whose views, up to so far (300), do not meet: no two see the same ground",
    )
    add_city_options(init)
    _add_common_options(init)
    init.set_defaults(make=_init)
    imported = actions.add_parser(
        "import",
        help="a dataset from another program's poses",
        description="Make a dataset of another program's poses, which become its truth.",
        epilog=_IMPORT_EPILOG,
    )
    add = imported.add_argument
    add("format", metavar="FORMAT", help="see below")
    add("poses", type=Path, metavar="SOURCE", help="file or folder in that format")
    add("folder", type=Path, metavar="DIR", help="new folder")
    add("--images", type=Path, metavar="DIR", help="photos; without it poses and cameras only")
    add("--cameras", type=Path, metavar="FILE", help="cameras, as in intrinsic.txt")
    add(
        "--city", type=Path, metavar="FILE", help="city model: to check where the cameras are, and for priors"
    )
    add_city_options(imported)
    _add_common_options(imported)
    imported.set_defaults(make=_import)


def _add_common_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--masks", type=Path, metavar="DIR", help="building masks of the photos, white = building"
    )
    add_camera_option(parser, "of all images, as COLMAP has it")
    parser.add_argument(
        "--offset",
        type=float,
        nargs=3,
        default=(0.0, 0.0, 0.0),
        metavar=("E", "N", "UP"),
        help="added to positions: what was taken off the city's coordinates",
    )
    add_height_options(parser)
    parser.add_argument("--json", action="store_true", help="print JSON, for scripts")


def _init(given: argparse.Namespace) -> int:
    require_within("--no-common-view", given.no_common_view, 0, ends="(]")
    return _make(given, poses=given.colmap, format="colmap", apart_m=given.no_common_view)


# Formats by the names that `lodbench export` has for them.
_ALIASES = {"visuallocalization": "lines"}


def _import(given: argparse.Namespace) -> int:
    known = (*plugin_names("pose_formats"), *_ALIASES, "auto")
    if given.format not in known:
        raise ConfigError(
            f"lodbench dataset import: there is no FORMAT {given.format!r}.",
            nearest_names(given.format, known),
        )
    form = _ALIASES.get(given.format, given.format)
    return _make(given, poses=given.poses, format=form, cameras=given.cameras)


def _make(given: argparse.Namespace, **sources: Any) -> int:
    from lodbench.harness.photo.own_dataset import OwnRequest, make_own_dataset, to_json

    require_within("--offset", given.offset, -math.inf)
    _require_used(given)
    profile = load_profile(given.source, given.option, given.crs, given.date)
    camera, camera_sigmas = given_camera(given.camera)
    made = make_own_dataset(
        OwnRequest(
            folder=given.folder,
            photos=given.images,
            masks=given.masks,
            camera=camera,
            camera_sigmas=camera_sigmas,
            offset_m=tuple(given.offset),
            city=given.city,
            lod=given.lod or profile.lod,
            options=profile.options,
            heights=height_options(given),
            **sources,
        )
    )
    text = json.dumps(to_json(made), indent=2, ensure_ascii=False) if given.json else _describe(made, given)
    sys.stdout.write(text + "\n")
    return 0


def _require_used(given: argparse.Namespace) -> None:
    """Refuses options that nothing would read.

    Raises:
        ConfigError: There is one.
    """
    heights, is_import = height_flags(given), given.make is _import
    unused = [
        ("--city", city_flags(given) if given.city is None else []),
        ("--city and --images", heights if None in (given.city, given.images) else []),
        ("--images", ["--masks"] if given.images is None and given.masks is not None else []),
        ("--colmap", ["--offset"] if not is_import and given.colmap is None and any(given.offset) else []),
    ]
    for needed, flags in unused:
        if flags:
            raise ConfigError(
                f"{flags[0]} is not used without {needed}.", f"Give {needed}, or leave {flags[0]} out."
            )
    if is_import and given.camera is not None and given.cameras is not None:
        raise ConfigError("--camera and --cameras say the same.", "Leave one of them out.")


def _describe(made: OwnDataset, given: argparse.Namespace) -> str:
    """Returns what was made, what was not, and the next command."""
    written = made.written
    count = len(written.names)
    lines = [
        f"{written.folder}: {count} image{'s' * (count != 1)}, {made.num_priors} with a prior, "
        f"{'with' if made.has_truth else 'without'} truth, {written.undistorted} undistorted"
    ]
    lines += [f"  left out: {name}: {reason}" for name, reason in written.left_out]
    lines += [f"  note: {note}" for note in made.notes]
    words = [
        "dataset=folder",
        f"dataset.root={written.folder}",
        # dataset.json names the city that is known.
        "" if given.city else "city=FILE",
        "" if made.num_priors else "prior=uniform",
        "method=contour_alignment" if given.masks or given.images is None else "method=region",
        # Without photos the only masks are those of the city at the true poses.
        "segmenter=oracle" if given.images is None else "",
        # The run must read the city as it was read here.
        f"dataset.crs={given.crs}" if given.crs else "",
        f"dataset.lod={given.lod}" if given.lod else "",
        f"source={given.source}" if given.source != "folder" else "",
        *(f"source.options.{option}" for option in given.option),
    ]
    lines.append("Next: lodbench run " + shlex.join(word for word in words if word))
    return "\n".join(lines)
