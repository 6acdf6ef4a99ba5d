"""`lodbench dataset init` and `lodbench dataset import`: one's own photos and poses into a dataset folder."""

from __future__ import annotations

import json
import math
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.cli.options import CAMERA_HELP, HeightFlags, ReadingOptions, given_camera
from lodbench.cli.parser import Parser
from lodbench.errors import ConfigError, nearest_names, require_within
from lodbench.params import add_options, flag, options_of, part, word
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


# Formats by the names that `lodbench export` has for them.
_ALIASES = {"visuallocalization": "lines"}


@dataclass(frozen=True, kw_only=True)
class PhotoSetOptions:
    """What both ways to make a dataset take."""

    masks: Path | None = flag(None, "building masks of the photos, white = building", metavar="DIR")
    camera: str | None = flag(
        None, f"of all images, as COLMAP has it{CAMERA_HELP}", metavar="'MODEL W H ...'"
    )
    offset: tuple[float, float, float] = flag(
        (0.0, 0.0, 0.0),
        "added to positions: what was taken off the city's coordinates",
        metavar=("E", "N", "UP"),
    )
    heights: HeightFlags = part(HeightFlags, "heights: from the drone's datum to the city's")
    json: bool = flag(False, "print JSON, for scripts")


@dataclass(frozen=True, kw_only=True)
class InitOptions:
    """What `dataset init` is given."""

    folder: Path = word("new folder", metavar="DIR")
    images: Path = flag(..., "photos, as the drone stored them", metavar="DIR")
    city: Path = flag(..., "city model", metavar="FILE", sets=("city",))
    colmap: Path | None = flag(None, "folder of a COLMAP model: the truth", metavar="MODEL")
    no_common_view: float | None = flag(
        None,
        "keep only photos whose views, up to so far (300), do not meet: no two see the same ground",
        nargs="?",
        const=300.0,
        metavar="METRES",
    )
    reading: ReadingOptions = part(ReadingOptions)
    common: PhotoSetOptions = part(PhotoSetOptions)

    def sources(self) -> dict[str, Any]:
        """Returns what the poses come from.

        Raises:
            ConfigError: A distance is none.
        """
        require_within("--no-common-view", self.no_common_view, 0, ends="(]")
        return {"poses": self.colmap, "format": "colmap", "apart_m": self.no_common_view}


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """What `dataset import` is given."""

    format: str = word("see below", metavar="FORMAT")
    poses: Path = word("file or folder in that format", metavar="SOURCE")
    folder: Path = word("new folder", metavar="DIR")
    images: Path | None = flag(None, "photos; without it poses and cameras only", metavar="DIR")
    cameras: Path | None = flag(None, "cameras, as in intrinsic.txt", metavar="FILE")
    city: Path | None = flag(
        None, "city model: to check where the cameras are, and for priors", metavar="FILE", sets=("city",)
    )
    reading: ReadingOptions = part(ReadingOptions)
    common: PhotoSetOptions = part(PhotoSetOptions)

    def sources(self) -> dict[str, Any]:
        """Returns what the poses come from.

        Raises:
            ConfigError: There is no such format.
        """
        known = (*plugin_names("pose_formats"), *_ALIASES, "auto")
        if self.format not in known:
            raise ConfigError(
                f"lodbench dataset import: there is no FORMAT {self.format!r}.",
                nearest_names(self.format, known),
            )
        form = _ALIASES.get(self.format, self.format)
        return {"poses": self.poses, "format": form, "cameras": self.cameras}


_ACTIONS: dict[str, tuple[type, str, str, str]] = {
    "init": (
        InitOptions,
        "a dataset from your photos and a city model",
        "Make a dataset of your photos and a city model, as dataset=folder of a run takes it.",
        _INIT_EPILOG,
    ),
    "import": (
        ImportOptions,
        "a dataset from another program's poses",
        "Make a dataset of another program's poses, which become its truth.",
        _IMPORT_EPILOG,
    ),
}


OPTIONS = {f"dataset {name}": kind for name, (kind, *_) in _ACTIONS.items()}


def main(argv: Sequence[str]) -> int:
    """Runs ``init`` or ``import``, whichever the first word is; returns the exit code."""
    parser = Parser("lodbench dataset")
    actions = parser.add_subparsers(dest="action", required=True)
    for name, (kind, help_, about, epilog) in _ACTIONS.items():
        add_options(actions.add_parser(name, help=help_, description=about, epilog=epilog), kind)
    words = parser.parse_args(argv)
    return _make(options_of(words, _ACTIONS[words.action][0]))


def _make(given: InitOptions | ImportOptions) -> int:
    from lodbench.harness.photo.own_dataset import OwnRequest, make_own_dataset, to_json

    common, sources = given.common, given.sources()
    require_within("--offset", common.offset, -math.inf)
    _require_used(given)
    profile = given.reading.profile()
    camera, camera_sigmas = given_camera(common.camera)
    made = make_own_dataset(
        OwnRequest(
            folder=given.folder,
            photos=given.images,
            masks=common.masks,
            camera=camera,
            camera_sigmas=camera_sigmas,
            offset_m=common.offset,
            city=given.city,
            lod=given.reading.lod or profile.lod,
            options=profile.options,
            heights=common.heights.options(),
            **sources,
        )
    )
    text = json.dumps(to_json(made), indent=2, ensure_ascii=False) if common.json else _describe(made, given)
    sys.stdout.write(text + "\n")
    return 0


def _require_used(given: InitOptions | ImportOptions) -> None:
    """Refuses options that nothing would read."""
    common, heights = given.common, given.common.heights.given()
    is_alone = isinstance(given, InitOptions) and given.colmap is None
    unused = [
        ("--city", given.reading.given() if given.city is None else []),
        ("--city and --images", heights if None in (given.city, given.images) else []),
        ("--images", ["--masks"] if given.images is None and common.masks is not None else []),
        ("--colmap", ["--offset"] if is_alone and any(common.offset) else []),
    ]
    for needed, flags in unused:
        if flags:
            raise ConfigError(
                f"{flags[0]} is not used without {needed}.", f"Give {needed}, or leave {flags[0]} out."
            )
    if isinstance(given, ImportOptions) and None not in (common.camera, given.cameras):
        raise ConfigError("--camera and --cameras say the same.", "Leave one of them out.")


def _describe(made: OwnDataset, given: InitOptions | ImportOptions) -> str:
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
        "method=contour_alignment" if given.common.masks or given.images is None else "method=region",
        # Without photos the only masks are those of the city at the true poses.
        "segmenter=oracle" if given.images is None else "",
        # The run must read the city as it was read here.
        f"dataset.crs={given.reading.crs}" if given.reading.crs else "",
        f"dataset.lod={given.reading.lod}" if given.reading.lod else "",
        f"source={given.reading.source}" if given.reading.source != "folder" else "",
        *(f"source.options.{option}" for option in given.reading.option),
    ]
    lines.append("Next: lodbench run " + shlex.join(word for word in words if word))
    return "\n".join(lines)
