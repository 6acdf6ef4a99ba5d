"""`lodbench localize`: photos in; where they were taken, overlays, a table and a map out."""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodbench.cli.localize_text import describe, describe_many
from lodbench.cli.parser import Parser
from lodbench.cli.place_options import (
    add_height_options,
    add_map_options,
    add_prior_options,
    add_rough_pose_options,
    add_start_option,
    city_settings,
    require_start_alone,
    rough_settings,
    with_prior_width,
)
from lodbench.cli.segmenters import require_one_mask_source, segmenter_of
from lodbench.cli.source_profiles import option_pairs
from lodbench.errors import ConfigError, DatasetError
from lodbench.execution import Progress
from lodbench.photos.pose import START_OF_EACH
from lodbench.segmentation.registry import FOR_PHOTOS

if TYPE_CHECKING:
    from lodbench.harness.photo.many import Answers
    from lodbench.harness.photo.request import LocalizedPhoto, PhotoRequest
    from lodbench.methods import Method

_LOGGER = logging.getLogger(__name__)

# Exit code where there is a pose, and it is more likely wrong than right.
NOT_TRUSTED = 3
# The methods of one photo, by what there is of it.
_BY_MASK, _BY_PIXELS = "contour_alignment", "auto"
_NO_FLIGHT = "Leave --each-alone and --method out."
# Of the help.
_OPTION = "a setting of it, as in lodbench run --help; may be repeated"

_ABOUT = """\
Find where photos were taken. Writes for each photo its pose, an overlay to check it by, and a map; says how
probable it is that the pose is right.
"""

_EXAMPLES = """\
The rough pose of a photo comes from the photo's metadata (EXIF, and XMP of DJI, Autel, Parrot or Skydio);
options given here take precedence. --start FILE has a rough pose for each photo instead, in the city's
coordinates: lines "name qw qx qy qz tx ty tz" (world to camera), a table of Metashape, or another format that
lodbench reads; or a CSV with the head name,latitude,longitude,height,heading,pitch (degrees, the city's
heights in metres, heading from true north, pitch -90 straight down), such as localized.csv.

Where a photo states how well its position is known (RTK), the search is as wide as that says, unless
--prior-range, --prior-height or --prior-yaw is given; a laser's range to the photo's centre is used.

One photo: without a mask its own pixels are aligned with the map (--method auto, by region); where they leave
the pose open, a network makes a mask, and the more probable of the two poses is taken. The search covers 10 m
around the rough pose, 30 m up and down and 7.5 degrees to either side; --prior-range, --prior-height and
--prior-yaw widen it.

Several photos, or a folder, are taken as flights, separated by camera and by the time in EXIF, and each is
solved as a whole (--method flight). Masks come from --masks, else from a folder named masks in it, else from
a network (efficient_unet), or with --method-option single=region from the photos' own pixels, without a
network. localized.csv, .geojson and .gpkg list all photos; flights.json holds the estimated errors of drone
and map, map_findings.geojson the buildings concerned. --each-alone localises each photo by itself.

Exit code: 3 if a pose is more likely wrong than right, or a photo has none; 1 if none of many photos could be
localised; 2 for wrong options or data; else 0.

examples:
  lodbench localize DJI_0001.JPG --city LoD2_32_280_5657_1_NW.gml
  lodbench localize DJI_0001.JPG --city LoD2_32_280_5657_1_NW.gml --mask DJI_0001_mask.png
  lodbench localize DJI_0001.JPG --city city.gml --mask mask.png --takeoff 61.5
  lodbench localize DJI_0001.JPG --city city.gml --prior-range 100 --prior-yaw 180
  lodbench localize FLIGHT --city city.gml --masks MASKS --out found
  lodbench localize FLIGHT --city city.obj --start rough.txt --camera 'PINHOLE 400 300 290 290 200 150'
  lodbench localize flight1 flight2/*.JPG --city city.gml --each-alone --out found
  lodbench localize photo.jpg --city city.obj --mask mask.png --camera 'PINHOLE 400 300 290 290 200 150' \\
      --center 120 -40 95 --heading 30 --pitch -50
"""


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    from lodbench.harness.photo.request import LocalizedPhoto

    options = parser().parse_args(argv)
    found = localized(options)
    if not isinstance(found, LocalizedPhoto):
        return _tell_many(found, options)
    sys.stdout.write((_json(found.to_json()) if options.json else describe(found)) + "\n")
    return 0 if found.is_trusted else NOT_TRUSTED


def localized(options: argparse.Namespace) -> LocalizedPhoto | Answers:
    """Returns the answer to one photo, or to several, and writes all of it but what is printed.

    Args:
        options: As ``parser`` returns it.

    Raises:
        LodbenchError: An option is wrong, the city cannot be read, or the one photo cannot be localised.
    """
    from lodbench.datasets.own import require_some_mask
    from lodbench.harness.photo.localize import open_map
    from lodbench.harness.photo.many import photos_of
    from lodbench.harness.photo.outputs import require_sidecars

    is_one = len(options.photos) == 1 and options.photos[0].is_file()
    _require_options(options, is_one)
    inside = _masks_inside(options)
    photos = photos_of(options.photos, options.masks or inside, inside, options.out)
    masks = _masks_for(options)
    method = _method(options, is_one, masks)
    masks = masks if "mask" in method.requires else None
    if masks is not None:
        require_some_mask(masks, [f"{photo.parent.name}/{photo.name}" for photo in photos], photos)
    request = _with_start(_request(options, photos[0], method, masks), photos, options)
    _tell_unused(photos, options)
    if options.sidecars:
        require_sidecars(open_map(request).scene.crs, {photo.parent for photo in photos})
    return _one(request, options) if is_one else _several(request, photos, masks, options)


def _one(request: PhotoRequest, options: argparse.Namespace) -> LocalizedPhoto:
    """Returns the answer to one photo, and writes it."""
    from lodbench.harness.photo.localize import STEPS, localize_photo
    from lodbench.harness.photo.outputs import write_view

    with Progress(request.photo.name, STEPS, unit="steps") as progress:
        found = localize_photo(request, progress.advance)
    write_view(found.view, request, [found])
    _write_sidecars([(request.photo, found)], options)
    return found


def _several(
    request: PhotoRequest, photos: Sequence[Path], masks: Path | None, options: argparse.Namespace
) -> Answers:
    """Returns the answers to several photos, as flights or each alone, and writes them.

    Raises:
        ConfigError: There is a reconstruction, and no flight is solved.
    """
    from lodbench.citymodel.imagery import open_imagery
    from lodbench.harness.photo.flights import localize_flights
    from lodbench.harness.photo.localize import open_map
    from lodbench.harness.photo.many import localize_photos
    from lodbench.harness.photo.outputs import write_view
    from lodbench.methods.protocol import SupportsFlights

    if isinstance(request.method, SupportsFlights) and not options.each_alone:
        imagery = None if options.imagery is None else open_imagery(options.imagery, open_map(request).scene)
        answers = localize_flights(request, photos, masks, options.reconstruction, imagery)
    elif options.imagery is not None:
        raise ConfigError("`--imagery` lies under the map of a flight's page.", _NO_FLIGHT)
    elif options.reconstruction is not None:
        raise ConfigError("`--reconstruction` ties a flight's photos.", _NO_FLIGHT)
    else:
        answers = localize_photos(request, photos, masks)
    if answers.found:
        pages = {flight.name: answers.page(flight).name for flight in answers.flights}
        write_view(answers.view, request, answers.found, pages)
    _write_sidecars([(each.photo, each.found) for each in answers.photos if each.found is not None], options)
    return answers


def _tell_unused(photos: Sequence[Path], options: argparse.Namespace) -> None:
    """Warns of what photos have and nobody uses."""
    from lodbench.harness.photo.flight_inputs import heading_note, saved_masks_note

    has_choice = options.mask is not None or options.segmenter is not None or _masks_for(options) is not None
    notes = (None if has_choice else saved_masks_note(photos), heading_note(photos, options.heading))
    for note in filter(None, notes):
        _LOGGER.warning("%s", note)


def _write_sidecars(found: Sequence[tuple[Path, LocalizedPhoto]], options: argparse.Namespace) -> None:
    """Writes XMP beside the photos whose poses are to be trusted, if that was requested."""
    from lodbench.harness.photo.outputs import write_sidecars

    trusted = [(photo, answer.pose) for photo, answer in found if answer.is_trusted]
    if options.sidecars and found:
        sys.stderr.write(f"lodbench: sidecars: {write_sidecars(trusted, found[0][1].crs)}\n")


def _masks_for(options: argparse.Namespace) -> Path | None:
    """Returns the folder of masks that counts: a segmenter that was requested goes before what lies there."""
    is_segmented = options.segmenter is not None or options.segmenter_option
    return None if is_segmented else options.masks or _masks_inside(options)


def _masks_inside(options: argparse.Namespace) -> Path | None:
    """Returns the folder ``masks`` in the one folder that was requested; None where there is none."""
    inside: Path = options.photos[0] / "masks"
    return inside if len(options.photos) == 1 and inside.is_dir() else None


def _method(options: argparse.Namespace, is_one: bool, masks: Path | None) -> Method:
    """Returns the method that was requested, or the one for what was given.

    Raises:
        ConfigError: It looks at no mask, and one was named.
    """
    from lodbench.methods.registry import configure_method

    given = [name for name in ("mask", "masks", "segmenter", "segmenter_option") if getattr(options, name)]
    named = [f"--{name.replace('_', '-')}" for name in given]
    # Settings without a method are those of the one by pixels, which looks at no mask.
    by_pixels = "region" if options.method_option else _BY_PIXELS
    alone = _BY_MASK if named or masks is not None else by_pixels
    name = options.method or (alone if is_one or options.each_alone else "flight")
    method = with_prior_width(
        configure_method({**option_pairs(options.method_option), "name": name}), options
    ).make()
    takes_mask = "mask" in method.requires
    makes_mask = "mask_on_demand" in method.requires and not (options.mask or options.masks)
    if named and not takes_mask and not makes_mask:
        hint = f"Leave `{named[0]}` out, or take `--method {_BY_MASK}`."
        raise ConfigError(f"Method {method.name} looks at no mask.", hint)
    return method


def _request(options: argparse.Namespace, photo: Path, method: Method, masks: Path | None) -> PhotoRequest:
    from lodbench.harness.photo.request import PhotoRequest

    segmenter = None
    if options.mask is None and masks is None and {"mask", "mask_on_demand"} & set(method.requires):
        segmenter = segmenter_of(options.segmenter or FOR_PHOTOS, options.segmenter_option)
    own = {"photo": photo, "mask": options.mask, "segmenter": segmenter, "seed": options.seed}
    widths = (options.prior_range, options.prior_height, options.prior_yaw)
    own |= {"method": method, "has_prior_range": any(width is not None for width in widths)}
    return PhotoRequest(**city_settings(options), **rough_settings(options), **own)


def _with_start(request: PhotoRequest, photos: Sequence[Path], options: argparse.Namespace) -> PhotoRequest:
    """Returns a request with the rough poses that --start names, if it does.

    Raises:
        LodbenchError: They or the city cannot be read, or are of none of the photos.
    """
    if options.start is None:
        return request
    from lodbench.harness.photo.flight_inputs import read_rough_poses
    from lodbench.harness.photo.localize import open_map

    return replace(request, start=read_rough_poses(options.start, photos, open_map(request).scene.crs))


def _require_options(options: argparse.Namespace, is_one: bool) -> None:
    """Refuses a city where photos are meant, and what is meant for one photo and given for many, and back.

    Raises:
        ConfigError: There is such an option.
        DatasetError: A photo is not there.
    """
    from lodbench.citymodel.source import is_city_file

    require_one_mask_source(options, "--mask", "--masks")
    cities = [photo for photo in options.photos if is_city_file(photo)]
    if cities:
        hint = "The photos come first, the city model after `--city`."
        raise ConfigError(f"{cities[0]} is a city model by its name, not a photo.", hint)
    absent = [photo for photo in options.photos if not photo.exists()]
    if absent:
        raise DatasetError(f"The photo {absent[0]} does not exist.", "Check the path.")
    require_start_alone(options)
    own = [f"--{name}" for name in ("mask", "lat", "lon", "center") if getattr(options, name) is not None]
    if own and not is_one:
        hint = "Use `--masks DIR` for several." if own[0] == "--mask" else f"For several: {START_OF_EACH}."
        raise ConfigError(f"`{own[0]}` works with one photo.", hint)
    if options.masks is not None and is_one:
        raise ConfigError("`--masks` is for several photos.", "Give `--mask FILE`.")
    if options.reconstruction is not None and is_one:
        raise ConfigError("`--reconstruction` ties a flight's photos.", "Give several, or a folder.")
    if options.imagery is not None and is_one:
        raise ConfigError("`--imagery` lies under the map of a flight's page.", "Give several, or a folder.")
    if options.masks is not None and not options.masks.is_dir():
        raise ConfigError(
            f"`--masks {options.masks}` is not a folder.", "Name the folder of the photos' masks."
        )


def _tell_many(answers: Answers, options: argparse.Namespace) -> int:
    """Prints what became of many photos; returns the exit code."""
    if options.json:
        values = [
            {
                **({"failure": answer.failure} if answer.found is None else answer.found.to_json()),
                "photo": str(answer.photo),
                "flight": answer.flight or None,
            }
            for answer in answers.photos
        ]
        sys.stdout.write(_json(values) + "\n")
    else:
        sys.stdout.write(describe_many(answers, has_masks=_masks_for(options) is not None))
    if all(answer.found is None for answer in answers.photos):
        return 1
    is_well = all(answer.found is not None and answer.found.is_trusted for answer in answers.photos)
    return 0 if is_well else NOT_TRUSTED


def _json(values: Any) -> str:
    return json.dumps(values, indent=2, ensure_ascii=False, allow_nan=False)


def parser() -> Parser:
    """Returns the parser of the command's words."""
    parser = Parser("lodbench localize", _ABOUT, _EXAMPLES)
    add = parser.add_argument
    add(
        "photos",
        type=Path,
        nargs="+",
        metavar="PHOTO|DIR",
        help="JPEG, PNG or TIFF as the drone stored them, or folders of these",
    )
    add_map_options(parser)
    add("--mask", type=Path, metavar="FILE", help="mask of one photo: buildings white, all else black")
    add("--masks", type=Path, metavar="DIR", help="masks of many photos, named like the photos")
    add("--segmenter", metavar="NAME", help=f"what makes a mask where needed (default: {FOR_PHOTOS})")
    add("--segmenter-option", action="append", default=[], metavar="KEY=VALUE", help=_OPTION)
    add_rough_pose_options(parser, "rough pose (takes precedence over the photo's metadata)")
    add_start_option(parser)
    add_prior_options(parser)
    add_height_options(parser)
    add(
        "--method",
        metavar="NAME",
        help="default: flight; for one photo auto, with --mask or --segmenter contour_alignment, with "
        "--method-option region",
    )
    add("--method-option", action="append", default=[], metavar="KEY=VALUE", help=_OPTION)
    add("--each-alone", action="store_true", help="localise each of several photos by itself")
    add(
        "--reconstruction",
        type=Path,
        metavar="COLMAP_MODEL",
        help="of a flight, in any frame: ties its photos together",
    )
    add(
        "--sidecars",
        action="store_true",
        help="write PHOTO.xmp beside each photo whose pose is reliable",
    )
    add(
        "--imagery",
        type=Path,
        metavar="FILE",
        help="orthophoto (GeoTIFF, JPEG 2000) under the map of a flight's page",
    )
    add("--seed", type=int, default=0, help="random seed (default: 0)")
    add(
        "--out",
        type=Path,
        default=Path("localized"),
        metavar="DIR",
        help="folder of the results (default: localized)",
    )
    add("--json", action="store_true", help="print JSON, for scripts")
    return parser
